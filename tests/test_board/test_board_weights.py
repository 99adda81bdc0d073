"""Weights beside their entries: copied by submit, hashed by check, used by predict."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import pytest
from board_bench import BoardBench, copied, nearer, noisy, still
from file_size_limit import largest_file
from onnx_files import straight_on
from simple_models import INFO, Drift, install

from lagbench.baselines.checkpoint import Checkpoint, load, round_weights, save
from lagbench.board import submit as submitting
from lagbench.board import weights as kept
from lagbench.board.check import check_board
from lagbench.board.entry import EntryBudget, Meta
from lagbench.board.entry_file import read_entry
from lagbench.board.publish import SubmitResult
from lagbench.board.submit import submit
from lagbench.board.weights import LogLeftOutWarning
from lagbench.data.checksums import file_sha256
from lagbench.errors import (
    ChecksFailedError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.references.predictor import Kind
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.submission import open_predictions
from lagbench.submission.budget import Budget

WEIGHTS = Path(__file__).parents[2] / "leaderboard/weights"
"""Weights of the committed leaderboard."""


BUDGET = Budget(
    windows=48,
    epochs=0.5,
    steps=6,
    cpu_hours=0.1,
    gpu_hours=0.0,
)


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard."""
    return copied(home, tmp_path)


KEPT = "weights/cavity/tiny/drift_0"
GLIDE = "weights/cavity/tiny/glide_0"
"""Weights and record of a run, and those of another method, without their endings."""

OURS = "cavity tiny train, recipe cavity/tiny, step 6"
"""What `lagbench predict` says of the training of `trained`."""

COUNT = 1  # parameters of that model


def trained(
    own: BoardBench,
    seed: int,
    training: str | None = OURS,
    parameters: int | None = None,
    share: float = 0.6,
) -> Path:
    """Write the weights of a run, with its record beside them and its predictions."""
    folder = own.folder.parent / f"drift-{seed}-{share}"
    folder.mkdir()
    labels: dict[str, Any] = {
        "seed": seed,
        "budget": BUDGET.model_dump_json(),
    }
    if training is not None:
        labels["training"] = training
    if parameters is not None:
        labels["parameters"] = parameters

    def between(truth: Any, given: int, horizon: int) -> Any:
        future = truth[given : given + horizon]
        error = noisy(truth, given, horizon) - future
        return future + (share + 0.1 * seed) * error

    predictions = own.predict(between, "drift", **labels)
    predictions.rename(folder / "predictions.nc")
    with open_predictions(folder / "predictions.nc") as opened:
        header = opened.header
    info = replace(
        INFO,
        split=header.split,
        size=header.size,
        dataset_sha256=header.dataset_sha256,
    )
    recipe = {
        "name": "cavity/tiny",
        "training": {"seed": seed},
    }
    model = Drift.build({}, info)
    checkpoint = Checkpoint(
        baseline="drift",
        options={},
        info=info,
        weights=round_weights(model),
        training={"step": 6, "recipe": recipe},
    )
    save(folder / "weights.safetensors", checkpoint)
    write_record(folder, {"step": 6})
    return folder


def write_record(folder: Path, content: dict[str, Any]) -> None:
    """Write the record of a run."""
    text = json.dumps(content)
    (folder / "training.json").write_text(text)


def submitted(
    own: BoardBench,
    *folders: Path,
    weights: tuple[Path, ...] | None = None,
    method: str | None = None,
    kind: Kind | None = None,
    **options: Any,
) -> SubmitResult:
    """Submit the predictions of runs, with their weights unless others are given."""
    files = [folder / "predictions.nc" for folder in folders]
    if weights is None:
        weights = tuple(folder / "weights.safetensors" for folder in folders)
    keys: dict[str, Any] = {}
    if kind is not None:
        keys["kind"] = kind
    meta = Meta(
        authors=("A. Author",),
        command="make",
        method=method,
        name=method,
        **keys,
    )
    return submit(files, meta, weights=weights, **own.where, **options)


def resubmitted(own: BoardBench, *folders: Path, **options: Any) -> SubmitResult:
    """Replace an entry by one with the weights that the board has."""
    return submitted(own, *folders, weights=(), replace=True, **options)


First = tuple[BoardBench, Path]


@pytest.fixture(scope="module")
def first_submission(home: Path, tmp_path_factory: pytest.TempPathFactory) -> First:
    """A leaderboard with the entry of a run and its weights, and the run.

    Do not change the files.
    """
    folder = tmp_path_factory.mktemp("first")
    bench = copied(home, folder)
    run = trained(bench, 0)
    submitted(bench, run)
    return bench, run


@pytest.fixture
def first(own: BoardBench, first_submission: First) -> Path:
    """A run whose entry is on the board, with its weights."""
    bench, run = first_submission
    shutil.copytree(bench.folder, own.folder, dirs_exist_ok=True)
    own_run = own.folder.parent / run.name
    shutil.copytree(run, own_run)
    return own_run


def hashes(own: BoardBench, method: str = "drift") -> list[str | None]:
    """Return the SHA-256 of the weights of each seed, as the entry has them."""
    weight_hashes: list[str | None] = []
    entry = read_entry(own.entry(method))
    for prediction in entry.predictions:
        if prediction.weights is None:
            weight_hashes.append(None)
        else:
            weight_hashes.append(prediction.weights.sha256)
    return weight_hashes


def kept_files(own: BoardBench) -> dict[str, bytes]:
    """Return name and content of the weights and records on the board."""
    contents = {}
    for path in (own.folder / "weights").rglob("*.*"):
        contents[path.name] = path.read_bytes()
    return contents


def kept_weights(own: BoardBench) -> Path:
    """Return the file of the weights on the board."""
    return own.folder / f"{KEPT}.safetensors"


def claim(own: BoardBench, path: str, source: Path) -> None:
    """Let the entry glide name a file as its weights, with the hash of another."""
    weights = {
        "path": path,
        "sha256": file_sha256(source),
    }

    def name_weights(entry: dict[str, Any]) -> None:
        prediction = entry["predictions"][0]
        prediction["weights"] = weights

    own.edit("glide", name_weights)


def failing_checks(own: BoardBench) -> set[str]:
    """Return the names of the checks that find something."""
    result = check_board(own.folder, registry=own.registry, page=False, isolated=False)
    return {finding.check for finding in result.findings}


def assert_sound(own: BoardBench) -> None:
    """Assert that no check finds anything."""
    assert failing_checks(own) == set()


@pytest.mark.slow
def test_weights_lie_beside_their_entry(own: BoardBench) -> None:
    """Weights and records of both seeds are copied and named by hash, and the entry has
    their mean budget.

    They go to their seeds in any order, and of some only; those of others stay while
    the predictions do.
    """
    runs = [trained(own, 0), trained(own, 3)]
    submitted(own, *runs)
    entry = read_entry(own.entry("drift"))
    seeds = (0, 3)
    for run, prediction, seed in zip(runs, entry.predictions, seeds, strict=True):
        assert prediction.weights is not None
        assert (
            prediction.weights.path == f"weights/cavity/tiny/drift_{seed}.safetensors"
        )
        file = own.folder / prediction.weights.path
        weights = (run / "weights.safetensors").read_bytes()
        assert file.read_bytes() == weights
        assert file_sha256(file) == prediction.weights.sha256
        assert prediction.budget == BUDGET
        record_text = file.with_suffix(".json").read_text()
        record = json.loads(record_text)
        assert record == {"step": 6}
    assert entry.budget is not None
    assert entry.budget.windows == 48
    assert entry.budget.cpu_hours == 0.1
    assert entry.budget.track is None  # tiny has none
    assert_sound(own)
    first, second = (run / "weights.safetensors" for run in runs)
    first_hash = file_sha256(first)
    second_hash = file_sha256(second)
    own.entry("drift").unlink()
    submitted(own, *runs, weights=(second, first))
    assert hashes(own) == [first_hash, second_hash]
    submitted(own, *runs, weights=(second,), replace=True)
    assert hashes(own) == [first_hash, second_hash]
    own.entry("drift").unlink()
    submitted(own, *runs, weights=(second,))
    assert hashes(own) == [None, second_hash]
    kept_weights(own).unlink()
    kept_weights(own).with_suffix(".json").unlink()
    assert_sound(own)


@pytest.mark.slow
def test_a_later_entry_takes_its_files_along(own: BoardBench, first: Path) -> None:
    """Weights stay with their predictions, and go with them: an entry leaves none
    behind.
    """
    before = kept_files(own)
    file = kept_weights(own)
    record = file.with_suffix(".json")
    assert json.loads(before["drift_0.json"]) == {"step": 6}
    # those of the board, told or not, keep their record
    for weights in ((), (file,)):
        again = submitted(own, first, weights=weights, replace=True)
        assert kept_files(own) == before
        assert again.removed == ()
        assert {file, record} <= {*again.kept, *again.files}
        assert_sound(own)
    # new weights without a record leave none of the old
    (first / "training.json").unlink()
    without_record = submitted(own, first, replace=True)
    assert without_record.removed == (record,)
    assert without_record.kept == ()
    assert list(kept_files(own)) == ["drift_0.safetensors"]
    assert_sound(own)
    other = trained(own, 0, share=0.3)
    later = resubmitted(own, other)
    assert later.removed == (file,)
    assert kept_files(own) == {}
    assert_sound(own)


@pytest.mark.slow
def test_an_onnx_file_without_a_record_leaves_no_old_record(own: BoardBench) -> None:
    """The record of the file before does not stay beside the new one."""
    run = trained(own, 0, training=None)
    model = straight_on(run / "lines.onnx")
    submitted(own, run, weights=(model,))
    assert sorted(kept_files(own)) == ["drift_0.json", "drift_0.onnx"]
    (run / "training.json").unlink()
    submitted(own, run, weights=(model,), replace=True)
    assert list(kept_files(own)) == ["drift_0.onnx"]
    assert_sound(own)


@pytest.mark.slow
def test_a_record_with_the_name_of_the_weights_comes_first(own: BoardBench) -> None:
    """Weights of several seeds may lie in one folder, beside the record of a run."""
    run = trained(own, 0)
    weights = (run / "weights.safetensors").rename(run / "drift_0.safetensors")
    (run / "drift_0.json").write_text(json.dumps({"step": 7}))
    submitted(own, run, weights=(weights,))
    assert json.loads(kept_files(own)["drift_0.json"]) == {"step": 7}


@pytest.mark.parametrize("damage", ["lost", "edited", "linked"])
def test_only_sound_weights_are_kept(own: BoardBench, first: Path, damage: str) -> None:
    """What is wrong with those of before is mended by submitting anew."""
    file = kept_weights(own)
    file.unlink()
    if damage == "edited":
        file.write_bytes(b"1")
    if damage == "linked":
        file.symlink_to(first / "weights.safetensors")
    resubmitted(own, first)
    assert hashes(own) == [None]
    assert_sound(own)


def test_weights_of_another_are_not_kept(own: BoardBench, first: Path) -> None:
    """Nor those that lie elsewhere: what the old entry says of them is not believed."""
    second = trained(own, 0, share=0.3)
    submitted(own, second, weights=(), method="glide")
    source = kept_weights(own)
    target = own.folder / f"{GLIDE}.safetensors"
    target.write_bytes(source.read_bytes())
    for path, is_alone in (
        (GLIDE, False),
        (KEPT, False),
        (KEPT, True),
    ):
        if is_alone:
            target.unlink(missing_ok=True)
            own.entry("drift").unlink()  # nobody else's now, and still not in its place
        claim(own, f"{path}.safetensors", source)
        resubmitted(own, second, method="glide")
        assert hashes(own, "glide") == [None]


def supersede(entry: dict[str, Any]) -> None:
    """Let an entry name its successor."""
    entry["status"] = "superseded"
    entry["superseded_by"] = "glide"


def test_a_new_name_takes_the_weights_along(own: BoardBench, first: Path) -> None:
    """A superseded entry and its successor have one file of weights each, with the same
    bytes.
    """
    own.edit("drift", supersede)
    submitted(own, first, method="glide")
    assert_sound(own)


def test_no_link_leads_out_of_the_board(own: BoardBench, tmp_path: Path) -> None:
    """Nothing is written behind one; the entry before stays."""
    run = trained(own, 0)
    submitted(own, run, weights=())
    weights = own.folder / "weights"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    weights.symlink_to(elsewhere)
    before = own.state()
    with pytest.raises(UsageError) as caught:
        submitted(own, run, replace=True)
    assert caught.value.where == str(weights)
    assert own.state() == before
    assert list(elsewhere.iterdir()) == []
    weights.unlink()
    submitted(own, run, replace=True)
    weights.rename(elsewhere / "weights")
    weights.symlink_to(elsewhere / "weights")
    files_before = sorted(elsewhere.rglob("*.*"))
    other = trained(own, 0, share=0.3)
    with pytest.raises(UsageError):
        resubmitted(own, other)
    assert sorted(elsewhere.rglob("*.*")) == files_before


def test_an_idle_place_that_cannot_be_cleared(own: BoardBench, first: Path) -> None:
    """A folder in the place of a record is an error before any file moves. A broken
    link is removed.
    """
    records = (own.folder / "weights").rglob("*.json")
    record = next(records)
    record.unlink()
    record.mkdir()
    second = trained(own, 0, share=0.3)
    before = own.state()
    (second / "training.json").unlink()
    with pytest.raises(WorkFailedError):
        submitted(own, second, replace=True)
    assert own.state() == before
    record.rmdir()
    nowhere = own.folder.parent / "nowhere"
    record.symlink_to(nowhere)
    result = submitted(own, second, replace=True)
    assert result.removed == (record,)
    assert not record.is_symlink()


def test_a_full_disk_leaves_the_entry_before(own: BoardBench, first: Path) -> None:
    """Score files fit, weights do not: nothing of the old entry is lost, nothing of the
    new one is there.
    """
    second = trained(own, 0, share=0.3)
    before = own.state()
    long_note = "x" * (kept.MOST_LOG_BYTES - 100)
    write_record(second, {"step": 6, "note": long_note})
    score_files = (own.folder / "scores").rglob("drift*")
    largest_score_file = max(path.stat().st_size for path in score_files)
    room = 1000 + largest_score_file
    record = second / "training.json"
    assert room < record.stat().st_size
    with largest_file(room), pytest.raises(WorkFailedError):
        submitted(own, second, replace=True)
    assert own.state() == before


@pytest.mark.parametrize(
    ("training", "parameters", "fits"),
    [
        (OURS, None, True),
        (f"{OURS}, predicted with model.average=true", None, True),
        ("three nights on my own cluster", COUNT, True),
        (None, COUNT, True),
        (OURS, COUNT + 1, False),
        ("three nights on my own cluster", None, False),
        (None, None, False),
        (f"{OURS}0", None, False),
        ("cavity tiny train, recipe cavity/tiny-change, step 6", None, False),
        (f"{OURS}, model.target=change", None, False),
    ],
)
def test_weights_are_those_of_the_predictions(
    own: BoardBench,
    training: str | None,
    parameters: int | None,
    fits: bool,
) -> None:
    """Training in words and parameters are those of the weights; the number
    distinguishes GNS from SuperGAT.
    """
    run = trained(own, 0, training, parameters)
    if fits:
        submitted(own, run)
        return
    with pytest.raises(UsageError) as caught:
        submitted(own, run)
    assert caught.value.where == str(run / "weights.safetensors")


@pytest.mark.parametrize(
    ("change", "fits"),
    [
        ("", True),
        (", model.noise_std=0.001", False),
    ],
)
def test_seeds_differ_in_nothing_else(own: BoardBench, change: str, fits: bool) -> None:
    """The step of the best weights is each seed's own; a changed recipe is another
    method.
    """
    words = "cavity tiny train, recipe cavity/tiny, step"
    first = trained(own, 0, f"{words} 6")
    second = trained(own, 3, f"{words} 9{change}")
    refusal = pytest.raises(UsageError, match=r"noise_std")
    with nullcontext() if fits else refusal:
        submitted(own, first, second, weights=())


@pytest.mark.usefixtures("first")
def test_weights_of_another_entry_are_refused(own: BoardBench) -> None:
    """They lie on the board already; where they came by hand, the check finds them."""
    second = trained(own, 0, share=0.3)
    with pytest.raises(UsageError) as caught:
        submitted(own, second, method="glide")
    assert caught.value.where == str(second / "weights.safetensors")
    submitted(own, second, weights=(), method="glide")
    source = kept_weights(own)
    target = own.folder / f"{GLIDE}.safetensors"
    target.write_bytes(source.read_bytes())
    claim(own, f"{GLIDE}.safetensors", source)
    assert failing_checks(own) == {"weights"}


AVERAGED = f"{OURS}, predicted with model.average=true"


def share(own: BoardBench) -> None:
    """Submit predictions that another option made, with the weights of an entry."""
    run = trained(own, 0, AVERAGED, share=0.3)
    submitted(own, run, weights=(kept_weights(own),), method="glide")


@pytest.mark.usefixtures("first")
def test_an_entry_shares_the_weights_of_another(own: BoardBench) -> None:
    """It predicts with other options, so both are sound, and the file lies there once;
    the page leads to it.
    """
    before = kept_files(own)
    share(own)
    assert kept_files(own) == before
    entry = read_entry(own.entry("glide"))
    (weights,) = [prediction.weights for prediction in entry.predictions]
    assert weights is not None
    assert weights.shared_with == "cavity/tiny/drift"
    assert own.folder / weights.path == kept_weights(own)
    assert weights.sha256 == file_sha256(kept_weights(own))
    assert entry.provenance is not None
    assert entry.provenance.prediction_overrides == ("model.average=true",)
    assert Path(weights.path) not in entry.files
    assert_sound(own)


@pytest.mark.slow
@pytest.mark.usefixtures("first")
def test_shared_weights_stay_those_of_the_entry_that_keeps_them(
    own: BoardBench,
) -> None:
    """The check finds it where that entry has other weights, or is gone; and where the
    predictions are made in the same way.
    """
    share(own)
    glide = own.entry("glide")
    shared = glide.read_text()
    own.edit("glide", lambda entry: entry["predictions"][0].pop("provenance", None))
    glide.write_text(glide.read_text().replace(AVERAGED, OURS))
    assert failing_checks(own) == {"weights"}

    glide.write_text(shared)
    assert_sound(own)
    other = "0" * 64
    own.edit(
        "drift",
        lambda entry: entry["predictions"][0]["weights"].update(sha256=other),
    )
    assert failing_checks(own) == {"weights"}

    glide.write_text(shared.replace("cavity/tiny/drift", "cavity/tiny/nobody"))
    assert failing_checks(own) == {"weights"}


@pytest.mark.usefixtures("first")
def test_weights_that_another_entry_shares_are_not_replaced(own: BoardBench) -> None:
    share(own)
    before = own.state()
    other = trained(own, 0, share=0.5)
    with pytest.raises(UsageError, match="another entry predicts"):
        submitted(own, other, weights=(), replace=True)
    assert own.state() == before


@pytest.mark.usefixtures("first")
def test_shared_weights_are_used_in_one_way_once(own: BoardBench) -> None:
    """Two entries that share weights with the same options are found, and so is one of
    another split.
    """
    share(own)
    twin = own.entry("glide").with_name("slide.yaml")
    words = own.entry("glide").read_text().replace("method: glide", "method: slide")
    twin.write_text(words)
    result = check_board(own.folder, registry=own.registry, page=False, isolated=False)
    uses = [found for found in result.findings if "used as in" in str(found)]
    assert len(uses) == 1
    twin.unlink()
    assert_sound(own)


@pytest.mark.usefixtures("first")
def test_an_option_with_its_default_is_no_other_option(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`submit` refuses shared weights with it, and the check finds an entry that was
    written by hand.
    """
    install(monkeypatch, drift=Drift)
    run = trained(own, 0, f"{OURS}, predicted with model.fail_at=0", share=0.3)
    before = own.state()
    with pytest.raises(UsageError, match="in the same way"):
        submitted(own, run, weights=(kept_weights(own),), method="glide")
    assert own.state() == before

    other = trained(own, 0, f"{OURS}, predicted with model.fail_at=1000", share=0.4)
    submitted(own, other, weights=(kept_weights(own),), method="glide")
    assert_sound(own)
    glide = own.entry("glide")
    words = glide.read_text()
    for setting in ("fail_at=0", "fall_at=1000"):
        glide.write_text(words.replace("fail_at=1000", setting))
        assert failing_checks(own) == {"weights"}


@pytest.mark.usefixtures("first")
def test_one_option_in_two_spellings_is_one(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, drift=Drift)
    weights = (kept_weights(own),)
    first = trained(own, 0, f"{OURS}, predicted with model.start=2", share=0.3)
    submitted(own, first, weights=weights, method="glide")
    second = trained(own, 0, f"{OURS}, predicted with model.start=2.0", share=0.4)
    with pytest.raises(UsageError, match=r"glide\.yaml"):
        submitted(own, second, weights=weights, method="slide")
    third = trained(own, 0, f"{OURS}, predicted with model.start=3", share=0.5)
    submitted(own, third, weights=weights, method="slide")
    assert_sound(own)
    slide = own.entry("slide")
    slide.write_text(slide.read_text().replace("start=3", "start=2.0"))
    assert failing_checks(own) == {"weights"}


@pytest.mark.parametrize(
    ("setting", "is_known"),
    [
        ("model.fail_at=1000", True),
        ("model.fail_at=many", False),
        ("model.nonsense=true", False),
        ("training.steps=3", False),
        ("nonsense", False),
    ],
)
@pytest.mark.usefixtures("first")
def test_options_that_the_model_does_not_take_are_found(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch, setting: str, is_known: bool
) -> None:
    """Also in an entry that shares its weights with no other; where the model is not
    installed, nobody can say.
    """

    def predict_otherwise(entry: dict[str, Any]) -> None:
        entry["predictions"][0].pop("provenance", None)
        entry["training"] = f"{OURS}, predicted with {setting}"

    own.edit("drift", predict_otherwise)
    assert_sound(own)
    install(monkeypatch, drift=Drift)
    assert failing_checks(own) == (set() if is_known else {"weights"})


@pytest.mark.usefixtures("first")
def test_weights_of_another_data_set_are_found(own: BoardBench) -> None:
    """The training that the predictions state is that of the entry's data set."""
    for place in ("fluid tiny", "cavity mini"):

        def train_elsewhere(entry: dict[str, Any], place: str = place) -> None:
            entry["predictions"][0].pop("provenance", None)
            entry["training"] = OURS.replace("cavity tiny", place)

        own.edit("drift", train_elsewhere)
        assert failing_checks(own) == {"training"}


def test_options_that_the_model_does_not_take_are_not_submitted(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, drift=Drift)
    run = trained(own, 0, f"{OURS}, predicted with model.nonsense=1")
    before = own.state()
    with pytest.raises(UsageError) as caught:
        submitted(own, run)
    assert "model.nonsense" in str(caught.value.got)
    assert own.state() == before


@pytest.mark.slow
@pytest.mark.parametrize("change", ["supersede", "withdraw"])
def test_a_successor_takes_over_the_weights_of_an_inactive_entry(
    own: BoardBench, first: Path, change: str
) -> None:
    """It shares the file that lies there, with the same predictions; not while the
    other entry is active.
    """
    weights = (kept_weights(own),)
    with pytest.raises(UsageError):
        submitted(own, first, weights=weights, method="glide")
    own.edit("drift", supersede if change == "supersede" else withdraw)
    before = kept_files(own)
    submitted(own, first, weights=weights, method="glide")
    assert kept_files(own) == before
    entry = read_entry(own.entry("glide"))
    assert entry.predictions[0].weights is not None
    assert entry.predictions[0].weights.shared_with == "cavity/tiny/drift"
    assert_sound(own)

    # a third entry cannot use them in the same way
    other = trained(own, 0, share=0.3)
    for given in (weights[0], first / "weights.safetensors"):
        with pytest.raises(UsageError, match="in the same way"):
            submitted(own, other, weights=(given,), method="slide")
    # nor can both be active
    own.edit("drift", restore)
    own.edit("drift", lambda content: content.pop("superseded_by", None))
    assert "weights" in failing_checks(own)


def test_only_the_file_on_the_board_is_shared(own: BoardBench, first: Path) -> None:
    """A copy of it is refused, and so are predictions with the same options."""
    otherwise = trained(own, 0, AVERAGED, share=0.3)
    alike = trained(own, 0, share=0.4)
    before = own.state()
    for run, weights in (
        (otherwise, first / "weights.safetensors"),
        (alike, kept_weights(own)),
    ):
        with pytest.raises(UsageError, match="another entry"):
            submitted(own, run, weights=(weights,), method="glide")
    assert own.state() == before


def test_other_weights_are_refused(own: BoardBench) -> None:
    """Weights of another seed, one twice, a state to go on from, files that are none;
    nothing is written.
    """
    run = trained(own, 0)
    other_run = trained(own, 3)
    before = own.state()
    first = run / "weights.safetensors"
    second = other_run / "weights.safetensors"
    state = run / "checkpoint.safetensors"
    to_go_on_from = replace(load(first), optimizer={"a/step": load(first).weights["a"]})
    save(state, to_go_on_from)
    for folders, weights in (
        ([run], (second,)),
        ([run, other_run], (first, first)),
        ([run], (state,)),
    ):
        with pytest.raises(UsageError) as caught:
            submitted(own, *folders, weights=weights)
        assert caught.value.where == str(weights[0])
    no_weights = run / "training.json"
    with pytest.raises(UnreadableFileError):
        submitted(own, run, other_run, weights=(first, no_weights))
    assert own.state() == before


def test_weights_of_a_hybrid_are_not_those_of_a_learned_model(own: BoardBench) -> None:
    """The kind of an entry is what its submitter says; these weights say otherwise."""
    run = trained(own, 0)
    hybrid = WEIGHTS / "cavity/mini/hybrid-projection_0.safetensors"
    before = own.state()
    with pytest.raises(UsageError) as caught:
        submitted(own, run, weights=(hybrid,))
    assert str(caught.value.where).startswith("kind")
    assert own.state() == before


def test_a_log_of_a_hybrid_is_not_that_of_a_learned_model(own: BoardBench) -> None:
    """An entry that was written by hand is found."""
    run = trained(own, 0)
    write_record(run, {"step": 6, "baseline": "hybrid-coarse"})
    submitted(own, run)
    assert failing_checks(own) == {"training"}


def test_a_refused_addition_says_nothing_of_the_kind(own: BoardBench) -> None:
    """The entry that the weights would belong to is not known."""
    hybrid = WEIGHTS / "cavity/mini/hybrid-projection_0.safetensors"
    run = trained(own, 0)
    with pytest.raises(UsageError) as caught:
        submitted(own, run, weights=(hybrid,), add=True)
    assert "kind" not in str(caught.value)


def test_more_seeds_have_the_kind_of_their_entry(own: BoardBench) -> None:
    """So weights of a hybrid are refused for what else is wrong with them."""
    hybrid = WEIGHTS / "cavity/mini/hybrid-projection_0.safetensors"
    submitted(own, trained(own, 0), weights=(), kind=Kind.HYBRID)
    run = trained(own, 3)
    with pytest.raises(UsageError) as caught:
        submitted(own, run, weights=(hybrid,), add=True)
    assert caught.value.where == str(hybrid)


Damage = Callable[[BoardBench], object]


def put(end: str, data: bytes) -> Damage:
    """Return what writes the weights or the record of the run anew."""
    return lambda own: (own.folder / f"{KEPT}.{end}").write_bytes(data)


def edit_weights(own: BoardBench) -> None:
    """Change the last byte of the weights."""
    path = kept_weights(own)
    content = path.read_bytes()
    path.write_bytes(content[:-1] + b"x")


def name_weights_of_another(entry: dict[str, Any]) -> None:
    """Let an entry name the weights of another method."""
    weights = entry["predictions"][0]["weights"]
    weights["path"] = "weights/cavity/tiny/a_0.safetensors"


def add_weights_of_no_entry(own: BoardBench) -> None:
    """Leave weights on the board that no entry has."""
    path = own.folder / "weights/cavity/tiny/other_0.safetensors"
    path.write_bytes(b"1")


def claim_track(entry: dict[str, Any]) -> None:
    """Claim a track that the budget does not give."""
    entry["budget"]["track"] = "converged"


def claim_track_alone(entry: dict[str, Any]) -> None:
    """Claim a track without a budget."""
    entry["budget"] = {"track": "equal compute"}


LONG_RECORD = json.dumps({"note": "x" * kept.MOST_LOG_BYTES})
TERABYTE = 2**40
DAMAGE: dict[str, Damage] = {
    "weights: edited": edit_weights,
    "weights: a sparse file of a terabyte": lambda own: os.truncate(
        kept_weights(own), TERABYTE
    ),
    "weights: lost": lambda own: kept_weights(own).unlink(),
    "weights: those of another method": lambda own: own.edit(
        "drift", name_weights_of_another
    ),
    "weights: of no entry": add_weights_of_no_entry,
    "weights: long record": put("json", LONG_RECORD.encode()),
    "weights: record nested far deeper than one is": put("json", b"[" * 100_000),
    "weights: JSON that is no record": put("json", b"[1]"),
    "budget: track claimed": lambda own: own.edit("drift", claim_track),
    "budget: track claimed without a budget": lambda own: own.edit(
        "noisy", claim_track_alone
    ),
}


@pytest.mark.usefixtures("first")
@pytest.mark.parametrize("name", DAMAGE)
def test_what_the_check_finds(own: BoardBench, name: str) -> None:
    """Weights edited, lost, elsewhere or nobody's; records that are none; tracks that
    no budget gives.
    """
    damage = DAMAGE[name]
    damage(own)
    check, _, _ = name.partition(":")
    assert failing_checks(own) == {check}


@pytest.mark.slow
def test_what_is_no_record_is_not_copied(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The entry does without, as it may: too long, damaged, or what predictions cost.
    All weights have a bound.
    """
    run = trained(own, 0)
    (run / "training.json").unlink()
    cost = json.dumps({"seconds_per_frame": 1.0})
    for name, record, has_warning in (
        ("training.json", LONG_RECORD, True),
        ("training.json", "{", True),
        ("training.json", "[]", True),
        ("weights.json", cost, False),
    ):
        path = run / name
        path.write_text(record)
        warned = nullcontext()
        if has_warning:
            warned = pytest.warns(LogLeftOutWarning, match=name)
        with warned:
            submitted(own, run, replace=True)
        assert list(kept_files(own)) == ["drift_0.safetensors"]
        path.unlink()
    assert_sound(own)
    monkeypatch.setattr(kept, "MOST_BYTES", 1000)
    assert failing_checks(own) == {"weights"}


@pytest.mark.slow
def test_a_budget_is_that_of_the_file(own: BoardBench, first: Path) -> None:
    """Scoring again finds predictions that state another budget, though the entry is
    consistent by itself.
    """

    def shorten(entry: dict[str, Any]) -> None:
        entry["budget"]["cpu_hours"] = 0.05
        prediction = entry["predictions"][0]
        prediction["budget"]["cpu_hours"] = 0.05

    own.edit("drift", shorten)
    assert_sound(own)
    again = check_board(
        own.folder,
        predictions=[first / "predictions.nc"],
        registry=own.registry,
        root=own.data.root,
        page=False,
    )
    checks = {finding.check for finding in again.findings}
    assert checks == {"rescored"}


@pytest.mark.slow
def test_seeds_that_come_later_make_the_entry_of_all_at_once(
    own: BoardBench, home: Path, tmp_path: Path
) -> None:
    """Byte for byte, weights included, though the predictions of the first seeds are
    gone by then.
    """
    first, *others = [trained(own, seed) for seed in (0, 3, 5)]
    first_predictions = first / "predictions.nc"
    gone = tmp_path / "gone.nc"
    submitted(own, first)
    first_predictions.rename(gone)
    for run in others:
        result = submitted(own, run, add=True)
    assert_sound(own)
    # the others stay as they lie
    names = sorted(path.name for path in result.files)
    assert names == [
        "drift.yaml",
        "drift_5.json",
        "drift_5.nc",
        "drift_5.safetensors",
    ]
    kept_names = sorted(path.name for path in result.kept)
    assert kept_names == [
        "drift_0.json",
        "drift_0.nc",
        "drift_0.safetensors",
        "drift_3.json",
        "drift_3.nc",
        "drift_3.safetensors",
    ]
    scores_of_one_seed = own.folder / "scores/cavity/tiny/drift.nc"
    assert not scores_of_one_seed.exists()
    gone.rename(first_predictions)
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    other = copied(home, other_folder)
    submitted(other, first, *others)
    assert own.state() == other.state()


@pytest.mark.slow
def test_seeds_may_come_after_a_minor_version_of_the_data(own: BoardBench) -> None:
    """A minor version leaves the data of this size as they are: the hash says so."""
    first, later = [trained(own, seed) for seed in (0, 3)]
    with netCDF4.Dataset(first / "predictions.nc", "a") as file:
        version = file.getncattr("dataset_version")
        minor_version = version.partition(".")[0] + ".0.9"
        assert minor_version != version
        file.setncattr("dataset_version", minor_version)
    submitted(own, first)
    submitted(own, later, add=True)
    assert_sound(own)


@pytest.mark.slow
def test_what_seeds_to_add_must_share_with_the_entry(own: BoardBench) -> None:
    """An entry of that method, its parameters, training in words and score files;
    another seed.
    """
    first = trained(own, 0)
    same = trained(own, 3)
    other_recipe = "cavity tiny train, recipe cavity/other, step 6"
    other = trained(own, 4, training=other_recipe)
    many = trained(own, 6, parameters=7)
    predictions_of_many = many / "predictions.nc"

    def refused(*folders: Path, **options: Any) -> str:
        before = own.state()
        all_options = {"add": True, **options}
        with pytest.raises(LagbenchError) as caught:
            submitted(own, *folders, weights=(), **all_options)
        assert own.state() == before
        return f"{caught.value.what} {caught.value.fix}"

    assert "no entry" in refused(first)
    submitted(own, first)
    assert "exclude each other" in refused(same, replace=True)
    assert "training" in refused(other)
    assert "parameters" in refused(many)
    assert "this seed already" in refused(first)
    another = own.predict(noisy, "another", seed=9, training=OURS)
    another.rename(predictions_of_many)
    assert "method" in refused(many)
    without_seed = own.predict(noisy, "drift", training=OURS)
    without_seed.rename(predictions_of_many)
    assert "state their seeds" in refused(many)
    file = own.folder / "scores/cavity/tiny/drift.nc"
    content = file.read_bytes()
    file.write_bytes(content + b"more")
    assert "score file" in refused(same)
    file.write_bytes(content)
    submitted(own, same, add=True)
    assert_sound(own)


def test_the_description_of_a_method_stays_when_seeds_are_added(
    own: BoardBench,
) -> None:
    """So do budget and parameters of meta.yaml, where the files have none. New values
    replace old ones.
    """
    first = own.predict(nearer, "mine", seed=0)
    second = own.predict(still, "mine", seed=1)
    budget = EntryBudget(epochs=10.0, gpu_hours=2.5)
    own.submit(
        first,
        parameters=1000,
        budget=budget,
        notes="first",
        hardware="a GPU",
    )
    first.unlink()
    own.submit(second, add=True, notes="both")
    entry = read_entry(own.entry("mine"))
    assert entry.budget == budget
    assert entry.parameters == 1000
    assert entry.notes == "both"
    assert entry.hardware == "a GPU"
    seeds = [prediction.seed for prediction in entry.predictions]
    assert seeds == [0, 1]
    assert_sound(own)


def withdraw(entry: dict[str, Any]) -> None:
    """Withdraw an entry."""
    entry["status"] = "withdrawn"
    entry["reason"] = "a mistake"


def restore(entry: dict[str, Any]) -> None:
    """Take the withdrawal back."""
    entry["status"] = "active"
    entry["reason"] = "it was none"


@pytest.mark.slow
def test_only_sound_active_entries_get_seeds(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not a withdrawn one, nor one whose weights changed. A seed that somebody else
    added while files were scored stays.
    """
    first, second, third = [trained(own, seed) for seed in (0, 3, 5)]
    submitted(own, first)
    weights = kept_weights(own)
    content = weights.read_bytes()
    weights.write_bytes(content + b"more")
    with pytest.raises(ChecksFailedError) as caught:
        submitted(own, second, add=True)
    assert caught.value.where.endswith(
        "leaderboard/weights/cavity/tiny/drift_0.safetensors"
    )
    weights.write_bytes(content)
    own.edit("drift", withdraw)
    with pytest.raises(UsageError) as caught:
        submitted(own, second, add=True)
    assert caught.value.where.endswith("leaderboard/submissions/cavity/tiny/drift.yaml")
    own.edit("drift", restore)

    def meanwhile(*args: Any, **options: Any) -> ScoreCard:
        monkeypatch.undo()
        submitted(own, second, add=True)
        return score(*args, **options)

    monkeypatch.setattr(submitting, "score", meanwhile)
    submitted(own, third, add=True)
    entry = read_entry(own.entry("drift"))
    seeds = [prediction.seed for prediction in entry.predictions]
    assert seeds == [0, 3, 5]
    assert entry.reason == "it was none"
    assert_sound(own)


def test_each_seed_has_its_own_step_and_start(
    own: BoardBench,
    run: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Trainings that differ in these alone belong together, on the command line too."""
    recipe = "cavity tiny train, recipe cavity/tiny"
    start = "started from cavity/mini"
    training = f"{recipe}, step 6, {start}, weights 0123abcd"
    other_training = f"{recipe}, step 8, {start}, weights 4567cdef"
    first = own.predict(nearer, "mine", seed=0, training=training)
    own.submit(first, name="My model")
    added = own.predict(still, "mine", seed=1, training=other_training)
    registry_file = own.registry.files["cavity"]
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(registry_file))
    where = [
        *("--board", own.folder),
        *("--root", own.data.root),
        *("--method", "mine"),
    ]
    result = run(
        "submit",
        added,
        "--add",
        *where,
        "--command",
        "make both",
    )
    assert result.exit_code == 0, result.output
    entry = read_entry(own.entry("mine"))
    assert entry.name == "My model"
    assert entry.command == "make both"
    assert len(entry.predictions) == 2


def test_trainings_that_differ_are_named_with_their_steps(own: BoardBench) -> None:
    """Two recipes are refused, and each is shown as its file states it."""
    trainings = [
        "cavity tiny train, recipe cavity/tiny, step 6",
        "cavity tiny train, recipe cavity/tiny-long, step 8",
    ]
    paths = []
    for seed, (method, training) in enumerate(
        zip((nearer, still), trainings, strict=True)
    ):
        path = own.predict(method, "mine", seed=seed, training=training)
        paths.append(path)
    with pytest.raises(UsageError) as together:
        own.submit(*paths)
    own.submit(paths[0])
    with pytest.raises(UsageError) as added:
        own.submit(paths[1], add=True)
    for training in trainings:
        assert training in str(together.value)
        assert training in str(added.value)
