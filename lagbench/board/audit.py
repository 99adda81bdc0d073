"""Audit a leaderboard: predictions scored again, and what a change does to the entries
of others.

Scoring again is the proof of a score. A pull request adds; whoever alters what others
submitted has to be seen, so the folder is compared with the commit at which the change
left the base.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError
from lagbench.metrics.aggregate import LONG_BITS, LONG_ROLLOUT, Tally
from lagbench.metrics.table import METRICS, STATISTICS
from lagbench.scoring.card import SUBMISSION, ScoreCard
from lagbench.scoring.score_file import (
    FILM_RANGE,
    LEVELS,
    SubmissionStatistics,
    write_statistics,
)
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.submission.findings import Finding

from .entry import Entry, Prediction, ScoredFile
from .entry_file import MAX_ENTRY_BYTES
from .findings import REFERENCES_ANEW, finding
from .folder import REFERENCES, SCORES, SUBMISSIONS, VERIFIED, WEIGHTS, Folder
from .ranking import scored_file

TOLERANCE = 1e-6
"""Relative difference up to which two numbers are equal; NumPy versions may differ in
the last bits.
"""

# step of packed film positions [length]
FILM_STEP = (FILM_RANGE[1] - FILM_RANGE[0]) / LEVELS


@dataclass(frozen=True)
class Confirmation:
    """Predictions that, scored again, gave what an entry says."""

    predictions: Path
    entry: Path  # relative to the leaderboard's folder
    score_file: Path  # likewise
    difference: float  # greatest relative difference of any statistic


@dataclass(frozen=True, kw_only=True)
class Rescoring:
    """Scores predictions of entries again."""

    folder: Folder
    entries: Sequence[Entry]
    sound: Collection[Path]  # score files that can be read
    card: Callable[..., ScoreCard]  # of predictions and extras that measure more
    confirmed: list[Confirmation] = field(default_factory=list)

    def of_file(self, path: str | Path) -> Iterator[Finding]:
        """Yield where predictions differ from what the leaderboard says, or that they
        are not valid.
        """
        where = str(path)
        try:
            # the scorer alone opens them, after its checks in a child process
            card = self.card(path)
        except (UnreadableFileError, ChecksFailedError) as error:
            got = f"{error.what}: {error.got}"
            fix = "lagbench validate says what is wrong"
            yield finding("rescored", where, got, expected="valid predictions", fix=fix)
            return
        for inner in self.folder.reference_files(card.header.split, card.header.size):
            if inner.stem not in card.tallies or inner.stem == SUBMISSION:
                continue
            kept = read_score_file(self.folder.path / inner).scores
            same = kept.identity["dataset_sha256"] == card.header.dataset_sha256
            if same and (unlike := _unlike(card.tallies[inner.stem], kept)[0]):
                yield finding("rescored", inner, _listed(unlike), fix=REFERENCES_ANEW)
        known = [
            (entry, made, inner, said)
            for entry in self.entries
            for made, inner, said in zip(
                entry.predictions, entry.score_paths, entry.score.files, strict=True
            )
            if said.predictions_sha256 == card.predictions_sha256
        ]
        if not known:
            expected = "an entry with these predictions"
            yield finding("rescored", where, card.predictions_sha256, expected=expected)
        for entry, made, inner, said in known:
            if inner in self.sound:  # of others the checks of score files tell
                yield from self._compared(path, card, entry, made, inner, said)

    def _compared(
        self,
        path: str | Path,
        card: ScoreCard,
        entry: Entry,
        made: Prediction,
        inner: Path,
        said: ScoredFile,
    ) -> Iterator[Finding]:
        """Yield where a score card differs from a score file and what the entry says of
        it.
        """
        where = str(path)
        theirs = read_score_file(self.folder.path / inner)
        statistics = next(iter(theirs.scores.tallies.values())).names
        measured = {METRICS[name].extra for name in statistics if name in METRICS}
        if extras := sorted(extra for extra in measured if extra is not None):
            try:
                card = self.card(path, extras=extras)
            except UsageError as error:
                got = f"{error.what}, which measures some of them"
                yield finding(
                    "rescored", where, got, expected=f"the statistics of {inner}"
                )
                return
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / "scores.nc"
            write_statistics(card, file)
            ours = scored_file(card, file)
            stored = read_score_file(file)
        differing, difference = _unlike(stored.scores.tallies, theirs.scores)
        step = max(stored.precision, theirs.precision)
        for name, room in {"vorticity": 1.01 * step, "film": 1.01 * FILM_STEP}.items():
            a, b = (
                np.asarray(getattr(held.preview, name), np.float64)
                for held in (stored, theirs)
            )
            # pictures may differ by the steps in which they are packed
            if a.shape != b.shape or not np.allclose(
                a, b, rtol=1e-5, atol=room, equal_nan=True
            ):
                differing.append(f"{name} pictures")
        if differing:
            yield finding(
                "rescored", where, _listed(differing), expected=f"what {inner} holds"
            )
        told = {
            name: (getattr(ours, name), getattr(said, name))
            for name in ("flags", "warnings", "diverged_at")
        }
        for name, pair in {**told, "budget": (card.header.budget, made.budget)}.items():
            one, other = map(_named, pair)
            if one != other:
                differing.append(name)
                yield finding("rescored", where, one, expected=f"{name} {other}")
        if not differing:
            self.confirmed.append(
                Confirmation(Path(path), entry.yaml_path, inner, difference)
            )


def _unlike(
    ours: Mapping[int, Tally], theirs: SubmissionStatistics
) -> tuple[list[str], float]:
    """Return the names of statistics that differ, and the greatest relative difference
    of the others.
    """
    if {i: tally.frames for i, tally in ours.items()} != {
        i: t.frames for i, t in theirs.tallies.items()
    }:
        return ["scenarios or frames"], np.inf
    first = next(iter(theirs.tallies.values()))
    # of a long rollout the last bits may have pushed a value over to the next step of
    # its rounding
    if len(first.frames) > LONG_ROLLOUT:
        room = 2.0 ** (1 - LONG_BITS)
    else:
        room = TOLERANCE
    # what packages measure that one side lacks is on no board
    names = set(STATISTICS).intersection(
        (*next(iter(ours.values())).names, *first.names)
    )
    apart = {
        name: max(farthest(tally, theirs.tallies[i], name) for i, tally in ours.items())
        for name in names
    }
    within = max((value for value in apart.values() if value <= room), default=0.0)
    return sorted(name for name in names if apart[name] > room), within


def farthest(one: Tally, other: Tally, name: str) -> float:
    """Return the greatest relative difference of a statistic in a scenario; infinite
    where gaps differ.
    """
    if name not in one.names or name not in other.names:
        return np.inf
    a = one.series(name)
    b = other.series(name)
    if (
        not np.array_equal(one.measured(name), other.measured(name))
        or (np.isnan(a) != np.isnan(b)).any()
    ):
        return np.inf
    # what is stored are single precision floats
    a = a.astype(np.float32).astype(np.float64)
    b = b.astype(np.float32).astype(np.float64)
    apart = np.abs(a - b)[a != b]
    scale = np.maximum(np.abs(a), np.abs(b))[a != b]
    return float(np.nanmax(apart / scale, initial=0.0))


def _named(held: object) -> object:
    """Return flags as their names, marks of divergence by scenario."""
    if isinstance(held, dict):
        return dict(sorted(held.items()))
    if isinstance(held, tuple):
        return sorted(flag.name for flag in held)
    return held


def _listed(names: Sequence[str]) -> str:
    if len(names) > 5:
        more = f" and {len(names) - 5} more"
    else:
        more = ""
    return f"other {', '.join(names[:5])}{more}"


# keys of an entry that decide whether and how it stands on the board
KEYS = "status", "superseded_by"


def check_base(folder: Folder, base: str, own: Collection[str]) -> Iterator[Finding]:
    """Yield the entries of others that a change touches, removes, supersedes or alters
    in status.
    """
    start = _git(folder, "merge-base", base, "HEAD").decode().strip()
    told = _git(
        folder,
        "diff",
        "--name-status",
        "--no-renames",
        "--relative",
        "-z",
        start,
        "--",
        ".",
    )
    words = told.decode("utf-8", "replace").split("\0")[:-1]
    before = set(
        _git(folder, "ls-tree", "-r", "-z", "--name-only", start, ".")
        .decode()
        .split("\0")
    )
    changes = dict(zip(map(Path, words[1::2]), words[0::2], strict=True))
    # files that git does not follow yet may still take the place of others'
    untracked = (
        _git(folder, "ls-files", "--others", "-z", ".")
        .decode("utf-8", "replace")
        .split("\0")
    )
    changes |= {Path(name): "A" for name in untracked if name}
    for path, how in sorted(changes.items()):
        verb = {"A": "added", "D": "removed", "T": "replaced by a link"}.get(
            how[:1], "changed"
        )
        if path == Path(VERIFIED) or path.parts[0] == REFERENCES:
            if path == Path(VERIFIED):
                touched = not _only_own_lines_left(folder, start, own)
            else:
                touched = path.as_posix() in before
            if touched:
                yield finding(
                    "base", path, verb, expected="what the maintainers keep, unchanged"
                )
        elif path.parts[0] in (SUBMISSIONS, SCORES, WEIGHTS) and len(path.parts) == 4:
            method = path.stem.partition("_")[0]
            entry = Path(SUBMISSIONS, *path.parts[1:3], f"{method}.yaml")
            if entry.as_posix() not in before or method in own:
                continue
            if path == entry and how == "M":
                now = None
                file = folder.path / entry
                if (
                    folder.oddity(entry) is None
                    and file.stat().st_size <= MAX_ENTRY_BYTES
                ):
                    now = _plain(file.read_bytes())
                verb = _altered(
                    _plain(_git(folder, "show", f"{start}:./{entry.as_posix()}")), now
                )
            yield finding(
                "base", path, verb, expected=f"{entry} and its score files, unchanged"
            )


def _only_own_lines_left(folder: Folder, start: str, own: Collection[str]) -> bool:
    """Tell whether verified.yaml is what it was but for lines of one's own entries that
    are gone.
    """
    file = folder.path / VERIFIED
    try:
        before = _plain(_git(folder, "show", f"{start}:./{VERIFIED}"))
    except UsageError:  # it was not there
        return False
    fits = (
        file.is_file()
        and not file.is_symlink()
        and file.stat().st_size <= MAX_ENTRY_BYTES
    )
    if fits:
        now = _plain(file.read_bytes())
    else:
        now = None
    if not isinstance(before, dict) or not isinstance(now, dict):
        return False
    gone = before.keys() - now.keys()
    left = {name: line for name, line in before.items() if name in now}
    return (
        now == left and bool(gone) and all(Path(str(name)).stem in own for name in gone)
    )


def _altered(before: Any, now: Any) -> str:  # noqa: ANN401
    """Return which keys differ; those that decide how the entry stands with both
    values.
    """
    if not isinstance(before, dict) or not isinstance(now, dict):
        return "another content"
    names = [str(key) for key in {**before, **now} if before.get(key) != now.get(key)]
    said = [
        f"{key} {before.get(key)!a:.60} -> {now.get(key)!a:.60}"
        for key in KEYS
        if key in names
    ]
    others = [ascii(name)[1:-1][:40] for name in names if name not in KEYS][:8]
    return (
        "; ".join(said + ([f"other {', '.join(others)}"] if others else []))
        or "another wording"
    )


def _plain(data: bytes) -> Any:  # noqa: ANN401
    # the loader that makes text of every value: it cannot fail on numbers and dates
    try:
        if b"&" in data and b"*" in data:
            return None
        return yaml.load(data, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None


def _git(folder: Folder, *words: str) -> bytes:
    # settings of the checkout must neither run programs nor quote paths
    safe = (
        "-c",
        "core.fsmonitor=false",
        "-c",
        "core.quotePath=false",
        "--no-optional-locks",
    )
    try:
        done = subprocess.run(
            ["git", *safe, "-C", str(folder.path), *words],
            capture_output=True,
            check=True,
            timeout=60,
        )
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", None) or str(error).encode()
        raise UsageError(
            "git cannot say what the change alters",
            where=f"--base, {folder.path}",
            expected="a leaderboard in a git repository, and a revision that it "
            "knows, as in origin/main",
            got=ascii(said.decode("utf-8", "replace").strip().split("\n")[0][:200])[
                1:-1
            ],
            fix="run it in a clone with history (fetch the base), or leave --base out",
        ) from error
    return done.stdout
