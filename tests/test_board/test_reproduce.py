"""Models of entries: reproduced on test, timed, scored on shift."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import netCDF4
import pytest
from model_board import NAME, PATH, ModelBoard, make_bench

import lagbench
from lagbench.baselines.predict import predict
from lagbench.board.entry import read_entry
from lagbench.board.folder import Folder
from lagbench.board.reproduce import TOLERANCE, reproduce, sample_scenarios
from lagbench.board.shift import SHIFT_SCORES
from lagbench.board.shift_run import score_on_shift
from lagbench.board.verified import VERIFICATIONS, Level
from lagbench.data.checksums import file_sha256
from lagbench.errors import ChecksFailedError, UsageError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.scoring.task import SUBMISSION


@pytest.fixture
def own(model_board: ModelBoard, tmp_path: Path) -> ModelBoard:
    """A copy of the leaderboard that the test may change."""
    shutil.copytree(model_board.folder, tmp_path / "board")
    return replace(model_board, folder=tmp_path / "board")


@pytest.mark.slow
def test_a_model_gives_the_scores_of_its_entry(
    own: ModelBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The record says so with the cost, and the model is not run twice."""
    monkeypatch.setattr("os.getloadavg", lambda: (1.0, 1.0, 1.0))
    result = reproduce(own.folder, [NAME], root=own.root, time_solver=lambda *_: 0.5)
    assert result.exit_code == 0
    assert result.predicted == [f"{NAME}, seed 0"]
    line = VERIFICATIONS.read(Folder(own.folder))[PATH]
    assert line.level is Level.REPRODUCED
    (one,) = line.reproduced
    assert one.difference <= TOLERANCE
    assert one.scenarios == one.of
    assert line.cost is not None
    assert line.cost.solver == 0.5
    assert {"projection", "projection-2x"} <= set(line.cost.classical)
    again = reproduce(own.folder, [NAME], root=own.root)
    assert (again.predicted, again.measured) == ([], [])
    assert own.find().findings == ()


def test_other_predictions_are_not_reproduced(own: ModelBoard) -> None:
    own.submit(own.shifted(1e-3), weights=[own.weights], replace=True)
    result = reproduce(own.folder, [NAME], root=own.root, costs=False)
    assert result.exit_code == ChecksFailedError.exit_code
    assert VERIFICATIONS.read(Folder(own.folder))[PATH].level is Level.AS_SUBMITTED


def test_a_changed_model_is_not_run(own: ModelBoard) -> None:
    with own.weights.open("ab") as file:
        file.write(b"\0")
    with pytest.raises(ChecksFailedError):
        reproduce(own.folder, [NAME], root=own.root, costs=False)
    assert any("SHA-256" in finding for finding in own.find().findings)


def test_costs_are_not_recorded_on_a_busy_machine(
    own: ModelBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.getloadavg", lambda: (99.0, 1.0, 1.0))
    with pytest.raises(WorkFailedError, match="busy"):
        reproduce(own.folder, [NAME], root=own.root, scores=False)
    assert VERIFICATIONS.read(Folder(own.folder)) == {}


def test_a_sample_follows_from_the_model() -> None:
    scenarios = range(20)
    sample = sample_scenarios(scenarios, "a", 5)
    assert sample == sample_scenarios([*reversed(scenarios)], "a", 5)
    assert sample == tuple(sorted(sample))
    assert len(sample) == 5
    assert sample != sample_scenarios(scenarios, "b", 5)
    assert sample_scenarios(scenarios, "a", None) == tuple(scenarios)


def test_weights_that_lie_on_the_board_are_named_not_copied(own: ModelBoard) -> None:
    """They stay while any entry names them."""
    files = set(own.folder.rglob("*.safetensors"))
    own.submit(own.predictions, weights=[own.weights], method="twin")
    twin = read_entry(own.folder / PATH.replace("gns.yaml", "twin.yaml"))
    weights = twin.predictions[0].weights
    assert weights is not None
    assert own.folder / weights.path == own.weights
    assert set(own.folder.rglob("*.safetensors")) == files
    own.submit(own.shifted(1e-3), replace=True)
    assert own.weights.exists()
    own.submit(own.shifted(1e-3), replace=True, method="twin")
    assert not own.weights.exists()


def test_weights_of_another_seed_are_refused(own: ModelBoard, tmp_path: Path) -> None:
    path = tmp_path / "other.nc"
    shutil.copy(own.predictions, path)
    with netCDF4.Dataset(path, "a") as file:
        file.seed = 4
    with pytest.raises(UsageError, match="seed"):
        own.submit(path, weights=[own.weights], method="other")


@pytest.mark.slow
def test_scores_on_shift_are_those_of_predict_and_score(
    tmp_path: Path, tiny_split: Callable[..., GenerationResult]
) -> None:
    """They are not made twice, and go with the models."""
    split = "multimaterial"
    name = f"{split}/tiny/gns"
    bench = make_bench(tmp_path / "bench", tiny_split(split).root, split)
    result = score_on_shift(bench.folder, [name], root=bench.root)
    assert result.predicted == [f"{name}, seed 0"]
    path = tmp_path / "shift.nc"
    predict(
        bench.weights, path, subset="shift", root=bench.root, device="cpu", threads=1
    )
    card = lagbench.score(path, root=bench.root, workers=1)
    expected = card.scores[SUBMISSION][card.ranking]
    (one,) = SHIFT_SCORES.read(Folder(bench.folder))[f"submissions/{name}.yaml"].models
    assert one.model == file_sha256(bench.weights)
    assert tuple(one.values) == expected.scenarios
    assert list(one.values.values()) == pytest.approx(expected.values, rel=1e-6)
    assert bench.find().findings == ()
    assert score_on_shift(bench.folder, [name], root=bench.root).predicted == []
    bench.submit(bench.shifted(1e-3), replace=True)
    assert SHIFT_SCORES.read(Folder(bench.folder)) == {}
