"""The check of a leaderboard's folder finds what it should, names it, and opens nothing
outside.
"""

from __future__ import annotations

import os
import re
import shutil
import statistics
from collections.abc import Callable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import netCDF4
import pytest
import yaml
from board_bench import (
    PLACE,
    SCORES,
    BoardBench,
    copied,
    master,
    reform,
    scale,
    set_mean,
)

from lagbench.board import folder_checks
from lagbench.board.build import build
from lagbench.board.check import check_board
from lagbench.board.entry import Level, Reproduction, Verification
from lagbench.board.entry_file import read_entry
from lagbench.board.identity import confusable_key
from lagbench.board.issues import CHECKS
from lagbench.board.scores_compared import sample_scenarios
from lagbench.board.verified_checks import check_line
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError
from lagbench.metrics.aggregate import Score
from lagbench.scoring.score_file_checks import read_score_file

NOISY = f"{SCORES}/noisy.nc"
MODEL = "0" * 64
PREDICTOR = "floors/cavity/tiny/persistence.nc"


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(
        home,
        tmp_path,
        without=["flipping", "constant-velocity", "frozen-field", "analog"],
    )


def found(bench: BoardBench, *, page: bool = False) -> list[str]:
    """Return the names of the checks that found something."""
    result = check_board(
        bench.folder,
        registry=bench.registry,
        page=page,
        isolated=False,
    )
    for finding in result.findings:
        assert finding.check in CHECKS
        assert finding.what
        assert finding.where
        assert finding.fix
        message = str(finding)
        assert message.isprintable() or "\n" in message
        assert len(message) < 2000
    assert result.exit_code == (1 if result.findings else 0)
    return [finding.check for finding in result.findings]


def test_nothing_is_wrong_with_what_submit_writes(home: Path) -> None:
    """Floors, several seeds and an exploding method pass, in a child process too."""
    bench = master(home)
    result = check_board(bench.folder, registry=bench.registry, page=False)
    assert result.findings == ()
    assert result.entries == 3


Damage = Callable[[BoardBench], object]
Entry = dict[str, Any]
Content = dict[str, Any]


def scores_of(bench: BoardBench, name: str) -> Path:
    """Return a score file."""
    return bench.folder / SCORES / f"{name}.nc"


def halve(path: Path) -> None:
    """Halve a statistic in a score file."""
    with netCDF4.Dataset(path, "r+") as file:
        scale("vorticity_mse", 0.5)(file)


def link(path: Path, target: Path) -> None:
    """Replace a file by a symbolic link."""
    path.unlink()
    path.symlink_to(target)


def copy_of(bench: BoardBench, method: str, other: str, **changes: Any) -> None:
    """Enter a method once more under another id."""
    entry = yaml.safe_load(bench.entry(method).read_text())
    entry["method"] = other
    entry |= changes
    text = yaml.safe_dump(entry, sort_keys=False)
    bench.entry(other).write_text(text)
    shutil.copyfile(scores_of(bench, method), scores_of(bench, other))


def disguised(bench: BoardBench) -> None:
    """Enter the predictions of another once more, with another hash of them
    everywhere.
    """
    other_hash = "1" * 64
    copy_of(bench, "noisy", "other", name="Something else")
    with netCDF4.Dataset(scores_of(bench, "other"), "r+") as file:
        file.predictions_sha256 = other_hash

    def change(entry: Entry) -> None:
        entry["predictions"][0]["sha256"] = other_hash
        entry["score"]["files"][0]["predictions_sha256"] = other_hash

    bench.edit("other", change)
    bench.rehash("other")


def verify(bench: BoardBench, method: str) -> None:
    """Write a list of verified entries, with scores that nobody has."""
    line = {
        "scores": ["0" * 64],
        "lagbench": "0.1.0",
        "date": "2026-01-31",
    }
    lines = {f"{PLACE}/{method}.yaml": line}
    (bench.folder / "verified.yaml").write_text(yaml.safe_dump(lines))


def verified(**changes: Any) -> Damage:
    """Return what writes a line about noisy that holds, with changes of it."""

    def write(bench: BoardBench) -> None:
        entry = yaml.safe_load(bench.entry("noisy").read_text())
        line = {
            "scores": [file["sha256"] for file in entry["score"]["files"]],
            "lagbench": "0.1.0",
            "date": "2026-01-31",
        }
        lines = {f"{PLACE}/noisy.yaml": line | changes}
        (bench.folder / "verified.yaml").write_text(yaml.safe_dump(lines))

    return write


def cost(**changes: Any) -> Content:
    """Return a measured cost, with changes of it."""
    values = {
        "machine": "a machine",
        "date": "2026-01-31",
        "repeats": 3,
        "seconds_per_frame": 0.5,
        "classical": {"projection": 0.1},
        "naive": {"persistence": 1e-6},
    }
    return values | changes


def trained_on(*subsets: str) -> Content:
    """Return the provenance of a training on some subsets."""
    return {
        "split": "cavity",
        "size": "tiny",
        "subsets": list(subsets),
        "recipe": "cavity/tiny",
        "step": 6,
    }


def call_trained_model_classical(entry: Content) -> None:
    """Say that nothing is learned, of a model that was trained."""
    entry["kind"] = "classical"
    entry["predictions"][0]["provenance"] = trained_on("train")


def budgeted(**budget: Any) -> Damage:
    """Return what states a budget, the same in the entry and its predictions."""

    def change(entry: Content) -> None:
        entry["predictions"][0]["budget"] = budget
        means = {name: budget[name] for name in ("steps",) if name in budget}
        entry["budget"] = means

    return edited(change)


def diverge(entry: Content, *, frame: int) -> None:
    """Say that the first scenario of test diverges at a frame."""
    scenario = min(load().size("cavity", "tiny").subsets["test"])
    entry["score"]["files"][0]["diverged_at"] = {scenario: frame}


def name_program(bench: BoardBench) -> None:
    """Name a program as predictions, with its true length."""
    (bench.folder / "x.nc").write_text("import os")
    put("predictions", 0, path="x.nc", bytes=9)(bench)


def superseded(bench: BoardBench, one: str, two: str) -> None:
    """Say that an entry follows another."""

    def change(entry: Entry) -> None:
        entry["status"] = "superseded"
        entry["superseded_by"] = two

    bench.edit(one, change)


def supersede_each_other(bench: BoardBench) -> None:
    """Say that two entries follow each other."""
    superseded(bench, "noisy", "damped")
    superseded(bench, "damped", "noisy")


def put(*place: str | int, **changes: object) -> Damage:
    """Return what writes keys into the entry of noisy, at a place of it."""

    def change(entry: Entry) -> None:
        part = reduce(getitem, place, entry)
        part.update(changes)

    return lambda bench: bench.edit("noisy", change)


def edited(change: Callable[[Entry], object]) -> Damage:
    """Return what changes the entry of noisy."""
    return lambda bench: bench.edit("noisy", change)


def text(content: str, path: str = f"{PLACE}/noisy.yaml") -> Damage:
    """Return what writes a file of the folder, the entry of noisy unless told
    otherwise.
    """
    return lambda bench: (bench.folder / path).write_text(content)


def scaled(statistic: str, factor: float, *, whole: bool = True) -> Damage:
    """Return what multiplies a statistic of noisy."""
    change = scale(statistic, factor)
    return lambda bench: reform(bench, change, whole=whole)


def worsen_by_a_millionth(entry: Entry) -> None:
    """Change the mean of the ranking metric a little."""
    set_mean(entry, 1 - 3e-6)


def remove_metric(entry: Entry) -> None:
    """Take a metric away."""
    del entry["score"]["metrics"]["mse_avg"]


def invent_metric(entry: Entry) -> None:
    """Add a metric that nobody knows."""
    metrics = entry["score"]["metrics"]
    metrics["best"] = dict(metrics["mse_avg"])


def move_to_unknown_split(bench: BoardBench) -> None:
    """Say that an entry is of a split that nobody knows."""
    folder = bench.folder / "submissions/cavty/tiny"
    folder.mkdir(parents=True)
    put(split="cavty")(bench)


def link_predictions(bench: BoardBench) -> None:
    """Name a link as predictions."""
    (bench.folder / "x.nc").symlink_to(bench.entry("noisy"))
    put("predictions", 0, path="x.nc")(bench)


def halve_and_rehash(bench: BoardBench) -> None:
    """Halve a statistic and forge the hash."""
    halve(scores_of(bench, "damped_3"))
    bench.rehash("damped")


def take_scores_of_another(bench: BoardBench) -> None:
    """Put another method's score file in the place of an entry's own."""
    shutil.copyfile(scores_of(bench, "damped_0"), bench.folder / NOISY)
    bench.rehash("noisy")


def cut_scores_short(bench: BoardBench) -> None:
    """Cut the end of a score file off and forge the hash."""
    path = bench.folder / NOISY
    size = path.stat().st_size
    os.truncate(path, size - 999)
    bench.rehash("noisy")


def copy_scores(bench: BoardBench) -> None:
    """Leave a score file that no entry has."""
    shutil.copyfile(bench.folder / NOISY, scores_of(bench, "other"))


def write_large_scores(bench: BoardBench) -> None:
    """Make a score file larger than one may be."""
    content = bytes(1_000_001)
    (bench.folder / NOISY).write_bytes(content)


def link_folder(bench: BoardBench) -> None:
    """Put a link where a folder of a split would be."""
    folder = bench.folder / "submissions" / "fluid"
    folder.symlink_to("/etc", target_is_directory=True)


def add_folder(bench: BoardBench) -> None:
    """Add a folder that is none of the leaderboard's."""
    folder = bench.folder / "more"
    folder.mkdir()
    (folder / "a.yaml").touch()


def copy_reference(bench: BoardBench) -> None:
    """Add scores of a reference predictor that nobody knows."""
    unknown = bench.folder / "floors/cavity/tiny/ceiling.nc"
    shutil.copyfile(bench.folder / PREDICTOR, unknown)


def copy_reference_to_another_split(bench: BoardBench) -> None:
    """Put the scores of a reference predictor under another split."""
    folder = bench.folder / "floors/fluid/tiny"
    folder.mkdir(parents=True)
    shutil.copy(bench.folder / PREDICTOR, folder)


def move_entry(path: str) -> Damage:
    """Return what moves the entry of noisy elsewhere in the folder."""
    return lambda bench: bench.entry("noisy").rename(bench.folder / path)


DAMAGE: dict[str, Damage] = {
    "score: edited score": edited(set_mean),
    "score: edited score by a millionth": edited(worsen_by_a_millionth),
    "score: metric removed": edited(remove_metric),
    "score: metric invented": edited(invent_metric),
    "score: data set edited": put("score", dataset_sha256="0" * 64),
    "schema: unknown key": put(lisence="MIT"),
    "schema: scorer named": put("score", scored_by="me"),
    "schema: link that is not http": put(code="javascript:alert(1)"),
    "schema: link with a user": put(code="https://a.org@b.org/"),
    "schema: name of 10 kB": put(name="n" * 10_000),
    "schema: blank name": put(name="\u3164"),
    "schema: path outside": put("predictions", 0, path="../../secret"),
    "schema: number in base 60": text(f"parameters: {':'.join(['59'] * 300)}:1.5\n"),
    "date: date to come": put(date="2999-01-01"),
    "name: look-alike of an entry": put(name="D\u0430MPED"),
    "name: look-alike of a reference predictor": put(name="Persistence"),
    "split: unknown split": move_to_unknown_split,
    "version score_file score: old data set": put("dataset", sha256="0" * 64),
    "lifecycle: superseded by nothing": lambda b: superseded(b, "noisy", "none"),
    "lifecycle: superseded by itself": lambda b: superseded(b, "noisy", "noisy"),
    "lifecycle: superseded in a circle": supersede_each_other,
    "nothing: notes edited": put(notes="new"),
    "predictions: predictions that are not there": put(
        "predictions", 0, path="predictions/x.nc"
    ),
    "predictions folder: predictions behind a link": link_predictions,
    "verified: verified without an entry": lambda b: verify(b, "nobody"),
    "verified: verified with other scores": lambda b: verify(b, "noisy"),
    "verified: list that is none": text("- a\n", "verified.yaml"),
    "nothing: verified": verified(cost=cost()),
    "verified: verified in the future": verified(date="2999-01-01"),
    "verified: cost measured in the future": verified(cost=cost(date="2999-01-01")),
    "verified: cost of an unknown solver": verified(
        cost=cost(classical={"projection-9x": 1.0})
    ),
    "verified: cost of a naive predictor as classical": verified(
        cost=cost(classical={"persistence": 1.0})
    ),
    "verified: cost of an unknown naive predictor": verified(
        cost=cost(naive={"ballistic": 1.0})
    ),
    "gates: gates that are none": text("{", "gates.json"),
    "schema: kind of a reference": put(kind="naive"),
    "schema: blank command": put(command=" "),
    "schema: cost of nothing": put(cost={"seconds_per_frame": 0.0, "device": "a"}),
    "schema: cost that is no number": put(
        cost={"seconds_per_frame": float("nan"), "device": "a"}
    ),
    "schema: negative steps": put("predictions", 0, budget={"steps": -1}),
    "nothing: trained on train": put("predictions", 0, provenance=trained_on("train")),
    "training: trained on test": put(
        "predictions", 0, provenance=trained_on("train", "test")
    ),
    "training: trained on shift, in words": put(
        training="cavity tiny train+shift, recipe cavity/tiny, step 6"
    ),
    "training: classical and trained": edited(call_trained_model_classical),
    "training: trained on test, in the words of lagbench": put(
        training="cavity tiny train+test, recipe cavity/tiny, step 6"
    ),
    "nothing: trained on train, in the words of lagbench": put(
        training="cavity tiny train, recipe cavity/tiny, step 6"
    ),
    "training: classical, and trained in the words of lagbench": put(
        kind="classical", training="cavity tiny train, recipe cavity/tiny, step 6"
    ),
    "training: classical, and a budget": put(kind="classical", budget={"steps": 9}),
    "budget: best step of the entry after the last one": put(
        budget={"steps": 9, "best_step": 10}
    ),
    "nothing: a budget": budgeted(
        steps=9, best_step=9, best=0.1, validations=[[3, 0.2], [9, 0.1]]
    ),
    "budget: best step after the last one": budgeted(steps=9, best_step=10),
    "budget: validation after the last step": budgeted(
        steps=9, validations=[[10, 0.1]]
    ),
    "budget: validations in another order": budgeted(
        steps=9, validations=[[6, 0.1], [3, 0.2]]
    ),
    "budget: best that is not the least": budgeted(
        steps=9, best=0.2, validations=[[3, 0.1]]
    ),
    "score: diverged scenario that was not predicted": put(
        "score", "files", 0, diverged_at={999: 9}
    ),
    "score: diverged after the last frame": edited(
        lambda entry: diverge(entry, frame=10**6)
    ),
    "nothing: diverged at a predicted frame": edited(
        lambda entry: diverge(
            entry, frame=load().size("cavity", "tiny").task.input_frames
        )
    ),
    "predictions: a program as predictions": name_program,
    # what may happen to files
    "score_file: edited score file": lambda b: halve(b.folder / NOISY),
    "score: edited score file, hash forged": halve_and_rehash,
    "score_file score duplicate: score file of another method": take_scores_of_another,
    "score_file: score file cut short": cut_scores_short,
    "missing: missing score file": lambda b: scores_of(b, "damped_3").unlink(),
    "stray: stray score file": copy_scores,
    "stray: missing entry": lambda b: b.entry("noisy").unlink(),
    "oversize: oversize score file": write_large_scores,
    "folder missing: score file that is a link": lambda b: link(
        b.folder / NOISY, scores_of(b, "damped_0")
    ),
    "values: negative square": scaled("position_mse", -1.0, whole=False),
    "values: correlation above one": scaled("vorticity_pearson", 2.0),
    "values: no error where there is one": scaled("vorticity_mse", 0.0),
    "duplicate: the same predictions again": lambda b: copy_of(
        b, "noisy", "other", name="Something else"
    ),
    "duplicate: the same errors again": disguised,
    "folder: entry that is a link": lambda b: link(
        b.entry("noisy"), Path("/etc/passwd")
    ),
    "folder: folder that is a link": link_folder,
    "folder: other files": text("import os", f"{PLACE}/evil.py"),
    "folder: other files beside the page": text("alert(1)", "index.js"),
    "folder: folder of its own": add_folder,
    "folder: page that is a link": lambda b: (b.folder / "README.md").symlink_to(
        "/etc/passwd"
    ),
    "folder: page that is a pipe": lambda b: os.mkfifo(b.folder / "index.html"),
    "folder: name that a log would obey": text("a: 1", f"{PLACE}/a\n::warning::x.yaml"),
    "folder stray: entry at another depth": move_entry("submissions/noisy.yaml"),
    "readable: entry of 100 MB": lambda b: os.truncate(b.entry("noisy"), 100_000_000),
    "readable: YAML with aliases": text("a: &a [x]\nb: *a\n"),
    "place: place": move_entry(f"{PLACE}/other.yaml"),
    "reference: unknown predictor": copy_reference,
    "reference: broken score file": text("CDF", PREDICTOR),
    "reference: scores of another split": copy_reference_to_another_split,
}
"""What somebody may write into an entry, then what may happen to files: the checks that
find it, its name.
"""


def checks_of(name: str) -> set[str]:
    """Return the checks that find a damage."""
    checks, _, _ = name.partition(":")
    return set(checks.split()) - {"nothing"}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found(name: str, own: BoardBench) -> None:
    """Each kind of damage is found by its checks and by no others."""
    damage = DAMAGE[name]
    damage(own)
    assert set(found(own)) == checks_of(name)


def test_a_link_is_called_a_link(own: BoardBench, tmp_path: Path) -> None:
    """At the top of the folder too, whatever its name."""
    for name in ("notes", "README.md", "other"):
        (own.folder / name).symlink_to(tmp_path)
    result = check_board(own.folder, registry=own.registry, isolated=False)
    places = {str(finding.where) for finding in result.findings}
    assert places == {"notes", "README.md", "other"}
    assert all("link" in str(finding.got) for finding in result.findings)


def test_all_checks_have_damage() -> None:
    """No check is without a test; those that need more than the folder have suites of
    their own.
    """
    tested = set()
    for name in DAMAGE:
        tested |= checks_of(name)
    elsewhere = {
        "page",
        "rescored",
        "base",
        "measured",
        "weights",
        "shift",
    }
    assert not tested & elsewhere
    assert tested | elsewhere == set(CHECKS)


def test_one_bad_file_hides_nothing(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unexpected error in one entry leaves the issues of the others."""
    original = folder_checks.load_plain

    def failing(path: Path, **options: Any) -> Any:
        if path.stem == "damped":
            raise OverflowError("too large")
        return original(path, **options)

    monkeypatch.setattr(folder_checks, "load_plain", failing)
    own.edit("noisy", set_mean)
    assert found(own) == ["readable", "score"]


def reproduced(
    scores: Score, *, seed: int, sample: tuple[int, ...], factor: float = 1.0
) -> Reproduction:
    """Return a record of some scenarios, with the submitted score times a factor."""
    values = dict(zip(scores.scenarios, scores.values.tolist(), strict=True))
    submitted = factor * statistics.fmean(values[scenario] for scenario in sample)
    return Reproduction(
        seed=seed,
        model=MODEL,
        metric=scores.metric.name,
        scenarios=len(sample),
        of=len(values),
        submitted=submitted,
        reproduced=submitted,
        difference=0.0,
        tolerance=1e-3,
    )


def test_each_record_of_an_entry_is_compared_with_the_score_file_of_its_seed(
    own: BoardBench,
) -> None:
    """A record of a sample exempts no record of another seed, and not itself; two
    wrong records do not make up for each other.
    """
    entry = read_entry(own.entry("damped"))
    size = own.registry.size("cavity", "tiny")
    scores = {}
    values = {}
    for seed, path in zip(entry.seeds, entry.score_paths, strict=True):
        stored = read_score_file(own.folder / path).scores
        scores[seed] = stored.scores()[stored.ranking]
        values[path] = dict(
            zip(scores[seed].scenarios, scores[seed].values.tolist(), strict=True)
        )
    whole = scores[0].scenarios
    sample = sample_scenarios(whole, MODEL, 1)
    (other,) = set(whole) - set(sample)

    def find(*records: Reproduction) -> list[str]:
        line = Verification(
            scores=tuple(file.sha256 for file in entry.score.files),
            lagbench="0.1.0",
            date=entry.date,
            level=Level.REPRODUCED,
            reproduced=records,
        )
        issues = check_line(line, entry, size, ranking_values=values)
        return [str(issue.got) for issue in issues]

    right = reproduced(scores[0], seed=0, sample=whole)
    right_of_3 = reproduced(scores[3], seed=3, sample=whole)
    sampled = reproduced(scores[0], seed=0, sample=sample)
    assert find(right, right_of_3) == []
    assert find(sampled, right_of_3) == []

    wrong = reproduced(scores[3], seed=3, sample=whole, factor=0.9)
    (got,) = find(sampled, wrong)
    assert str(entry.score_paths[1]) in got
    (got,) = find(reproduced(scores[0], seed=0, sample=(other,)), right_of_3)
    assert str(entry.score_paths[0]) in got
    means = [statistics.fmean(scores[seed].values) for seed in (0, 3)]
    up = reproduced(scores[0], seed=0, sample=whole, factor=1.0 + 0.1 / means[0])
    down = reproduced(scores[3], seed=3, sample=whole, factor=1.0 - 0.1 / means[1])
    (got,) = find(up, down)
    assert str(entry.score_paths[0]) in got
    assert str(entry.score_paths[1]) in got


def test_a_record_of_an_entry_without_seeds_is_compared_with_its_score_file(
    own: BoardBench,
) -> None:
    """Also where the record states seed 0, as the name of the weights does."""
    entry = read_entry(own.entry("noisy"))
    assert entry.seeds == (None,)
    size = own.registry.size("cavity", "tiny")
    stored = read_score_file(own.folder / entry.score_paths[0]).scores
    score = stored.scores()[stored.ranking]
    by_scenario = zip(score.scenarios, score.values.tolist(), strict=True)
    values = {entry.score_paths[0]: dict(by_scenario)}
    for factor, issue_count in ((1.0, 0), (0.9, 1)):
        line = Verification(
            scores=tuple(file.sha256 for file in entry.score.files),
            lagbench="0.1.0",
            date=entry.date,
            level=Level.REPRODUCED,
            reproduced=(
                reproduced(score, seed=0, sample=score.scenarios, factor=factor),
            ),
        )
        issues = check_line(line, entry, size, ranking_values=values)
        assert len(list(issues)) == issue_count


def test_later_entries_may_supersede_the_same_predictions(own: BoardBench) -> None:
    """The same predictions under a new name, and a name of old, are well where the old
    entry steps back.
    """
    copy_of(own, "noisy", "new-name")
    assert set(found(own)) == {"duplicate", "name"}
    superseded(own, "noisy", "new-name")
    assert found(own) == []


def test_an_entry_of_other_data_does_not_hide_predictions_that_stand_twice(
    own: BoardBench,
) -> None:
    """The same hash of an old data set comes first in the folder."""
    copy_of(own, "noisy", "other", name="Something else")
    old = yaml.safe_load(own.entry("noisy").read_text())
    old["size"] = "full"
    old["dataset"]["version"] = "9.0.0"
    for path, content in (
        (own.entry("noisy"), yaml.safe_dump(old).encode()),
        (scores_of(own, "noisy"), scores_of(own, "noisy").read_bytes()),
    ):
        copy = Path(str(path).replace("/cavity/tiny/", "/cavity/full/"))
        copy.parent.mkdir(parents=True)
        copy.write_bytes(content)
    assert found(own).count("duplicate") == 1


def test_predictions_without_a_length_are_found(own: BoardBench) -> None:
    """The finding names the key and the length that the file has."""
    path = own.folder / "x.nc"
    with netCDF4.Dataset(path, "w"):
        pass
    put("predictions", 0, path="x.nc")(own)
    own.edit("noisy", lambda entry: entry["predictions"][0].pop("bytes", None))
    result = check_board(own.folder, registry=own.registry, page=False, isolated=False)
    (finding,) = result.findings
    assert finding.check == "predictions"
    assert "bytes" in str(finding.expected)
    assert str(path.stat().st_size) in str(finding)
    assert "None" not in str(finding)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("GNS", "GN\u0405"),
        ("SuperGAT", "\u0405uperG\u0410T"),
        ("MLP 10", "mlp-l0"),
        ("Caf\u00e9", "Cafe"),
        ("\uff27\uff2e\uff33", "GNS"),
        ("\u0391\u0392", "AB"),
        ("G\u039dS", "GNS"),
        ("\u039cLP", "MLP"),
        ("\u03a5x\u0397", "YxH"),
        ("g\u0131ns\u0251\u0261", "ginsag"),
    ],
)
def test_names_that_look_alike(one: str, other: str) -> None:
    """Other scripts, wide letters, accents, case, hyphens, and digits like letters."""
    assert confusable_key(one) == confusable_key(other)
    assert confusable_key(one) != confusable_key(f"{other} b")


def test_withdrawn_entries_may_be_old(own: BoardBench) -> None:
    """What is not active need not belong to the data set of today."""
    newer_file = own.folder.parent / "newer.yaml"
    registry_text = own.data.size.file.read_text()
    newer_text = re.sub(r"version: 2\.\d+\.0", "version: 9.0.0", registry_text)
    newer_file.write_text(newer_text)
    newer = load(newer_file)
    references = own.folder / "floors"
    reference_count = len(list(references.rglob("*.nc")))
    result = check_board(own.folder, registry=newer, isolated=False)
    checks = {finding.check for finding in result.findings}
    assert checks == {"version", "reference"}
    assert len(result.findings) == 2 + reference_count

    def withdraw(entry: Entry) -> None:
        entry["status"] = "withdrawn"
        entry["reason"] = "old data"

    own.edit("noisy", withdraw)
    own.edit("damped", withdraw)
    # a reference predictor that this version had
    verified(cost=cost(classical={"projection-9x": 1.0}))(own)
    shutil.rmtree(references)
    result = check_board(own.folder, registry=newer, isolated=False)
    assert result.findings == ()


@pytest.mark.slow
def test_a_stale_page_is_found(own: BoardBench) -> None:
    """No page, an edited one, a link and a page of other entries are stale; a new build
    mends it.
    """
    assert found(own, page=True) == ["page"]
    page = build(own.folder, registry=own.registry).page
    assert found(own, page=True) == []
    again = build(own.folder, registry=own.registry)
    assert again.written == ()
    content = page.read_bytes()
    page.write_bytes(content.replace(b"noisy", b"nOisy", 1))
    assert found(own, page=True) == ["page"]
    page.unlink()
    page.symlink_to("elsewhere.html")
    assert found(own, page=True) == ["folder"]
    page.unlink()
    page.write_bytes(content)
    put(notes="new")(own)
    with pytest.raises(ChecksFailedError) as caught:
        build(own.folder, check=True, registry=own.registry)
    assert caught.value.where.endswith("leaderboard/index.html")
    assert found(own, page=True) == ["page"]
    schema = own.folder / "schema.json"
    schema.write_text("{}")
    result = build(own.folder, registry=own.registry)
    assert result.written == (page, schema)
    assert found(own, page=True) == []
