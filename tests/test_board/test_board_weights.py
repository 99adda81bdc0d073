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

import pytest
from board_bench import BoardBench, copied, nearer, noisy, still
from file_size_limit import largest_file
from simple_models import INFO, Drift

from lagbench.baselines.checkpoint import Checkpoint, load, round_weights, save
from lagbench.board import submit as submitting
from lagbench.board import weights as kept
from lagbench.board.check import check_board
from lagbench.board.entry import EntryBudget, Meta
from lagbench.board.entry_file import read_entry
from lagbench.board.publish import SubmitResult
from lagbench.board.submit import submit
from lagbench.data.checksums import file_sha256
from lagbench.errors import (
    ChecksFailedError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.submission import open_predictions
from lagbench.submission.budget import Budget

BUDGET = Budget(windows=48, epochs=0.5, steps=6, cpu_hours=0.1, gpu_hours=0.0)


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard."""
    return copied(home, tmp_path)


KEPT, GLIDE = (f"weights/cavity/tiny/{name}_0" for name in ("drift", "glide"))
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
    labels: dict[str, Any] = {"seed": seed, "budget": BUDGET.model_dump_json()}
    if training is not None:
        labels["training"] = training
    if parameters is not None:
        labels["parameters"] = parameters

    def between(truth: Any, n: int, h: int) -> Any:
        future = truth[n : n + h]
        error = noisy(truth, n, h) - future
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
    recipe = {"name": "cavity/tiny", "training": {"seed": seed}}
    checkpoint = Checkpoint(
        baseline="drift",
        options={},
        info=info,
        weights=round_weights(Drift.build({}, info)),
        training={"step": 6, "recipe": recipe},
    )
    save(folder / "weights.pt", checkpoint)
    (folder / "training.json").write_text(json.dumps({"step": 6}))
    return folder


def submitted(
    own: BoardBench,
    *folders: Path,
    weights: tuple[Path, ...] | None = None,
    method: str | None = None,
    **options: Any,
) -> SubmitResult:
    """Submit the predictions of runs, with their weights unless others are given."""
    files = [folder / "predictions.nc" for folder in folders]
    if weights is None:
        weights = tuple(folder / "weights.pt" for folder in folders)
    meta = Meta(authors=("A. Author",), command="make", method=method, name=method)
    return submit(files, meta, weights=weights, **own.where, **options)


@pytest.fixture(scope="module")
def first_submission(
    home: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[BoardBench, Path]:
    """A leaderboard with the entry of a run and its weights, and the run.

    Do not change the files.
    """
    bench = copied(home, tmp_path_factory.mktemp("first"))
    run = trained(bench, 0)
    submitted(bench, run)
    return bench, run


@pytest.fixture
def first(own: BoardBench, first_submission: tuple[BoardBench, Path]) -> Path:
    """A run whose entry is on the board, with its weights."""
    bench, run = first_submission
    shutil.copytree(bench.folder, own.folder, dirs_exist_ok=True)
    return Path(shutil.copytree(run, own.folder.parent / run.name))


def hashes(own: BoardBench, method: str = "drift") -> list[str | None]:
    """Return the SHA-256 of the weights of each seed, as the entry has them."""
    weight_hashes: list[str | None] = []
    for prediction in read_entry(own.entry(method)).predictions:
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


def claim(own: BoardBench, path: str, source: Path) -> None:
    """Let the entry glide name a file as its weights, with the hash of another."""
    weights = {"path": path, "sha256": file_sha256(source)}

    def name_weights(entry: dict[str, Any]) -> None:
        entry["predictions"][0]["weights"] = weights

    own.edit("glide", name_weights)


def failing_checks(own: BoardBench) -> set[str]:
    """Return the names of the checks that find something."""
    result = check_board(own.folder, registry=own.registry, page=False, isolated=False)
    return {finding.check for finding in result.findings}


def test_weights_lie_beside_their_entry(own: BoardBench) -> None:
    """Weights and records of both seeds are copied and named by hash, and the entry has
    their mean budget.

    They go to their seeds in any order, and of some only; those of others stay while
    the predictions do.
    """
    runs = [trained(own, 0), trained(own, 3)]
    submitted(own, *runs)
    entry = read_entry(own.entry("drift"))
    for run, prediction, seed in zip(runs, entry.predictions, (0, 3), strict=True):
        assert prediction.weights is not None
        assert prediction.weights.path == f"weights/cavity/tiny/drift_{seed}.pt"
        file = own.folder / prediction.weights.path
        assert file.read_bytes() == (run / "weights.pt").read_bytes()
        assert file_sha256(file) == prediction.weights.sha256
        assert prediction.budget == BUDGET
        record = json.loads(file.with_suffix(".json").read_text())
        assert record == {"step": 6}
    assert entry.budget is not None
    assert entry.budget.windows == 48
    assert entry.budget.cpu_hours == 0.1
    assert entry.budget.track is None  # tiny has none
    assert failing_checks(own) == set()
    first, second = (run / "weights.pt" for run in runs)
    own.entry("drift").unlink()
    submitted(own, *runs, weights=(second, first))
    assert hashes(own) == [file_sha256(first), file_sha256(second)]
    submitted(own, *runs, weights=(second,), replace=True)
    assert hashes(own) == [file_sha256(first), file_sha256(second)]
    own.entry("drift").unlink()
    submitted(own, *runs, weights=(second,))
    assert hashes(own) == [None, file_sha256(second)]
    for end in ("pt", "json"):
        (own.folder / f"{KEPT}.{end}").unlink()
    assert failing_checks(own) == set()


def test_a_later_entry_takes_its_files_along(own: BoardBench, first: Path) -> None:
    """Weights stay with their predictions, and go with them: an entry leaves none
    behind.
    """
    before = kept_files(own)
    file = own.folder / f"{KEPT}.pt"
    assert json.loads(before["drift_0.json"]) == {"step": 6}
    for weights in ((), (file,)):  # those of the board, told or not, keep their record
        again = submitted(own, first, weights=weights, replace=True)
        assert kept_files(own) == before
        assert again.removed == ()
        assert failing_checks(own) == set()
    # new weights without a record leave none of the old
    (first / "training.json").unlink()
    assert submitted(own, first, replace=True).removed == (file.with_suffix(".json"),)
    assert list(kept_files(own)) == ["drift_0.pt"]
    assert failing_checks(own) == set()
    later = submitted(own, trained(own, 0, share=0.3), weights=(), replace=True)
    assert later.removed == (file,)
    assert kept_files(own) == {}
    assert failing_checks(own) == set()


@pytest.mark.parametrize("damage", ["lost", "edited", "linked"])
def test_only_sound_weights_are_kept(own: BoardBench, first: Path, damage: str) -> None:
    """What is wrong with those of before is mended by submitting anew."""
    file = own.folder / f"{KEPT}.pt"
    file.unlink()
    if damage == "edited":
        file.write_bytes(b"1")
    if damage == "linked":
        file.symlink_to(first / "weights.pt")
    submitted(own, first, weights=(), replace=True)
    assert hashes(own) == [None]
    assert failing_checks(own) == set()


def test_weights_of_another_are_not_kept(own: BoardBench, first: Path) -> None:
    """Nor those that lie elsewhere: what the old entry says of them is not believed."""
    second = trained(own, 0, share=0.3)
    submitted(own, second, weights=(), method="glide")
    source = own.folder / f"{KEPT}.pt"
    target = own.folder / f"{GLIDE}.pt"
    target.write_bytes(source.read_bytes())
    for path, alone in ((GLIDE, False), (KEPT, False), (KEPT, True)):
        if alone:
            target.unlink(missing_ok=True)
            own.entry("drift").unlink()  # nobody else's now, and still not in its place
        claim(own, f"{path}.pt", source)
        submitted(own, second, weights=(), method="glide", replace=True)
        assert hashes(own, "glide") == [None]


def test_a_new_name_takes_the_weights_along(own: BoardBench, first: Path) -> None:
    """A superseded entry and its successor have one file of weights each, with the same
    bytes.
    """
    own.edit(
        "drift", lambda entry: entry.update(status="superseded", superseded_by="glide")
    )
    submitted(own, first, method="glide")
    assert failing_checks(own) == set()


def test_no_link_leads_out_of_the_board(own: BoardBench, tmp_path: Path) -> None:
    """Nothing is written behind one; the entry before stays."""
    run = trained(own, 0)
    submitted(own, run, weights=())
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (own.folder / "weights").symlink_to(elsewhere)
    before = own.state()
    with pytest.raises(UsageError) as caught:
        submitted(own, run, replace=True)
    assert caught.value.where == str(own.folder / "weights")
    assert own.state() == before
    assert list(elsewhere.iterdir()) == []
    (own.folder / "weights").unlink()
    submitted(own, run, replace=True)
    (own.folder / "weights").rename(elsewhere / "weights")
    (own.folder / "weights").symlink_to(elsewhere / "weights")
    files_before = sorted(elsewhere.rglob("*.*"))
    with pytest.raises(UsageError):
        submitted(own, trained(own, 0, share=0.3), weights=(), replace=True)
    assert sorted(elsewhere.rglob("*.*")) == files_before


def test_an_idle_place_that_cannot_be_cleared(own: BoardBench, first: Path) -> None:
    """A folder where a record was: told before anything moves. A link that leads
    nowhere just goes.
    """
    record = next((own.folder / "weights").rglob("*.json"))
    record.unlink()
    record.mkdir()
    second = trained(own, 0, share=0.3)
    before = own.state()
    (second / "training.json").unlink()
    with pytest.raises(WorkFailedError):
        submitted(own, second, replace=True)
    assert own.state() == before
    record.rmdir()
    record.symlink_to(own.folder.parent / "nowhere")
    assert submitted(own, second, replace=True).removed == (record,)
    assert not record.is_symlink()


def test_a_full_disk_leaves_the_entry_before(own: BoardBench, first: Path) -> None:
    """Score files fit, weights do not: nothing of the old entry is lost, nothing of the
    new one is there.
    """
    second = trained(own, 0, share=0.3)
    before = own.state()
    long_note = "x" * (kept.MOST_LOG_BYTES - 100)
    record = json.dumps({"step": 6, "note": long_note})
    (second / "training.json").write_text(record)
    score_files = (own.folder / "scores").rglob("drift*")
    room = 1000 + max(path.stat().st_size for path in score_files)
    assert room < (second / "training.json").stat().st_size
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
    """Training in words and parameters are those of the weights; the number tells GNS
    from SuperGAT.
    """
    run = trained(own, 0, training, parameters)
    if fits:
        submitted(own, run)
        return
    with pytest.raises(UsageError) as caught:
        submitted(own, run)
    assert caught.value.where == str(run / "weights.pt")


@pytest.mark.parametrize(
    ("change", "fits"), [("", True), (", model.noise_std=0.001", False)]
)
def test_seeds_differ_in_nothing_else(own: BoardBench, change: str, fits: bool) -> None:
    """The step of the best weights is each seed's own; a changed recipe is another
    method.
    """
    words = "cavity tiny train, recipe cavity/tiny, step"
    runs = [trained(own, 0, f"{words} 6"), trained(own, 3, f"{words} 9{change}")]
    with nullcontext() if fits else pytest.raises(UsageError, match=r"noise_std"):
        submitted(own, *runs, weights=())


@pytest.mark.usefixtures("first")
def test_weights_of_another_entry_are_refused(own: BoardBench) -> None:
    """They lie on the board already; where they came by hand, the check finds them."""
    second = trained(own, 0, share=0.3)
    with pytest.raises(UsageError) as caught:
        submitted(own, second, method="glide")
    assert caught.value.where == str(second / "weights.pt")
    submitted(own, second, weights=(), method="glide")
    source = own.folder / f"{KEPT}.pt"
    target = own.folder / f"{GLIDE}.pt"
    target.write_bytes(source.read_bytes())
    claim(own, f"{GLIDE}.pt", source)
    assert failing_checks(own) == {"weights"}


def test_other_weights_are_refused(own: BoardBench) -> None:
    """Weights of another seed, one twice, a state to go on from, files that are none;
    nothing is written.
    """
    runs = [trained(own, 0), trained(own, 3)]
    before = own.state()
    first, second = (run / "weights.pt" for run in runs)
    state = runs[0] / "checkpoint.pt"
    save(state, replace(load(first), optimizer={"state": {}}))
    for folders, weights in (
        (runs[:1], (second,)),
        (runs, (first, first)),
        (runs[:1], (state,)),
    ):
        with pytest.raises(UsageError) as caught:
            submitted(own, *folders, weights=weights)
        assert caught.value.where == str(weights[0])
    with pytest.raises(UnreadableFileError):
        submitted(own, *runs, weights=(first, runs[0] / "training.json"))
    assert own.state() == before


def put(end: str, data: bytes) -> Callable[[BoardBench], object]:
    """Return what writes the weights or the record of the run anew."""
    return lambda bench: (bench.folder / f"{KEPT}.{end}").write_bytes(data)


DAMAGE: dict[str, Callable[[BoardBench], object]] = {
    "weights: edited": lambda b: put("pt", kept_files(b)["drift_0.pt"][:-1] + b"x")(b),
    "weights: a sparse file of a terabyte": lambda b: os.truncate(
        b.folder / f"{KEPT}.pt", 2**40
    ),
    "weights: lost": lambda b: (b.folder / f"{KEPT}.pt").unlink(),
    "weights: those of another method": lambda b: b.edit(
        "drift",
        lambda entry: entry["predictions"][0]["weights"].update(
            path="weights/cavity/tiny/a_0.pt"
        ),
    ),
    "weights: of no entry": lambda b: (
        b.folder / "weights/cavity/tiny/other_0.pt"
    ).write_bytes(b"1"),
    "weights: long record": put(
        "json", json.dumps({"note": "x" * kept.MOST_LOG_BYTES}).encode()
    ),
    "weights: record nested far deeper than one is": put("json", b"[" * 100_000),
    "weights: JSON that is no record": put("json", b"[1]"),
    "budget: track claimed": lambda b: b.edit(
        "drift", lambda entry: entry["budget"].update(track="converged")
    ),
    "budget: track claimed without a budget": lambda b: b.edit(
        "noisy", lambda entry: entry.update(budget={"track": "equal compute"})
    ),
}


@pytest.mark.usefixtures("first")
@pytest.mark.parametrize("name", DAMAGE)
def test_what_the_check_finds(own: BoardBench, name: str) -> None:
    """Weights edited, lost, elsewhere or nobody's; records that are none; tracks that
    no budget gives.
    """
    DAMAGE[name](own)
    assert failing_checks(own) == {name.partition(":")[0]}


def test_what_is_no_record_is_not_copied(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The entry does without, as it may: too long, or what predictions cost. All
    weights have a bound.
    """
    run = trained(own, 0)
    (run / "training.json").unlink()
    for name, record in (
        ("training.json", {"note": "x" * kept.MOST_LOG_BYTES}),
        ("weights.json", {"seconds_per_frame": 1.0}),
    ):
        (run / name).write_text(json.dumps(record))
        submitted(own, run, replace=True)
        assert list(kept_files(own)) == ["drift_0.pt"]
        (run / name).unlink()
    assert failing_checks(own) == set()
    monkeypatch.setattr(kept, "MOST_BYTES", 1000)
    assert failing_checks(own) == {"weights"}


def test_a_budget_is_that_of_the_file(own: BoardBench, first: Path) -> None:
    """Scored again, predictions that tell another budget are found, though the entry is
    sound by itself.
    """

    def shorten(entry: dict[str, Any]) -> None:
        entry["budget"]["cpu_hours"] = 0.05
        prediction = entry["predictions"][0]
        prediction["budget"]["cpu_hours"] = 0.05

    own.edit("drift", shorten)
    assert failing_checks(own) == set()
    where = {"registry": own.registry, "root": own.data.root, "page": False}
    again = check_board(own.folder, predictions=[first / "predictions.nc"], **where)
    assert {finding.check for finding in again.findings} == {"rescored"}


def test_seeds_that_come_later_make_the_entry_of_all_at_once(
    own: BoardBench, home: Path, tmp_path: Path
) -> None:
    """Byte for byte, weights included, though the predictions of the first seeds are
    gone by then.
    """
    runs = [trained(own, seed) for seed in (0, 3, 5)]
    submitted(own, runs[0])
    (runs[0] / "predictions.nc").rename(tmp_path / "gone.nc")
    for run in runs[1:]:
        result = submitted(own, run, add=True)
    assert failing_checks(own) == set()
    # the others stay as they lie
    assert sorted(path.name for path in result.files) == [
        "drift.yaml",
        "drift_5.json",
        "drift_5.nc",
        "drift_5.pt",
    ]
    assert not (own.folder / "scores/cavity/tiny/drift.nc").exists()
    (tmp_path / "gone.nc").rename(runs[0] / "predictions.nc")
    (tmp_path / "other").mkdir()
    other = copied(home, tmp_path / "other")
    submitted(other, *runs)
    assert own.state() == other.state()


def test_what_seeds_to_add_must_share_with_the_entry(own: BoardBench) -> None:
    """An entry of that method, its parameters, training in words and score files;
    another seed.
    """
    first = trained(own, 0)
    same = trained(own, 3)
    other = trained(own, 4, training="cavity tiny train, recipe cavity/other, step 6")
    many = trained(own, 6, parameters=7)

    def refused(*folders: Path, **options: Any) -> str:
        before = own.state()
        with pytest.raises(LagbenchError) as caught:
            submitted(own, *folders, weights=(), **{"add": True, **options})
        assert own.state() == before
        return f"{caught.value.what} {caught.value.fix}"

    assert "no entry" in refused(first)
    submitted(own, first)
    assert "added to or replaced" in refused(same, replace=True)
    assert "training" in refused(other)
    assert "parameters" in refused(many)
    assert "such a seed already" in refused(first)
    own.predict(noisy, "another", seed=9, training=OURS).rename(many / "predictions.nc")
    assert "method" in refused(many)
    own.predict(noisy, "drift", training=OURS).rename(many / "predictions.nc")
    assert "need numbers" in refused(many)
    file = own.folder / "scores/cavity/tiny/drift.nc"
    content = file.read_bytes()
    file.write_bytes(content + b"more")
    assert "score file" in refused(same)
    file.write_bytes(content)
    submitted(own, same, add=True)
    assert failing_checks(own) == set()


def test_what_is_said_of_a_method_stays_when_seeds_are_added(own: BoardBench) -> None:
    """Budget and parameters of meta.yaml too, where the files say none; what is said
    anew wins.
    """
    files = [own.predict(nearer, "mine", seed=0), own.predict(still, "mine", seed=1)]
    budget = EntryBudget(epochs=10.0, gpu_hours=2.5)
    own.submit(
        files[0],
        parameters=1000,
        budget=budget,
        notes="first",
        hardware="a GPU",
    )
    files[0].unlink()
    own.submit(files[1], add=True, notes="both")
    entry = read_entry(own.entry("mine"))
    assert entry.budget == budget
    assert entry.parameters == 1000
    assert entry.notes == "both"
    assert entry.hardware == "a GPU"
    assert [prediction.seed for prediction in entry.predictions] == [0, 1]
    assert failing_checks(own) == set()


def test_only_sound_active_entries_get_seeds(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not a withdrawn one, nor one whose weights changed. A seed that somebody else
    added while files were scored stays.
    """
    runs = [trained(own, seed) for seed in (0, 3, 5)]
    submitted(own, runs[0])
    content = kept_files(own)["drift_0.pt"]
    put("pt", content + b"more")(own)
    with pytest.raises(ChecksFailedError) as caught:
        submitted(own, runs[1], add=True)
    assert caught.value.where.endswith("leaderboard/weights/cavity/tiny/drift_0.pt")
    put("pt", content)(own)
    own.edit(
        "drift", lambda entry: entry.update(status="withdrawn", reason="a mistake")
    )
    with pytest.raises(UsageError) as caught:
        submitted(own, runs[1], add=True)
    assert caught.value.where.endswith("leaderboard/submissions/cavity/tiny/drift.yaml")
    own.edit("drift", lambda entry: entry.update(status="active", reason="it was none"))

    def meanwhile(*args: Any, **options: Any) -> ScoreCard:
        monkeypatch.undo()
        submitted(own, runs[1], add=True)
        return score(*args, **options)

    monkeypatch.setattr(submitting, "score", meanwhile)
    submitted(own, runs[2], add=True)
    entry = read_entry(own.entry("drift"))
    assert [prediction.seed for prediction in entry.predictions] == [0, 3, 5]
    assert entry.reason == "it was none"
    assert failing_checks(own) == set()


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
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(own.registry.files["cavity"]))
    where = ["--board", own.folder, "--root", own.data.root, "--method", "mine"]
    result = run("submit", added, "--add", *where, "--command", "make both")
    assert result.exit_code == 0, result.output
    entry = read_entry(own.entry("mine"))
    assert entry.name == "My model"
    assert entry.command == "make both"
    assert len(entry.predictions) == 2
