"""The scorer against closed answers, other routes to the same numbers, and itself."""

from __future__ import annotations

import importlib.util
import json
import math
import pickle
import re
import shutil
import sys
from collections import Counter
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from file_size_limit import largest_file
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from score_bench import ScoreBench, half_right, right, still, straight

from lagbench.errors import ChecksFailedError, DataError, UsageError, WorkFailedError
from lagbench.metrics import Direction, FramePair, Metric
from lagbench.scoring import score as scoring
from lagbench.scoring.card import ScoreCard, digits
from lagbench.scoring.published_scores import read_scores
from lagbench.scoring.scenario import SUBMISSION
from lagbench.scoring.score import scores_folder
from lagbench.scoring.score_file_checks import read_published_scores
from lagbench.scoring.tables import flag_lines
from lagbench.store.dataset import open_split
from lagbench.submission import validate
from lagbench.submission.predictions import Predictions
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


def test_a_score_card_can_be_pickled(persistence_card: ScoreCard) -> None:
    """It crosses process borders with all scores and metrics."""
    again = pickle.loads(pickle.dumps(persistence_card))
    assert again.as_json() == persistence_card.as_json()
    for name, score in persistence_card.submission.items():
        assert again.submission[name].metric is score.metric
        assert_array_equal(again.submission[name].per_frame, score.per_frame)


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


def test_a_card_is_shown_in_one_line(persistence_card: ScoreCard) -> None:
    """A notebook shows the method, the ranking metric and the skill."""
    text = repr(persistence_card)
    assert len(text) < 200
    assert persistence_card.header.method in text
    assert persistence_card.ranking in text
    assert str(persistence_card.skill) in text


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


def test_json_has_the_frames_of_interest_and_the_last(
    persistence_card: ScoreCard,
) -> None:
    content = load_json(persistence_card)
    config = persistence_card.config
    last = config.predicted_frames[-1]
    expected = {*config.frames_of_interest, last}
    frames = content["task"]["frames"]
    assert frames == sorted(expected)
    mse = row_of_submission(content)["position_mse"]
    assert list(mse["at"]) == [str(frame) for frame in frames]


def test_json_describes_the_metrics(persistence_card: ScoreCard) -> None:
    metric = load_json(persistence_card)["metrics"]["vorticity_rmse"]
    assert metric["family"] == "vorticity"
    assert metric["unit"] == "1/frame"
    assert metric["direction"] == "lower"
    assert metric["perfect"] == 0.0


def test_undefined_values_are_null_in_json(persistence_card: ScoreCard) -> None:
    """At rest there is no correlation in any frame of both scenarios."""
    content = load_json(persistence_card)
    pearson = row_of_submission(content)["vorticity_pearson"]
    horizon = persistence_card.config.horizon
    assert pearson["mean"] is None
    assert pearson["values"] == [None, None]
    assert pearson["undefined"] == [horizon, horizon]


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


def test_json_has_no_paths(
    bench: ScoreBench, persistence_card: ScoreCard, predictions: Path
) -> None:
    text = persistence_card.files[0].read_text()
    assert str(bench.root) not in text
    assert str(predictions.parent) not in text


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


def test_a_printed_warning_says_where(bench: ScoreBench, tmp_path: Path) -> None:
    """Its line names scenario, frames and particle of a jump."""

    def jumping(truth: Any, n: int, h: int) -> Any:
        positions = np.array(straight(truth, n, h))
        positions[3:, 7] += 9.0
        return positions

    path = bench.submit(tmp_path / "predictions.nc", jumping)
    card = bench.evaluate(path)
    printed = "\n".join(flag_lines(card))
    places = re.findall(r"warning \[max_displacement\] .* \((.*)\): ", printed)
    jumps = [each for each in card.warnings if each.check == "max_displacement"]
    assert places == [jump.where for jump in jumps]
    assert len(places) == 2
    assert all("particle 7" in place for place in places)


def test_a_validated_file_is_not_validated_again(
    bench: ScoreBench,
    persistence_card: ScoreCard,
    predictions: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The result of its validation gives the same card; that of another is refused."""
    validated = validate(
        predictions,
        root=bench.root,
        require_truth=True,
        registry=bench.registry,
    )
    monkeypatch.setattr(scoring, "validate", None)
    card = bench.evaluate(predictions, validated=validated)
    assert card.predictions_sha256 == validated.sha256
    assert card.predictions_sha256 == persistence_card.predictions_sha256
    rows = card.as_json()["rows"]
    assert rows == persistence_card.as_json()["rows"]
    other = predictions.with_name("other.nc")
    with pytest.raises(UsageError):
        bench.evaluate(other, validated=validated)


def test_scoring_reads_every_predicted_frame_once(
    bench: ScoreBench, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The validation, which is done before, reads the frames too."""
    validated = validate(
        predictions,
        root=bench.root,
        require_truth=True,
        registry=bench.registry,
    )
    reads: Counter[tuple[int, int]] = Counter()
    read_frames = Predictions.frames

    def count_and_read(
        self: Predictions, scenario: int, start: int, count: int
    ) -> NDArray[np.float32]:
        for frame in range(start, start + count):
            reads[scenario, frame] += 1
        return read_frames(self, scenario, start, count)

    monkeypatch.setattr(Predictions, "frames", count_and_read)
    bench.evaluate(predictions, validated=validated, workers=1)

    task = bench.size.task
    frames = range(task.input_frames, task.input_frames + task.horizon)
    assert reads == Counter(product(bench.size.subsets["test"], frames))


@pytest.mark.parametrize("workers", [0, -1])
def test_no_worker_cannot_score(
    workers: int, bench: ScoreBench, predictions: Path
) -> None:
    """Less than one is a mistake, also where one process does the work."""
    with pytest.raises(UsageError) as caught:
        bench.evaluate(predictions, workers=workers)
    assert caught.value.where == "--workers"


def test_progress_reaches_its_total(bench: ScoreBench, predictions: Path) -> None:
    reports: list[Progress] = []
    bench.evaluate(predictions, workers=1, progress=reports.append)
    assert_every_frame_counted_once(reports, bench)


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
    assert caught.value.where == "first in scenario 3, frame 9, particle 5, y"
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
    assert str(caught.value.where).endswith("root/curl-noise/tiny/v2/test")


def test_scenarios_without_statistics_of_train_are_not_enough(
    bench: ScoreBench, tmp_path: Path
) -> None:
    root = tmp_path / "root"
    path = bench.submit(tmp_path / "predictions.nc", still)
    for scenario in bench.size.subsets["test"]:
        source = bench.task.truth.path(scenario)
        target = root / source.relative_to(bench.root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, target)
    with pytest.raises(DataError):
        scoring.score(path, root=root, registry=bench.registry)


def test_a_misspelt_extra_is_refused(bench: ScoreBench, predictions: Path) -> None:
    with pytest.raises(UsageError) as caught:
        bench.evaluate(predictions, extras=("transprot",))
    assert caught.value.where == "--extras"


def test_an_extra_that_is_not_installed_is_refused_before_the_work(
    bench: ScoreBench, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is validated or measured first."""
    monkeypatch.setitem(sys.modules, "ot", None)
    seen: list[object] = []
    with pytest.raises(UsageError) as caught:
        bench.evaluate(
            predictions,
            extras=("transport",),
            examined=seen.append,
            progress=seen.append,
        )
    assert "lagbench[transport]" in str(caught.value.fix)
    assert seen == []


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("ot") is None, reason="needs the extra transport"
)
def test_an_extra_brings_its_metrics(bench: ScoreBench, predictions: Path) -> None:
    card = bench.evaluate(predictions, extras=("transport",))
    assert card.submission["sinkhorn_pot"].mean > 0.0


def test_a_card_becomes_a_table_of_values(bench: ScoreBench, tmp_path: Path) -> None:
    """Each value of a row, a metric and a scenario has a line."""
    path = bench.submit(tmp_path / "predictions.nc", half_right)
    card = bench.evaluate(path)
    table = card.to_dataframe()
    is_submission = table.row == "submission"
    is_ranking = table.metric == card.ranking
    lines = table[is_submission & is_ranking]
    assert lines.scenario.tolist() == list(card.scenarios)
    expected = card.submission[card.ranking].mean
    assert lines.value.mean() == pytest.approx(expected)
    assert set(table.row) == set(card.scores)


def test_a_card_in_a_notebook_is_escaped(bench: ScoreBench, tmp_path: Path) -> None:
    """The name of the method comes from strangers."""
    method = "<img src=x>"
    path = bench.submit(tmp_path / "predictions.nc", half_right, method=method)
    card = bench.evaluate(path)
    page = card._repr_html_()
    assert "&lt;img src=x&gt;" in page
    assert "<img" not in page
    assert card.ranking in page


def test_predictions_for_another_split_are_refused(
    bench: ScoreBench, tmp_path: Path
) -> None:
    path = bench.submit(tmp_path / "predictions.nc", half_right)
    with pytest.raises(UsageError) as caught:
        bench.evaluate(path, split="fluid")
    assert "fluid" in str(caught.value)
    card = bench.evaluate(path, split=bench.size.split)
    assert card.skill is not None


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
    for file in card.files:
        read = read_scores if file.suffix == ".json" else read_published_scores
        assert "fall" not in read(file).scores[SUBMISSION]


@pytest.mark.slow
def test_one_own_metric_needs_no_list(bench: ScoreBench, tmp_path: Path) -> None:
    path = bench.submit(tmp_path / "predictions.nc", right)
    card = bench.evaluate(path, metrics=FALL)
    assert card.submission["fall"].mean == 0.0


@pytest.mark.slow
def test_an_own_metric_may_follow_from_others(
    bench: ScoreBench, tmp_path: Path
) -> None:
    path = bench.submit(tmp_path / "predictions.nc", still)
    doubled = replace(
        FALL,
        name="doubled",
        statistic=None,
        of=["fall"],  # type: ignore[arg-type] # a list is as good as a tuple
        series=lambda values: 2.0 * values,
    )
    card = bench.evaluate(path, metrics=[FALL, doubled])
    fallen = card.submission["fall"].mean
    assert card.submission["doubled"].mean == pytest.approx(2.0 * fallen)


@pytest.mark.parametrize(
    ("metrics", "options"),
    [
        (3, {}),
        ([3], {}),
        ([np], {}),
        ([object()], {}),
        ("vorticity_rmse", {}),
        (["vorticity_rmse"], {}),
        ([lambda pair: 0.0], {}),
        ([replace(FALL, name="position_rmse")], {}),
        ([FALL, FALL], {}),
        ([replace(FALL, statistic=None, of=("nothing",))], {}),
        ([FALL], {"workers": 2}),
        ([FALL], {"scheduler": "tcp://localhost:1"}),
    ],
)
def test_what_is_no_own_metric_is_refused(
    bench: ScoreBench,
    tmp_path: Path,
    metrics: object,
    options: dict[str, object],
) -> None:
    """Nothing is scored before."""
    with pytest.raises(UsageError) as caught:
        bench.evaluate(tmp_path / "none.nc", metrics=metrics, **options)
    error = caught.value
    assert None not in (error.where, error.expected, error.got, error.fix)


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


@pytest.mark.parametrize("metrics", ["vorticity_rmse", ["vorticity_rmse"]])
def test_a_built_in_metric_needs_no_argument(
    bench: ScoreBench, tmp_path: Path, metrics: object
) -> None:
    with pytest.raises(UsageError) as caught:
        bench.evaluate(tmp_path / "none.nc", metrics=metrics)
    assert "metrics=" in str(caught.value.fix)


@pytest.mark.slow
def test_the_own_metric_of_the_docs_is_measured(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """The example of docs/extending.md runs as it stands; its scorer is the bench."""
    page = Path(__file__).parents[2] / "docs" / "extending.md"
    found = re.search(
        r"```python\n(import numpy as np\n\nimport lagbench\n.*?)```",
        page.read_text(),
        re.DOTALL,
    )
    assert found is not None
    program, call = found[1].split("\ncard = ")
    names: dict[str, Any] = {}
    exec(program, names)
    assert "metrics=[mean_height_error]" in call
    path = bench.submit(tmp_path / "predictions.nc", right)
    card = bench.evaluate(path, metrics=[names["mean_height_error"]])
    assert card.submission["mean_height_error"].mean == 0.0


def test_scores_stay_out_of_the_folder_of_a_split(tmp_path: Path) -> None:
    """Predictions that are named after their local split are scored beside it."""
    predictions = tmp_path / "own.nc"
    assert scores_folder(predictions) == tmp_path / "own"
    (tmp_path / "own").mkdir()
    assert scores_folder(predictions) == tmp_path / "own"
    (tmp_path / "own" / "split.yaml").write_text("format: 1\n")
    assert scores_folder(predictions) == tmp_path / "own-scores"


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
    """Another method, data set or subset; the message tells them apart."""
    content = load_json(persistence_card) | {key: value}
    path = tmp_path / "scores.json"
    path.write_text(json.dumps(content))
    before = path.read_bytes()
    with pytest.raises(UsageError) as caught:
        bench.score(predictions, output_dir=tmp_path)
    assert caught.value.where == str(path)
    assert value in str(caught.value.got)
    assert value not in str(caught.value.expected)
    assert path.read_bytes() == before
