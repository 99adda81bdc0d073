"""Scores of entries on shift: models are run there, the board shows and checks them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import Result
from model_board import ModelBoard, make_bench
from onnx_files import straight_on

import lagbench
from lagbench.baselines.predict import predict
from lagbench.board.build import build, collect
from lagbench.board.folder import Folder
from lagbench.board.shift import read_shift
from lagbench.board.shift_run import score_on_shift
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import load
from lagbench.errors import DataError, UsageError
from lagbench.figures.report.report import write_report
from lagbench.make.generate import GenerationResult
from lagbench.models.predict_onnx import predict_onnx
from lagbench.references.shipped import shipped
from lagbench.scoring.scenario import SUBMISSION
from lagbench.submission.predictions import open_predictions
from lagbench.work.run import Progress

pytestmark = pytest.mark.slow
"""Their leaderboard takes ten seconds to make."""

SPLIT = "multimaterial"
NAME = f"{SPLIT}/tiny/gns"
PATH = f"submissions/{NAME}.yaml"


@pytest.fixture(scope="module")
def run_board(
    tmp_path_factory: pytest.TempPathFactory,
    tiny_split: Callable[..., GenerationResult],
) -> ModelBoard:
    """A leaderboard of a set with shift, whose only model was run there."""
    folder = tmp_path_factory.mktemp("shift-board")
    root = tiny_split(SPLIT).root
    bench = make_bench(folder, root, SPLIT)
    result = score_on_shift(bench.folder, [NAME], root=bench.root)
    assert result.predicted == [f"{NAME}, seed 0"]
    return bench


@pytest.fixture
def own(run_board: ModelBoard, tmp_path: Path) -> ModelBoard:
    """A copy of the leaderboard that the test may change."""
    shutil.copytree(run_board.folder, tmp_path / "board")
    return replace(run_board, folder=tmp_path / "board")


def test_the_values_are_those_of_predict_and_score(
    run_board: ModelBoard, tmp_path: Path
) -> None:
    """A prediction of shift with the same weights, scored as a file, has them too."""
    path = tmp_path / "shift.nc"
    predict(
        run_board.weights,
        path,
        subset="shift",
        root=run_board.root,
        device="cpu",
        threads=1,
    )
    card = lagbench.score(path, root=run_board.root, workers=1)
    assert f"{SPLIT} tiny shift" in repr(card)
    page = write_report(tmp_path / "report", [card], [path], root=run_board.root)
    assert f"on {SPLIT} tiny shift" in page.read_text()
    with pytest.raises(UsageError) as caught:
        lagbench.compare(path, "gns", board=run_board.folder, root=run_board.root)
    assert "--subset" in caught.value.fix
    expected = card.scores[SUBMISSION][card.ranking]
    line = read_shift(Folder(run_board.folder))[PATH]
    (one,) = line.models
    assert one.model == file_sha256(run_board.weights)
    assert tuple(one.values) == expected.scenarios
    values = list(one.values.values())
    assert values == pytest.approx(expected.values, rel=1e-6)


def test_an_onnx_file_predicts_shift(run_board: ModelBoard, tmp_path: Path) -> None:
    """The scenarios of the file are those of shift, and the file says so."""
    path = tmp_path / "shift.nc"
    predict_onnx(
        straight_on(tmp_path / "lines.onnx"),
        path,
        split=SPLIT,
        size="tiny",
        subset="shift",
        root=run_board.root,
    )
    with open_predictions(path) as predictions:
        header = predictions.header
    assert header.subset == "shift"
    assert set(header.scenarios) == set(load().size(SPLIT, "tiny").subsets["shift"])


def test_an_unreadable_entry_keeps_its_weights_and_its_line(own: ModelBoard) -> None:
    """Only the entry is reported: no message asks to remove its weights or its line."""
    own.edit(own.folder / PATH, lambda content: content.update(authors=[]))
    (finding,) = own.find().findings
    assert finding.check == "schema"


def test_a_template_of_shift_is_scored_there(
    run_board: ModelBoard, tmp_path: Path
) -> None:
    """In another language, models of shift begin with a template too."""
    path = tmp_path / "template.nc"
    made = lagbench.template(
        SPLIT, "tiny", subset="shift", output=path, root=run_board.root
    )
    size = load().size(SPLIT, "tiny")
    assert set(made.scenarios) == set(size.subsets["shift"])
    card = lagbench.score(path, root=run_board.root, workers=1)
    assert card.header.subset == "shift"
    with pytest.raises(UsageError):
        lagbench.template(
            "cavity", "tiny", subset="shift", output=path, root=run_board.root
        )


def test_the_board_shows_skill_on_shift(run_board: ModelBoard) -> None:
    """It is 1 - score / score of the best naive baseline there, whose own skill is
    0.
    """
    (tab,) = collect(run_board.folder).tabs
    size = load().size(SPLIT, "tiny")
    references = shipped(size.scored_on("shift"))
    assert references is not None
    best = None
    for row in tab.references:
        assert row.on_shift is not None
        scores = references[row.name].scores
        mean = scores[tab.ranking].mean
        assert row.on_shift.score.mean == pytest.approx(mean)
        if row.kind == "naive" and (best is None or mean < best):
            best = mean
    assert best is not None
    (row,) = tab.rows
    assert row.on_shift is not None
    assert row.on_shift.skill is not None
    expected = 1.0 - row.on_shift.score.mean / best
    assert row.on_shift.skill.mean == pytest.approx(expected)
    naive_skills = []
    for reference in tab.references:
        if reference.kind == "naive" and reference.on_shift is not None:
            assert reference.on_shift.skill is not None
            naive_skills.append(reference.on_shift.skill.mean)
    assert max(naive_skills) == pytest.approx(0.0)


def test_the_command_runs_no_model_twice(own: ModelBoard) -> None:
    """Recorded lines stay as they are, unless an option runs the model again."""
    before = (own.folder / "shift.yaml").read_bytes()
    result = score_on_shift(own.folder, root=own.root)
    assert result.predicted == []
    assert (own.folder / "shift.yaml").read_bytes() == before
    again = score_on_shift(own.folder, [NAME], root=own.root, again=True)
    assert again.predicted == [f"{NAME}, seed 0"]
    assert (own.folder / "shift.yaml").read_bytes() == before
    build(own.folder)
    assert own.find(page=True).findings == ()


Content = dict[str, Any]


def change_model(line: Content) -> None:
    line["models"][0]["model"] = "0" * 64


def change_data(line: Content) -> None:
    line["subset_sha256"] = "0" * 64


def change_metric(line: Content) -> None:
    line["metric"] = "position_rmse"


def drop_scenario(line: Content) -> None:
    line["models"][0]["values"].popitem()


def repeat_seed(line: Content) -> None:
    models = line["models"]
    models.append(models[0])


def drop_models(line: Content) -> None:
    line["models"] = []


def set_huge_value(line: Content) -> None:
    values = line["models"][0]["values"]
    values[min(values)] = 1e100


def set_negative_value(line: Content) -> None:
    values = line["models"][0]["values"]
    values[min(values)] = -0.5


def add_key(line: Content) -> None:
    line["comment"] = "better"


def checks_of(own: ModelBoard) -> list[str]:
    """Return the names of the checks that find something."""
    return [issue.check for issue in own.find().findings]


@pytest.mark.parametrize(
    "change",
    [
        change_model,
        change_data,
        change_metric,
        drop_scenario,
        repeat_seed,
        drop_models,
        set_huge_value,
        set_negative_value,
        add_key,
    ],
)
def test_a_line_holds_for_its_models_and_data_only(
    own: ModelBoard, change: Callable[[Content], None]
) -> None:
    """The check reports each other line."""
    own.edit(own.folder / "shift.yaml", lambda content: change(content[PATH]))
    assert checks_of(own) == ["shift"]


def test_a_line_of_no_entry_is_reported(own: ModelBoard) -> None:
    """An entry that is not there has no scores."""

    def copy_line(content: Content) -> None:
        gone = PATH.replace("gns", "gone")
        content[gone] = content[PATH]

    own.edit(own.folder / "shift.yaml", copy_line)
    assert checks_of(own) == ["shift"]


def test_an_entry_that_is_replaced_loses_its_line(own: ModelBoard) -> None:
    """Predictions without the model have no scores on shift; the check is silent."""
    predictions = own.shifted(0.01)
    own.submit(predictions, replace=True)
    assert read_shift(Folder(own.folder)) == {}
    assert own.find().findings == ()


def test_what_cannot_be_run_is_refused(
    own: ModelBoard, model_board: ModelBoard, tmp_path: Path
) -> None:
    """An unknown entry, a set without shift, and data that are not there."""
    nobody = f"{SPLIT}/tiny/nobody"
    with pytest.raises(UsageError):
        score_on_shift(own.folder, [nobody], root=own.root)
    with pytest.raises(UsageError):
        score_on_shift(
            model_board.folder, ["curl-noise/tiny/gns"], root=model_board.root
        )
    with pytest.raises(UsageError):
        score_on_shift(model_board.folder, root=model_board.root)
    (own.folder / "shift.yaml").unlink()
    with pytest.raises(DataError):
        score_on_shift(own.folder, [NAME], root=tmp_path / "nowhere")
    result = score_on_shift(own.folder, root=tmp_path / "nowhere")
    entries = [failure.entry for failure in result.failures]
    assert entries == [PATH]
    assert result.exit_code == DataError.exit_code


def test_a_manifest_without_the_hash_of_shift_is_refused_before_a_model_runs(
    own: ModelBoard, tmp_path: Path
) -> None:
    """shift.yaml records this hash, and predictions may take hours."""
    (own.folder / "shift.yaml").unlink()
    root = tmp_path / "data"
    shutil.copytree(own.root / SPLIT, root / SPLIT)
    (manifest,) = root.rglob("manifest.json")
    content = json.loads(manifest.read_text())
    del content["subset_sha256"]["shift"]
    manifest.write_text(json.dumps(content))
    stages = []

    def watch(progress: Progress) -> None:
        stages.append(progress)

    with pytest.raises(DataError):
        score_on_shift(own.folder, [NAME], root=root, progress=watch)
    assert stages == []


def test_the_command_writes_the_file(
    own: ModelBoard, run: Callable[..., Result]
) -> None:
    """Without a choice of entries it is refused."""
    (own.folder / "shift.yaml").unlink()
    words = ("leaderboard", "shift", "--board", own.folder, "--root", own.root)
    assert run(*words).exit_code == 2
    assert run(*words, NAME, "--all").exit_code == 2
    result = run(*words, NAME)
    assert result.exit_code == 0, result.output
    text = (own.folder / "shift.yaml").read_text()
    content = yaml.safe_load(text)
    assert list(content) == [PATH]
