"""The scorer against closed answers, other routes to the same numbers, and itself."""

from __future__ import annotations

import importlib.util
import json
import math
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from file_size_limit import largest_file
from score_bench import ScoreBench, half_right, right, still, straight

from lagbench.errors import ChecksFailedError, DataError, UsageError, WorkFailedError
from lagbench.scoring import score as scoring
from lagbench.scoring.card import SUBMISSION, ScoreCard, digits
from lagbench.scoring.score import score
from lagbench.store.dataset import open_split
from lagbench.submission import validate
from lagbench.work.progress import Progress


@pytest.fixture(scope="module")
def standing(bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> ScoreCard:
    """The score card of persistence, written."""
    folder = tmp_path_factory.mktemp("standing")
    return bench.score(bench.submit(folder / "predictions.nc", still))


@pytest.fixture
def source(standing: ScoreCard) -> Path:
    """Its predictions."""
    return standing.files[0].parent / "predictions.nc"


def held(card: ScoreCard) -> dict[str, Any]:
    """Return what scores.json holds."""
    return dict(json.loads(card.files[0].read_bytes()))


@pytest.mark.usefixtures("as_shipped")
def test_truth_scores_perfectly(bench: ScoreBench, tmp_path: Path) -> None:
    """The truth itself gets the perfect value of every metric that has one, and is
    suspect.
    """
    card = bench.evaluate(bench.submit(tmp_path / "predictions.nc", right))
    for name, found in card.submission.items():
        if found.metric.perfect is not None:
            np.testing.assert_allclose(
                found.values, found.metric.perfect, atol=1e-12, err_msg=name
            )
    assert card.submission["stable_frames"].mean == bench.size.task.horizon
    raised = {flag.name for flag in card.flags if flag.raised}
    assert raised == {"copy_suspect", "below_twin_floor"}


@pytest.mark.parametrize(
    ("row", "predict"), [("persistence", still), ("constant-velocity", straight)]
)
def test_floors_are_what_a_user_would_submit(
    bench: ScoreBench, tmp_path: Path, row: str, predict: Any
) -> None:
    """A floor written as a predictions.nc scores exactly like the scorer's own row."""
    card = bench.evaluate(bench.submit(tmp_path / "predictions.nc", predict))
    for name, found in card.submission.items():
        np.testing.assert_array_equal(
            found.per_frame, card.scores[row][name].per_frame, err_msg=name
        )
        np.testing.assert_array_equal(
            found.values, card.scores[row][name].values, err_msg=name
        )


def test_position_rmse_by_xarray(bench: ScoreBench, standing: ScoreCard) -> None:
    """The position RMSE equals that of the public loader's arrays: frame mean, root,
    scenario mean.
    """
    data = open_split(bench.size.split, size=bench.size.name, root=bench.root)
    n = bench.size.task.input_frames
    h = bench.size.task.horizon
    position = data["position"].astype("float64").compute()
    error = position.isel(frame=n - 1).drop_vars("frame") - position.isel(
        frame=slice(n, n + h)
    )
    rmse = ((error**2).mean(("frame", "particle", "space")) ** 0.5).values
    np.testing.assert_allclose(
        standing.submission["position_rmse"].values, rmse, rtol=1e-6
    )
    data.close()


def test_a_card_is_shown_in_one_line(standing: ScoreCard) -> None:
    """A notebook shows the method, the ranking metric and the skill, not thousands of
    numbers.
    """
    shown = repr(standing)
    assert len(shown) < 200
    assert all(
        word in shown
        for word in (standing.header.method, standing.ranking, str(standing.skill))
    )


def test_json_says_what_the_card_says(standing: ScoreCard) -> None:
    """Means, intervals, values per scenario and frames of interest stand in
    scores.json, nine digits each.
    """
    said = held(standing)
    counting = ["persistence", "constant-velocity", "frozen-field", "analog"]
    assert list(said["rows"]) == [SUBMISSION, *counting]
    for row, scores in standing.scores.items():
        for name, found in scores.items():
            entry = said["rows"][row][name]
            assert entry["mean"] == digits(found.mean)
            assert entry["values"] == [digits(value) for value in found.values.tolist()]
            assert entry["undefined"] == list(found.undefined)
            assert ("at" in entry) == found.metric.per_frame
    frames = said["task"]["frames"]
    assert frames == sorted(
        {*standing.config.frames_of_interest, standing.config.predicted_frames[-1]}
    )
    assert list(said["rows"][SUBMISSION]["position_mse"]["at"]) == [
        str(frame) for frame in frames
    ]
    told = {
        "family": "vorticity",
        "unit": "1/frame",
        "direction": "lower",
        "perfect": 0.0,
    }
    assert said["metrics"]["vorticity_rmse"].items() >= told.items()
    # At rest there is no correlation: null, every frame counted, in both scenarios.
    entry = said["rows"][SUBMISSION]["vorticity_pearson"]
    assert entry["mean"] is None
    assert entry["values"] == [None, None]
    assert entry["undefined"] == [standing.config.horizon] * 2


def test_freezing_midway_leaves_frames_out(bench: ScoreBench, tmp_path: Path) -> None:
    """A rollout right for 10 of 20 frames, then frozen: Pearson is 1 over 10 frames, 10
    undefined.
    """
    card = bench.evaluate(
        bench.submit(
            tmp_path / "predictions.nc", half_right, diverged_at={3: 16, 4: 16}
        )
    )
    pearson = card.submission["vorticity_pearson"]
    np.testing.assert_allclose(pearson.values, 1.0)
    assert pearson.undefined == (10, 10)
    assert card.submission["vorticity_rmse"].mean > 0.0
    assert card.as_json()["diverged_at"] == {"3": 16, "4": 16}


@pytest.mark.parametrize("one_fits", [False, True])
def test_a_full_disk_leaves_both_files_or_none(
    bench: ScoreBench, tmp_path: Path, one_fits: bool
) -> None:
    """Scores of before stay as they were: scores.json belongs to the scores.nc beside
    it.
    """
    bench.score(bench.submit(tmp_path / "predictions.nc", half_right))
    before = {path.name: path.read_bytes() for path in tmp_path.glob("scores.*")}
    one, other = sorted(map(len, before.values()))
    room = (one + other) // 2 if one_fits else 2_000
    bench.submit(tmp_path / "predictions.nc", still)
    with largest_file(room), pytest.raises(WorkFailedError):
        bench.score(tmp_path / "predictions.nc")
    assert {
        path.name: path.read_bytes() for path in tmp_path.glob("scores.*")
    } == before


def test_same_bytes_from_worker_processes(
    bench: ScoreBench, standing: ScoreCard, source: Path, tmp_path: Path
) -> None:
    """Two workers, another folder, scenarios stored in another order: the same bytes,
    no place or time.
    """
    shuffled = Path(shutil.copy(source, tmp_path))
    with h5py.File(shuffled, "r+") as file:
        for name in ("scenario", "position"):
            file[name][...] = file[name][...][::-1]
    reordered = bench.score(shuffled)
    assert reordered.header.scenarios == (4, 3)
    for card in (
        bench.score(source, workers=2, output_dir=tmp_path / "elsewhere"),
        reordered,
    ):
        for first, second in zip(standing.files, card.files, strict=True):
            assert first.read_bytes() == second.read_bytes()
    text = standing.files[0].read_text()
    assert str(bench.root) not in text
    assert str(source.parent) not in text


def test_a_wild_prediction_gets_finite_scores(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """Positions nine boxes away are scored and flagged; scores.json still is JSON
    without infinities.
    """

    def wild(truth: Any, n: int, h: int) -> Any:
        guess = np.array(straight(truth, n, h))
        guess[h // 2 :] += 9.0
        return guess

    card = bench.score(bench.submit(tmp_path / "predictions.nc", wild))
    entry = held(card)["rows"][SUBMISSION]["position_mse"]
    assert math.isfinite(entry["mean"])
    assert entry["mean"] > 40.0  # half of the frames are off by 9 along both axes
    assert {warning["check"] for warning in held(card)["warnings"]} >= {
        "in_domain",
        "max_displacement",
    }
    assert dict(held(card)["flags"])["physics"]["raised"]


def test_what_was_validated_is_not_validated_again(
    bench: ScoreBench,
    standing: ScoreCard,
    source: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same card, from the result of the validation; one of another file is
    refused.
    """
    found = validate(
        source, root=bench.root, require_truth=True, registry=bench.registry
    )
    monkeypatch.setattr(scoring, "validate", None)
    card = bench.evaluate(source, validated=found)
    assert card.predictions_sha256 == found.sha256 == standing.predictions_sha256
    assert card.as_json()["rows"] == standing.as_json()["rows"]
    with pytest.raises(UsageError):
        bench.evaluate(source.with_name("other.nc"), validated=found)


def test_progress_reaches_its_total(bench: ScoreBench, source: Path) -> None:
    """Every frame of every scenario is counted once, in this process and in workers."""
    for workers in (1, 2):
        seen: list[Progress] = []
        bench.evaluate(source, workers=workers, progress=seen.append)
        assert seen[-1].done == seen[-1].total == 2 * bench.size.task.horizon


@pytest.mark.usefixtures("as_shipped")
def test_invalid_predictions_are_refused(
    bench: ScoreBench, source: Path, tmp_path: Path
) -> None:
    """What the validation rejects is not scored and nothing is written; the listener
    saw why.
    """
    broken = Path(shutil.copy(source, tmp_path))
    with h5py.File(broken, "r+") as file:
        file["position"][0, 3, 5, 1] = np.nan
    seen: list[Any] = []
    with pytest.raises(ChecksFailedError) as caught:
        bench.score(broken, examined=seen.append)
    assert caught.value.where == "first in scenario 3, frame 9, particle 5, y"
    assert [finding.check for finding in seen[0].errors] == ["finite"]
    assert list(tmp_path.iterdir()) == [broken]


def test_without_what_the_score_needs(bench: ScoreBench, tmp_path: Path) -> None:
    """A root without the data set names the command which makes it; then statistics of
    train are lacking.
    """
    root = tmp_path / "root"
    path = bench.submit(tmp_path / "predictions.nc", still)
    assert validate(path, root=bench.root, registry=bench.registry).valid
    with pytest.raises(DataError) as caught:
        score(path, root=root, registry=bench.registry)
    assert caught.value.where.endswith("root/curl-noise/tiny/v2/test")
    for scenario in bench.size.subsets["test"]:
        held = bench.task.truth.path(scenario)
        target = root / held.relative_to(bench.root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(held, target)
    with pytest.raises(DataError):
        score(path, root=root, registry=bench.registry)


def test_optional_metrics_name_their_extra(bench: ScoreBench, source: Path) -> None:
    """Asking for Sinkhorn without POT names the extra that installs it; with it, it is
    scored.
    """
    with pytest.raises(UsageError) as caught:
        bench.evaluate(source, extras=("transprot",))
    assert caught.value.where == "--extras"
    if importlib.util.find_spec("ot") is None:
        with pytest.raises(UsageError):
            bench.evaluate(source, extras=("transport",))
    else:
        assert (
            bench.evaluate(source, extras=("transport",))
            .submission["sinkhorn_pot"]
            .mean
            > 0.0
        )
