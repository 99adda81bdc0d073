"""The scorer against closed answers, other routes to the same numbers, and itself."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from file_size_limit import largest_file
from numpy.testing import assert_allclose, assert_array_equal
from score_bench import ScoreBench, half_right, right, still, straight

from lagbench.errors import ChecksFailedError, DataError, UsageError, WorkFailedError
from lagbench.metrics import Direction, FramePair, Metric
from lagbench.scoring import score as scoring
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.front import digits
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.task import SUBMISSION
from lagbench.store.dataset import open_split
from lagbench.submission import validate
from lagbench.work.run import Progress


@pytest.fixture(scope="module")
def persistence_card(
    bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory
) -> ScoreCard:
    """The score card of persistence, written."""
    folder = tmp_path_factory.mktemp("persistence")
    path = bench.submit(folder / "predictions.nc", still)
    return bench.score(path)


@pytest.fixture
def predictions(persistence_card: ScoreCard) -> Path:
    """The predictions of persistence."""
    return persistence_card.files[0].parent / "predictions.nc"


def load_json(card: ScoreCard) -> dict[str, Any]:
    """Return the content of scores.json."""
    content: dict[str, Any] = json.loads(card.files[0].read_bytes())
    return content


def row_of_submission(content: dict[str, Any]) -> dict[str, Any]:
    """Return the row of the submission in scores.json."""
    row: dict[str, Any] = content["rows"][SUBMISSION]
    return row


@pytest.mark.slow
@pytest.mark.usefixtures("as_shipped")
def test_the_truth_scores_perfectly(bench: ScoreBench, tmp_path: Path) -> None:
    """It gets the perfect value of every metric that has one, and is suspect."""
    path = bench.submit(tmp_path / "predictions.nc", right)
    card = bench.evaluate(path)
    for name, score in card.submission.items():
        perfect = score.metric.perfect
        if perfect is not None:
            assert_allclose(score.values, perfect, atol=1e-12, err_msg=name)
    assert card.submission["stable_frames"].mean == bench.size.task.horizon
    raised = {flag.name for flag in card.flags if flag.raised}
    assert raised == {"copy_suspect", "below_twin_floor"}


@pytest.mark.parametrize(
    ("row", "predict"),
    [
        ("persistence", still),
        ("constant-velocity", straight),
    ],
)
def test_references_are_what_a_user_would_submit(
    bench: ScoreBench,
    tmp_path: Path,
    row: str,
    predict: Any,
) -> None:
    """A reference written as a predictions.nc scores exactly like the scorer's row."""
    path = bench.submit(tmp_path / "predictions.nc", predict)
    card = bench.evaluate(path)
    for name, score in card.submission.items():
        expected = card.scores[row][name]
        assert_array_equal(score.per_frame, expected.per_frame, err_msg=name)
        assert_array_equal(score.values, expected.values, err_msg=name)


def test_position_rmse_is_that_of_xarray(
    bench: ScoreBench, persistence_card: ScoreCard
) -> None:
    """From the arrays of the public loader: the root of the mean over frames."""
    size = bench.size
    first = size.task.input_frames
    predicted_frames = slice(first, first + size.task.horizon)
    with open_split(size.split, size=size.name, root=bench.root) as data:
        position = data["position"].astype("float64").compute()
    last_input = position.isel(frame=first - 1).drop_vars("frame")
    error = last_input - position.isel(frame=predicted_frames)
    mean_square = (error**2).mean(("frame", "particle", "space"))
    expected = np.sqrt(mean_square.values)
    rmse = persistence_card.submission["position_rmse"].values
    assert_allclose(rmse, expected, rtol=1e-6)


def test_json_has_the_scores_of_the_card(persistence_card: ScoreCard) -> None:
    """Means and values per scenario have nine digits."""
    rows = load_json(persistence_card)["rows"]
    references = ["persistence", "constant-velocity", "frozen-field", "analog"]
    assert list(rows) == [SUBMISSION, *references]
    for row, scores in persistence_card.scores.items():
        for name, score in scores.items():
            entry = rows[row][name]
            values = [digits(value) for value in score.values]
            assert entry["mean"] == digits(score.mean)
            assert entry["values"] == values
            assert entry["undefined"] == list(score.undefined)
            assert ("at" in entry) == score.metric.per_frame


def test_freezing_midway_leaves_frames_out(bench: ScoreBench, tmp_path: Path) -> None:
    """A rollout is right for 10 frames, then frozen for 10: Pearson is 1 over ten."""
    diverged_at = {3: 16, 4: 16}
    path = bench.submit(
        tmp_path / "predictions.nc", half_right, diverged_at=diverged_at
    )
    card = bench.evaluate(path)
    pearson = card.submission["vorticity_pearson"]
    assert_allclose(pearson.values, 1.0)
    assert pearson.undefined == (10, 10)
    assert card.submission["vorticity_rmse"].mean > 0.0
    assert card.as_json()["diverged_at"] == {"3": 16, "4": 16}


def read_score_files(folder: Path) -> dict[str, bytes]:
    """Return the content of scores.nc and scores.json by name."""
    return {path.name: path.read_bytes() for path in folder.glob("scores.*")}


@pytest.mark.parametrize("one_fits", [False, True])
def test_a_full_disk_leaves_both_files_as_they_were(
    bench: ScoreBench, tmp_path: Path, one_fits: bool
) -> None:
    """The scores.json always belongs to the scores.nc beside it."""
    path = bench.submit(tmp_path / "predictions.nc", half_right)
    bench.score(path)
    before = read_score_files(tmp_path)
    free_bytes = 2_000
    if one_fits:
        sizes = [len(content) for content in before.values()]
        free_bytes = sum(sizes) // 2
    bench.submit(path, still)
    with largest_file(free_bytes), pytest.raises(WorkFailedError):
        bench.score(path)
    assert read_score_files(tmp_path) == before


def assert_same_files(first: ScoreCard, second: ScoreCard) -> None:
    """Assert that the files of two cards have the same bytes."""
    for path, second_path in zip(first.files, second.files, strict=True):
        assert path.read_bytes() == second_path.read_bytes()


def assert_every_frame_counted_once(reports: list[Progress], bench: ScoreBench) -> None:
    """Assert that the last report is that of all frames of both scenarios."""
    assert reports[-1].total == 2 * bench.size.task.horizon
    assert reports[-1].done == reports[-1].total


@pytest.mark.slow
def test_workers_write_the_same_bytes(
    bench: ScoreBench,
    persistence_card: ScoreCard,
    predictions: Path,
    tmp_path: Path,
) -> None:
    """Another folder does not matter either; progress arrives from the workers."""
    reports: list[Progress] = []
    card = bench.score(
        predictions,
        workers=2,
        output_dir=tmp_path / "elsewhere",
        progress=reports.append,
    )
    assert_same_files(card, persistence_card)
    assert_every_frame_counted_once(reports, bench)


def test_the_order_of_scenarios_does_not_change_the_bytes(
    bench: ScoreBench,
    persistence_card: ScoreCard,
    predictions: Path,
    tmp_path: Path,
) -> None:
    reordered = Path(shutil.copy(predictions, tmp_path))
    with h5py.File(reordered, "r+") as file:
        for name in ("scenario", "position"):
            file[name][...] = file[name][...][::-1]
    card = bench.score(reordered)
    assert card.header.scenarios == (4, 3)
    assert_same_files(card, persistence_card)


def test_a_wild_prediction_gets_finite_scores(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """Positions nine boxes away are scored and flagged."""

    def wild(truth: Any, n: int, h: int) -> Any:
        positions = np.array(straight(truth, n, h))
        positions[h // 2 :] += 9.0
        return positions

    path = bench.submit(tmp_path / "predictions.nc", wild)
    card = bench.score(path)
    content = load_json(card)
    mean = row_of_submission(content)["position_mse"]["mean"]
    assert math.isfinite(mean)
    assert mean > 40.0  # half of the frames are off by 9 along both axes
    checks = {warning["check"] for warning in content["warnings"]}
    assert checks >= {"in_domain", "max_displacement"}
    assert content["flags"]["physics"]["raised"]


@pytest.mark.usefixtures("as_shipped")
def test_invalid_predictions_are_refused(
    bench: ScoreBench, predictions: Path, tmp_path: Path
) -> None:
    """Nothing is written, and the listener receives the reason."""
    broken = Path(shutil.copy(predictions, tmp_path))
    with h5py.File(broken, "r+") as file:
        file["position"][0, 3, 5, 1] = np.nan
    results: list[Any] = []
    with pytest.raises(ChecksFailedError) as caught:
        bench.score(broken, examined=results.append)
    assert "scenario 3, frame 9, particle 5, y" in str(caught.value)
    (result,) = results
    checks = [finding.check for finding in result.errors]
    assert checks == ["finite"]
    assert list(tmp_path.iterdir()) == [broken]


def test_a_root_without_the_data_set_is_an_error(
    bench: ScoreBench, tmp_path: Path
) -> None:
    path = bench.submit(tmp_path / "predictions.nc", still)
    assert validate(path, root=bench.root, registry=bench.registry).valid
    with pytest.raises(DataError) as caught:
        scoring.score(path, root=tmp_path / "root", registry=bench.registry)
    assert "root/curl-noise/tiny/v2/test" in str(caught.value)


def mean_height(pair: FramePair) -> float:
    """Mean height of the prediction [length]."""
    return float(pair.prediction.position[:, 1].mean())


def fall(pair: FramePair) -> float:
    """Return how far the prediction is below the truth."""
    return float(-pair.position_error[:, 1].mean())


FALL = Metric(
    name="fall",
    family="own",
    unit="length",
    direction=Direction.TARGET,
    perfect=0.0,
    source="own",
    summary="mean height that is lost",
    statistic=fall,
)


@pytest.mark.slow
def test_own_metrics_are_measured_without_a_package(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """A function is an observable of its name; a metric states more.

    Whoever reads the files later does not have them, and reads all others.
    """
    path = bench.submit(tmp_path / "predictions.nc", still)
    card = bench.score(path, metrics=[mean_height, FALL])
    truth = bench.truth(bench.size.subsets["test"][0])
    last = truth[bench.size.task.input_frames - 1]
    assert card.submission["mean_height"].values[0] == pytest.approx(last[:, 1].mean())
    assert card.submission["mean_height"].metric.direction is Direction.NONE
    assert card.submission["fall"].metric.unit == "length"
    assert "fall" in set(card.to_dataframe()["metric"])
    plain = bench.evaluate(path)
    assert set(card.submission) - set(plain.submission) == {"mean_height", "fall"}
    assert "fall" not in read_statistics(card.files[1]).scores()


@pytest.mark.parametrize(
    ("metrics", "options"),
    [
        (3, {}),
        (["vorticity_rmse"], {}),
        ([lambda pair: 0.0], {}),
        ([replace(FALL, name="position_rmse")], {}),
        ([FALL, FALL], {}),
        ([replace(FALL, statistic=None, of=("nothing",))], {}),
        ([FALL], {"workers": 2}),
        ([FALL], {"scheduler": "tcp://localhost:1"}),
        ((), {"extras": ("transprot",)}),
    ],
)
def test_what_is_no_own_metric_is_refused(
    bench: ScoreBench,
    tmp_path: Path,
    metrics: object,
    options: dict[str, object],
) -> None:
    """Nothing is scored before."""
    with pytest.raises(UsageError):
        bench.evaluate(tmp_path / "none.nc", metrics=metrics, **options)


def test_an_own_metric_that_fails_leaves_no_file_open(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """Though the traceback is kept, as in a notebook."""

    def broken(pair: FramePair) -> float:
        raise ValueError

    path = bench.submit(tmp_path / "predictions.nc", still)
    before = h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE)
    with pytest.raises(WorkFailedError) as caught:
        bench.evaluate(path, metrics=[broken])
    after = h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE)
    assert after == before
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("method", "another"),
        ("dataset_sha256", "ab" * 32),
        ("subset", "shift"),
    ],
)
def test_scores_of_another_submission_are_not_overwritten(
    bench: ScoreBench,
    persistence_card: ScoreCard,
    predictions: Path,
    tmp_path: Path,
    key: str,
    value: str,
) -> None:
    """Another method, data set or subset."""
    content = load_json(persistence_card) | {key: value}
    path = tmp_path / "scores.json"
    path.write_text(json.dumps(content))
    before = path.read_bytes()
    with pytest.raises(UsageError) as caught:
        bench.score(predictions, output_dir=tmp_path)
    assert caught.value.where == str(path)
    assert path.read_bytes() == before
