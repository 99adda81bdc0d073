"""Gates: their measures on accelerations and clouds that are known."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from model_board import PATH, ModelBoard
from simple_models import batch, network

from lagbench.baselines.checkpoint import load, save
from lagbench.board.folder import Folder
from lagbench.data.checksums import file_sha256
from studies.gates import (
    Gates,
    StepErrors,
    board_weights,
    count_densest,
    main,
    predict_step,
    read_recorded,
    rollout_limit,
    to_json,
    to_markdown,
)

GRAVITY = 2.5 / 3600


def steps() -> StepErrors:
    """Return errors of no window yet."""
    return StepErrors(free_flight=[], settled=[])


def test_no_acceleration_at_all_has_an_error_of_1() -> None:
    truth = np.random.default_rng(0).normal(0.0, 1e-4, (50, 2))
    errors = steps()
    errors.add(-truth, truth, 0.0)
    assert errors.relative == pytest.approx(1.0)


def test_the_bias_is_that_of_windows_in_free_flight_or_at_rest() -> None:
    """Matter that accelerates otherwise counts in neither."""
    error = np.tile([0.0, -0.4 * GRAVITY], (50, 1))
    falling = np.tile([0.0, -GRAVITY], (50, 1))
    errors = steps()
    errors.add(error, falling, -GRAVITY)
    errors.add(0.5 * error, np.zeros((50, 2)), -GRAVITY)
    errors.add(error, 3.0 * falling, -GRAVITY)
    assert errors.free_flight == pytest.approx([-0.4])
    assert errors.settled == pytest.approx([-0.2])


def test_relaxation_of_a_step_has_the_limit_of_a_rollout() -> None:
    """Dense matter beside a spray stays, if it was as dense in the beginning."""
    model = network(radius=0.03, relaxation=3, densest=1.2)
    axis = np.linspace(0.2, 0.38, 10)
    block = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    spray = np.random.default_rng(0).uniform(0.5, 0.9, (100, 2))
    beginning = np.concatenate([block, block + np.array([0.0, 0.4])])
    later = np.concatenate([block, spray])
    rest = np.repeat(later[None], model.history + 1, axis=0)
    given = batch(np.repeat(beginning[None], 2, axis=0))

    limit = rollout_limit(model, given)
    error, truth = predict_step(model, batch(rest), limit)
    assert not truth.any()
    assert np.abs(error[:100]).max() < 1e-6

    limit_of_later = rollout_limit(model, batch(rest[:2]))
    disturbed, _ = predict_step(model, batch(rest), limit_of_later)
    assert np.abs(disturbed[:100]).max() > 1e-3


def test_the_fullest_cell_is_counted() -> None:
    cloud = np.full((30, 2), 0.52, np.float32)
    cloud[:10] = 0.98
    assert count_densest(cloud, 8) == 20


GATES = Gates(
    split="fluid",
    size="mini",
    dataset_version="3.0.0",
    method="gns_0",
    weights_sha256="",
    one_step=0.5,
    free_flight=-0.4,
    settled=None,
    densest_cell=2.9,
)


def test_a_gate_fails_at_its_limit_and_one_without_meaning_never() -> None:
    assert GATES.failed == ["one_step", "free_flight"]


def test_a_measure_that_is_no_number_fails() -> None:
    nowhere = replace(GATES, one_step=math.nan, densest_cell=math.nan)
    assert {"one_step", "densest_cell"} <= set(nowhere.failed)


def test_the_densest_cell_may_reach_its_limit() -> None:
    assert "densest_cell" not in replace(GATES, densest_cell=3.0).failed
    assert "densest_cell" in replace(GATES, densest_cell=3.001).failed


def test_what_is_recorded_of_other_weights_stays(tmp_path: Path) -> None:
    """Measured again, weights have one line, the new one."""
    path = tmp_path / "gates.json"
    assert read_recorded(path) == []
    path.write_text(to_json([GATES, replace(GATES, method="gns_1")]))
    better = replace(GATES, one_step=0.25)
    path.write_text(to_json([better], recorded=read_recorded(path)))
    first, second = read_recorded(path)
    assert first["one_step"] == 0.25
    assert second["method"] == "gns_1"


def test_the_numbers_of_scenarios_are_recorded(tmp_path: Path) -> None:
    """Whoever measures again knows on how many; older lines do not state them."""
    path = tmp_path / "gates.json"
    measured = replace(GATES, scenarios=8, rollouts=4)
    older = replace(GATES, method="gns_1")
    lines = json.loads(to_json([older]))["weights"]
    for line in lines:
        del line["scenarios"], line["rollouts"]
    path.write_text(to_json([measured], recorded=lines))
    first, second = read_recorded(path)
    assert (first["scenarios"], first["rollouts"]) == (8, 4)
    assert "scenarios" not in second
    assert to_markdown([measured]) == to_markdown([GATES])


def test_older_measures_are_printed(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They do not state on how many scenarios they were made."""
    entry = yaml.safe_load((board / PATH).read_text())
    digest = entry["predictions"][0]["weights"]["sha256"]
    row = replace(GATES, weights_sha256=digest)
    content = json.loads(to_json([row]))
    for line in content["weights"]:
        del line["scenarios"], line["rollouts"]
    assert recorded(board, content) == 0
    assert capsys.readouterr().out == to_markdown([row])


def weights_of(board: Path) -> list[Path]:
    """Return the weights of graph networks on a board, relative to it."""
    paths = board_weights(Folder(board), ["curl-noise"], "tiny")
    return [path.relative_to(board) for path in paths]


@pytest.fixture
def board(model_board: ModelBoard, tmp_path: Path) -> Path:
    """A copy of a board with a graph network, whose training has no log."""
    shutil.copytree(model_board.folder, tmp_path / "board")
    return tmp_path / "board"


def change_weights(board: Path, baseline: str) -> Path:
    """Write the weights anew, with another baseline in their record."""
    new = board / "weights/curl-noise/tiny/gns_0.safetensors"
    save(new, replace(load(new), baseline=baseline))
    content = yaml.safe_load((board / PATH).read_text())
    content["predictions"][0]["weights"] = {
        "path": new.relative_to(board).as_posix(),
        "sha256": file_sha256(new),
    }
    (board / PATH).write_text(yaml.safe_dump(content, sort_keys=False))
    return new


def test_weights_of_other_models_have_no_gates(board: Path) -> None:
    path = change_weights(board, "neuralmpm")
    path.with_suffix(".json").write_text(json.dumps({"baseline": "gns"}))
    assert weights_of(board) == []


def test_shared_weights_are_measured_once(board: Path) -> None:
    path = Path("weights/curl-noise/tiny/gns_0.safetensors")
    entry = board / PATH
    content = yaml.safe_load(entry.read_text())
    content["method"] = "successor"
    successor = yaml.safe_dump(content, sort_keys=False)
    entry.with_stem("successor").write_text(successor)
    assert weights_of(board) == [path]


def test_weights_that_are_missing_are_no_crash(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They end with the exit code of a file that cannot be read."""
    absent = tmp_path / "absent.safetensors"
    assert main(["--root", str(tmp_path), "--weights", str(absent)]) == 3
    assert str(absent) in capsys.readouterr().err


def test_measures_of_no_board_are_not_an_empty_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that is misspelt has no recorded measures to show."""
    assert main(["--recorded", "-o", str(tmp_path / "bord")]) == 2
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("option", ["--scenarios", "--rollouts"])
def test_gates_are_measured_on_one_scenario_or_more(
    tmp_path: Path, option: str
) -> None:
    """Without a scenario there is no error to measure, and no cell to count."""
    with pytest.raises(SystemExit) as caught:
        main(["--root", str(tmp_path), option, "0"])
    assert caught.value.code == 2


def recorded(folder: Path, content: object) -> int:
    """Write a gates.json beside the entries of a board; return how printing it ends."""
    (folder / "gates.json").write_text(json.dumps(content))
    return main(["--recorded", "-o", str(folder)])


@pytest.mark.parametrize(
    "content", [[], {}, {"weights": 3}, {"weights": [3]}, {"weights": [{}]}, "text"]
)
def test_damaged_measures_are_no_crash(
    board: Path, capsys: pytest.CaptureFixture[str], content: object
) -> None:
    """They end with the exit code of a file that cannot be read."""
    assert recorded(board, content) == 3
    output = capsys.readouterr()
    assert output.out == ""
    assert str(board / "gates.json") in output.err


@pytest.mark.parametrize(
    ("name", "value"),
    [("one_step", "x"), ("settled", []), ("densest_cell", True), ("split", ["cavity"])],
)
def test_measures_of_another_type_are_no_crash(
    board: Path, capsys: pytest.CaptureFixture[str], name: str, value: object
) -> None:
    """The row that holds them is named."""
    entry = yaml.safe_load((board / PATH).read_text())
    digest = entry["predictions"][0]["weights"]["sha256"]
    content = json.loads(to_json([replace(GATES, weights_sha256=digest)]))
    content["weights"][0][name] = value
    assert recorded(board, content) == 3
    output = capsys.readouterr()
    assert output.out == ""
    assert f"{name} in row 0" in output.err


def test_measures_of_an_unknown_split_are_no_crash(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Measures of a later version may name a split that is not here."""
    entry = yaml.safe_load((board / PATH).read_text())
    digest = entry["predictions"][0]["weights"]["sha256"]
    row = replace(GATES, split="no-such-split", weights_sha256=digest)
    assert recorded(board, json.loads(to_json([row]))) == 2
    assert capsys.readouterr().out == ""


def test_a_name_of_weights_is_one_cell() -> None:
    """Markdown shows the name as it stands, whatever characters it has."""
    table = to_markdown([replace(GATES, method="a|b*c_0")])
    assert table.splitlines()[-1].startswith("| fluid mini 3.0.0 | a\\|b\\*c\\_0 | ")
