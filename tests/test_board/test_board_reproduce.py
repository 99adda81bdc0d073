"""Reproduction of entries: their models run again, scores compared, costs measured."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from model_board import NAME, PATH, ModelBoard
from typer.testing import Result

from lagbench.board.entry import Level
from lagbench.board.folder import Folder
from lagbench.board.reproduce import ReproduceResult, reproduce, sample_scenarios
from lagbench.board.scores_compared import TOLERANCE
from lagbench.board.verified import read_verified
from lagbench.data.checksums import file_sha256
from lagbench.errors import ChecksFailedError, UsageError


@pytest.fixture
def own(model_board: ModelBoard, tmp_path: Path) -> ModelBoard:
    """A copy of the leaderboard that the test may change."""
    shutil.copytree(model_board.folder, tmp_path / "board")
    return replace(model_board, folder=tmp_path / "board")


def run_again(own: ModelBoard, *names: str, **options: Any) -> ReproduceResult:
    """Reproduce entries without costs."""
    defaults: dict[str, Any] = {"costs": False}
    return reproduce(
        own.folder,
        names,
        root=own.root,
        **(defaults | options),
    )


def test_a_model_gives_the_scores_of_its_entry(own: ModelBoard) -> None:
    """Its line says so, it is not run twice, and the board has nothing to object."""
    result = run_again(own, NAME, costs=True, time_solver=lambda *_: 0.5)
    assert (result.exit_code, result.predicted) == (0, [f"{NAME}, seed 0"])
    line = read_verified(Folder(own.folder))[PATH]
    assert line == result.lines[PATH]
    assert line.level is Level.REPRODUCED
    (one,) = line.reproduced
    assert (one.scenarios, one.of, one.difference) == (2, 2, 0.0)
    assert one.model == file_sha256(own.weights)
    assert line.cost is not None
    assert line.cost.solver == 0.5
    assert {"projection"} <= line.cost.classical.keys()
    assert line.cost.speed_up == 0.5 / line.cost.seconds_per_frame

    before = (own.folder / "verified.yaml").read_bytes()
    assert run_again(own, NAME).predicted == []
    assert run_again(own).predicted == []
    assert (own.folder / "verified.yaml").read_bytes() == before
    assert run_again(own, NAME, again=True).predicted == [f"{NAME}, seed 0"]
    assert own.find().findings == ()


def test_costs_of_a_data_set_are_of_one_run(own: ModelBoard) -> None:
    """An entry without a cost has all rows of its data set measured again."""
    options: dict[str, Any] = {"scores": False, "costs": True}
    first = run_again(own, NAME, **options, time_solver=lambda *_: 0.5)
    assert first.measured == [NAME]
    assert run_again(own, NAME, **options).measured == []

    other = PATH.replace("gns", "other")
    shutil.copy(own.folder / PATH, own.folder / other)
    own.edit(
        own.folder / other,
        lambda content: content.update(method="other", name="Another one"),
    )
    other_name = NAME.replace("gns", "other")
    second = run_again(own, other_name, **options, time_solver=lambda *_: 0.25)
    assert second.measured == [NAME, other_name]
    lines = read_verified(Folder(own.folder))
    assert [lines[path].cost is not None for path in (PATH, other)] == [True, True]
    assert {line.cost and line.cost.solver for line in lines.values()} == {0.25}
    assert run_again(own, **options).measured == []

    own.edit(
        own.folder / "verified.yaml",
        lambda content: content[other]["cost"].update(solver=0.5),
    )
    third = run_again(own, **options, time_solver=lambda *_: 0.25)
    assert third.measured == [NAME, other_name]


def test_a_model_that_gives_other_scores(own: ModelBoard) -> None:
    """An entry whose score file belongs to other predictions is not reproduced."""
    weights = own.weights.read_bytes()
    own.submit(own.shifted(0.01), replace=True)
    own.weights.parent.mkdir(parents=True, exist_ok=True)
    own.weights.write_bytes(weights)
    said = {
        "path": own.weights.relative_to(own.folder).as_posix(),
        "sha256": file_sha256(own.weights),
    }
    own.edit(
        own.folder / PATH,
        lambda content: content["predictions"][0].update(weights=said),
    )
    result = run_again(own, NAME)
    assert result.exit_code == ChecksFailedError.exit_code
    assert result.differing == [PATH]
    line = read_verified(Folder(own.folder))[PATH]
    assert line.level is Level.AS_SUBMITTED
    assert line.reproduced[0].difference > TOLERANCE


def test_a_line_holds_for_its_models_only(own: ModelBoard) -> None:
    """Other weights of the same predictions make the line stale."""
    run_again(own, NAME)
    own.edit(
        own.folder / "verified.yaml",
        lambda content: content[PATH]["reproduced"][0].update(model="0" * 64),
    )
    assert [issue.check for issue in own.find().findings] == ["verified"]


def test_what_cannot_be_run_is_refused(own: ModelBoard) -> None:
    """A model that was exchanged, an entry without a model, an unknown entry."""
    own.weights.write_bytes(own.weights.read_bytes() + b"1")
    with pytest.raises(ChecksFailedError) as caught:
        run_again(own, NAME)
    assert caught.value.where == str(own.weights)
    result = run_again(own)
    assert [failure.entry for failure in result.failures] == [PATH]
    assert result.exit_code == ChecksFailedError.exit_code

    own.edit(
        own.folder / PATH, lambda content: content["predictions"][0].pop("weights")
    )
    for name in ("curl-noise/tiny/nobody", NAME):
        with pytest.raises(UsageError):
            run_again(own, name)


def test_predictions_made_anew_confirm_within_the_tolerance(own: ModelBoard) -> None:
    """Positions that differ by 1e-7 confirm the entry; those 1e-2 away do not."""
    near = own.find(predictions=[own.shifted(1e-7)])
    assert near.findings == ()
    (confirmation,) = near.confirmed
    assert confirmation.is_anew
    assert 0.0 < confirmation.difference <= TOLERANCE
    far = own.find(predictions=[own.shifted(1e-2)])
    assert [issue.check for issue in far.findings] == ["rescored"]


def test_a_sample_is_the_same_in_every_run() -> None:
    """Models have samples of their own, inside the test subset."""
    scenarios = range(100, 120)
    samples = [sample_scenarios(scenarios, f"{i}", 4) for i in range(9)]
    assert samples == [sample_scenarios(scenarios, f"{i}", 4) for i in range(9)]
    assert len(set(samples)) > 1
    assert all(set(scenarios) > set(sample) for sample in samples)
    assert sample_scenarios(scenarios, "1", None) == tuple(scenarios)


def test_the_command_says_what_it_did(
    own: ModelBoard, run: Callable[..., Result]
) -> None:
    """Options that contradict each other are refused before any work."""
    board = ("--board", own.folder)
    for words in ((), (NAME, "--all"), (NAME, "--costs", "--no-costs")):
        assert run("leaderboard", "reproduce", *words, *board).exit_code == 2
    result = run("leaderboard", "reproduce", "curl-noise/tiny/nobody", *board, "--json")
    assert result.exit_code == 2
