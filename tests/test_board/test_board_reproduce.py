"""Reproduction of entries: their models run again, scores compared, costs measured."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import CliRunner, Result
from model_board import NAME, PATH, ModelBoard
from numpy.typing import NDArray

from lagbench.board.check import CheckResult
from lagbench.board.entry import Entry, Level, Verification
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.board.measured_cost import TimedEntry, measure_costs
from lagbench.board.reproduce import ReproduceResult, reproduce
from lagbench.board.scores_compared import TOLERANCE, sample_scenarios
from lagbench.board.verified import read_verified
from lagbench.cli.program import app
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import load
from lagbench.errors import (
    ChecksFailedError,
    LagbenchError,
    UsageError,
    WorkFailedError,
)
from lagbench.scoring.task import load_scored_task
from lagbench.work.run import Meter


@pytest.fixture
def own(model_board: ModelBoard, tmp_path: Path) -> ModelBoard:
    """A copy of the leaderboard that the test may change."""
    board = tmp_path / "board"
    shutil.copytree(model_board.folder, board)
    return replace(model_board, folder=board)


def run_again(own: ModelBoard, *names: str, **options: Any) -> ReproduceResult:
    """Reproduce entries without costs."""
    defaults: dict[str, Any] = {"costs": False}
    return reproduce(
        own.folder,
        names,
        root=own.root,
        **(defaults | options),
    )


Content = dict[str, Any]


def lines_of(own: ModelBoard) -> Mapping[str, Verification]:
    """Return the lines of verified.yaml by the path of their entry."""
    return read_verified(Folder(own.folder))


def checks_of(result: CheckResult) -> list[str]:
    """Return the names of the checks that found something."""
    return [issue.check for issue in result.findings]


@pytest.mark.slow
def test_a_model_gives_the_scores_of_its_entry(own: ModelBoard) -> None:
    """Its line says so, it is not run twice, and the board has nothing to object."""
    result = run_again(own, NAME, costs=True, time_solver=lambda *_: 0.5)
    assert result.exit_code == 0
    assert result.predicted == [f"{NAME}, seed 0"]
    line = lines_of(own)[PATH]
    assert line == result.lines[PATH]
    assert line.level is Level.REPRODUCED
    (one,) = line.reproduced
    assert one.scenarios == 2
    assert one.of == 2
    assert one.difference == 0.0
    assert one.model == file_sha256(own.weights)
    assert line.cost is not None
    assert line.cost.solver == 0.5
    assert {"projection"} <= line.cost.classical.keys()
    assert line.cost.speed_up == 0.5 / line.cost.seconds_per_frame

    verified = own.folder / "verified.yaml"
    before = verified.read_bytes()
    result = run_again(own, NAME)
    assert result.predicted == []
    result = run_again(own)
    assert result.predicted == []
    assert verified.read_bytes() == before
    result = run_again(own, NAME, again=True)
    assert result.predicted == [f"{NAME}, seed 0"]
    assert own.find().findings == ()


@pytest.mark.slow
def test_costs_of_a_data_set_are_of_one_run(own: ModelBoard) -> None:
    """An entry without a cost has all rows of its data set measured again.

    The time of an entry that is called solver is not that of our solver.
    """
    options: dict[str, Any] = {"scores": False, "costs": True}
    first = run_again(own, NAME, **options, time_solver=lambda *_: 0.5)
    assert first.measured == [NAME]
    second = run_again(own, NAME, **options)
    assert second.measured == []

    other = PATH.replace("gns", "solver")
    shutil.copy(own.folder / PATH, own.folder / other)

    def rename(content: Content) -> None:
        content["method"] = "solver"
        content["name"] = "Another one"

    own.edit(own.folder / other, rename)
    other_name = NAME.replace("gns", "solver")
    third = run_again(own, other_name, **options, time_solver=lambda *_: 0.25)
    assert third.measured == [NAME, other_name]
    lines = lines_of(own)
    assert lines.keys() >= {PATH, other}
    for line in lines.values():
        assert line.cost is not None
        assert line.cost.solver == 0.25
    fourth = run_again(own, **options)
    assert fourth.measured == []

    def change_cost(content: Content) -> None:
        content[other]["cost"]["solver"] = 0.5

    own.edit(own.folder / "verified.yaml", change_cost)
    fifth = run_again(own, **options, time_solver=lambda *_: 0.25)
    assert fifth.measured == [NAME, other_name]


@pytest.mark.slow
def test_a_cost_of_an_earlier_run_does_not_stay(own: ModelBoard) -> None:
    """An entry whose model is damaged later loses its cost when others are measured."""
    other = PATH.replace("gns", "second")
    other_name = NAME.replace("gns", "second")
    shutil.copy(own.folder / PATH, own.folder / other)
    own_weights = own.weights.with_name("second_0.safetensors")
    shutil.copy(own.weights, own_weights)

    def take_own_weights(content: Content) -> None:
        content["method"] = "second"
        content["name"] = "A second one"
        weights = content["predictions"][0]["weights"]
        weights["path"] = own_weights.relative_to(own.folder).as_posix()

    own.edit(own.folder / other, take_own_weights)
    options: dict[str, Any] = {"scores": False, "costs": True, "again": True}
    first = run_again(own, **options)
    assert first.measured == [NAME, other_name]
    assert lines_of(own)[other].cost is not None

    own_weights.write_bytes(b"damaged")
    second = run_again(own, **options)
    assert second.measured == [NAME]
    assert [failure.entry for failure in second.failures] == [other]
    assert lines_of(own)[PATH].cost is not None
    assert lines_of(own)[other].cost is None


class SteadyRunner:
    """A runner whose frames take half a second."""

    def predict(
        self, scenario_file: Path, frames: int | None = None
    ) -> NDArray[np.float32]:
        """Nobody asks for positions here."""
        raise NotImplementedError

    def time(self, scenario_file: Path, frames: int) -> float:
        """Return the time of a frame."""
        return 0.5

    def close(self) -> None:
        """Free nothing."""


class FailingRunner(SteadyRunner):
    """A runner whose model opens but does not run, as some ONNX models."""

    def time(self, scenario_file: Path, frames: int) -> float:
        """Fail."""
        raise failure_of("this model")


def failure_of(place: str) -> WorkFailedError:
    """Return an error of a model."""
    return WorkFailedError(
        "it does not run", where=place, expected="a run", got="none", fix="mend it"
    )


def test_a_model_that_fails_has_no_cost_and_the_others_have(own: ModelBoard) -> None:
    """Its entry and the error are kept."""
    size = load().size("curl-noise", "tiny")
    task = load_scored_task(size, own.root)
    entry = read_entry(own.folder / PATH)
    other = entry.model_copy(update={"method": "other"})
    kept = []

    def keep_failure(entry: Entry, error: LagbenchError) -> None:
        kept.append(entry.method)

    costs = measure_costs(
        [
            TimedEntry(entry=entry, runner=FailingRunner()),
            TimedEntry(entry=other, runner=SteadyRunner()),
        ],
        task,
        root=own.root,
        time_solver=None,
        meter=Meter(None),
        keep_failure=keep_failure,
    )
    assert [entry.method for entry, _ in costs] == ["other"]
    assert [cost.seconds_per_frame for _, cost in costs] == [0.5]
    assert kept == ["gns"]


@pytest.mark.slow
def test_a_solver_that_fails_in_one_round_has_no_time(own: ModelBoard) -> None:
    """The models have their costs all the same."""
    seconds: Iterator[float | None] = iter([None, 0.25])
    size = load().size("curl-noise", "tiny")
    entry = read_entry(own.folder / PATH)
    ((_, cost),) = measure_costs(
        [TimedEntry(entry=entry, runner=SteadyRunner())],
        load_scored_task(size, own.root),
        root=own.root,
        time_solver=lambda *_: next(seconds),
        meter=Meter(None),
        keep_failure=lambda *_: None,
        repeats=2,
    )
    assert cost.seconds_per_frame == 0.5
    assert cost.solver is None


@pytest.mark.slow
def test_an_error_of_all_costs_is_kept_or_raised(own: ModelBoard) -> None:
    """With --all it is kept under the data set; with a named entry it is raised."""

    def fail(split: str, size: str) -> float:
        raise failure_of(f"{split} {size}")

    options: dict[str, Any] = {"scores": False, "costs": True, "time_solver": fail}
    result = run_again(own, **options)
    assert [failure.entry for failure in result.failures] == ["curl-noise/tiny"]
    assert result.exit_code == WorkFailedError.exit_code
    with pytest.raises(WorkFailedError):
        run_again(own, NAME, **options)


def test_a_model_that_gives_other_scores(own: ModelBoard) -> None:
    """An entry whose score file belongs to other predictions is not reproduced."""
    weights = own.weights.read_bytes()
    own.submit(own.shifted(0.01), replace=True)
    own.weights.parent.mkdir(parents=True, exist_ok=True)
    own.weights.write_bytes(weights)
    weights_of_entry = {
        "path": own.weights.relative_to(own.folder).as_posix(),
        "sha256": file_sha256(own.weights),
    }

    def name_weights(content: Content) -> None:
        content["predictions"][0]["weights"] = weights_of_entry

    own.edit(own.folder / PATH, name_weights)
    result = run_again(own, NAME)
    assert result.exit_code == ChecksFailedError.exit_code
    assert result.differing == [PATH]
    line = lines_of(own)[PATH]
    assert line.level is Level.AS_SUBMITTED
    (one,) = line.reproduced
    assert one.difference > TOLERANCE

    words = ["leaderboard", "reproduce", NAME, "--no-costs"]
    where = ["--board", str(own.folder), "--root", str(own.root)]
    printed = CliRunner().invoke(app, [*words, *where])
    assert printed.exit_code == ChecksFailedError.exit_code
    assert "NOT reproduced" in printed.stdout
    text = " ".join(printed.stdout.split())
    assert "fix: if the predictions were made with other weights" in text
    for part in ("lagbench predict FILE --split", "lagbench submit", "--replace"):
        assert part in text


def test_an_entry_without_a_model_names_the_command_that_adds_one(
    own: ModelBoard,
) -> None:
    """`lagbench submit --weights` alone did not run."""
    own.submit(own.shifted(0.01), replace=True)
    with pytest.raises(UsageError, match="no model to run") as caught:
        run_again(own, NAME)
    command = str(caught.value.fix).partition("lagbench ")[2]
    assert f"--board {own.folder}" in command
    result = CliRunner().invoke(app, [*shlex.split(command), "--help"])
    assert result.exit_code == 0, result.output
    for option in ("--from", "--method", "--weights", "--replace"):
        assert option in command


def test_a_line_holds_for_its_models_only(own: ModelBoard) -> None:
    """Other weights of the same predictions make the line stale."""
    run_again(own, NAME)

    def exchange_model(content: Content) -> None:
        content[PATH]["reproduced"][0]["model"] = "0" * 64

    own.edit(own.folder / "verified.yaml", exchange_model)
    assert checks_of(own.find()) == ["verified"]


@pytest.mark.slow
def test_check_counts_whole_and_partial_reproductions(own: ModelBoard) -> None:
    """A level that its records do not show is an issue, and so are other numbers of
    scenarios than the test subset has.
    """

    def counts() -> tuple[int, int]:
        result = own.find()
        assert result.findings == ()
        return result.reproduced_wholly, result.reproduced_partly

    assert counts() == (0, 0)
    run_again(own, NAME, scenarios=1)
    assert counts() == (0, 1)
    run_again(own, NAME)
    assert counts() == (1, 0)

    verified = own.folder / "verified.yaml"
    content = verified.read_bytes()

    def change_record(**changes: object) -> list[str]:
        def change(lines: Content) -> None:
            lines[PATH]["reproduced"][0].update(changes)

        verified.write_bytes(content)
        own.edit(verified, change)
        return checks_of(own.find())

    # the submitted score is that of both scenarios
    assert change_record(scenarios=1, of=2) == ["verified"]
    # another number of scenarios, and another score of that one
    assert change_record(scenarios=1, of=1) == ["verified", "verified"]
    assert change_record(scenarios=3, of=2) == ["verified"]
    assert change_record(difference=0.5) == ["verified"]
    assert change_record(reproduced=0.123) == ["verified"]
    assert change_record(reproduced=0.123, submitted=0.123) == ["verified"]
    assert change_record(difference=0.5, tolerance=1.0) == ["verified"]
    assert change_record(tolerance=1.0) == ["verified"]
    assert change_record(metric="position_rmse") == ["verified"]

    def repeat_record(lines: Content) -> None:
        lines[PATH]["reproduced"] *= 2

    verified.write_bytes(content)
    own.edit(verified, repeat_record)
    assert checks_of(own.find()) == ["verified"]


def test_what_cannot_be_run_is_refused(own: ModelBoard) -> None:
    """A model that was exchanged, an entry without a model, an unknown entry."""
    weights = own.weights.read_bytes()
    own.weights.write_bytes(weights + b"1")
    with pytest.raises(ChecksFailedError) as caught:
        run_again(own, NAME)
    assert caught.value.where == str(own.weights)
    result = run_again(own)
    entries = [failure.entry for failure in result.failures]
    assert entries == [PATH]
    assert result.exit_code == ChecksFailedError.exit_code

    def drop_weights(content: Content) -> None:
        del content["predictions"][0]["weights"]

    own.edit(own.folder / PATH, drop_weights)
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
    assert checks_of(far) == ["rescored"]


def test_a_sample_is_the_same_in_every_run() -> None:
    """Models have samples of their own, inside the test subset."""
    scenarios = range(100, 120)
    samples = []
    for model in range(9):
        sample = sample_scenarios(scenarios, str(model), 4)
        assert sample == sample_scenarios(scenarios, str(model), 4)
        assert set(sample) < set(scenarios)
        samples.append(sample)
    assert len(set(samples)) > 1
    assert sample_scenarios(scenarios, "1", None) == tuple(scenarios)


def test_contradictory_options_are_refused_before_any_work(
    own: ModelBoard, run: Callable[..., Result]
) -> None:
    """Options that contradict each other are refused before any work."""
    command = ("leaderboard", "reproduce")
    board = ("--board", own.folder)
    for words in (
        (),
        (NAME, "--all"),
        (NAME, "--costs", "--no-costs"),
    ):
        result = run(*command, *words, *board)
        assert result.exit_code == 2
    result = run(*command, "curl-noise/tiny/nobody", *board, "--json")
    assert result.exit_code == 2
    assert "results go to" not in result.stderr


@pytest.mark.slow
def test_a_recorded_result_is_shown_with_the_option_that_runs_it_again(
    own: ModelBoard, run: Callable[..., Result]
) -> None:
    """The first and the third call run the model; the second one reads the recorded
    line.
    """
    command = ["leaderboard", "reproduce", NAME, "--no-costs"]
    where = ["--board", own.folder, "--root", own.root]
    printed = []
    notes = []
    for options in (["--again"], [], ["--again"]):
        result = run(*command, *options, *where)
        assert result.exit_code == 0, result.output
        printed.append(result.stdout)
        notes.append(result.stderr.count(f"results go to {own.folder}"))
    assert notes == [1, 0, 1]
    told = ["--again runs it now" in text for text in printed]
    assert told == [False, True, False]
