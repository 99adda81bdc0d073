"""Score predictions again and compare with their score files: the proof of a score."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.table import METRICS
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import LONG_BITS, LONG_ROLLOUT, SUBMISSION
from lagbench.scoring.score import score
from lagbench.scoring.score_file import FILM_RANGE, LEVELS, StoredScores, write_statistics
from lagbench.submission.findings import Finding
from lagbench.work.progress import Progress

from .entry import Entry, ScoredFile
from .findings import FLOORS_ANEW, finding
from .folder import Folder
from .score_file import Stored, read_stored
from .submit import scored_file

__all__ = ["TOLERANCE", "Confirmation", "Rescoring", "farthest"]

TOLERANCE = 1e-6
"""Relative difference up to which two numbers are equal; NumPy versions may differ in the last bits."""

FILM_STEP = (FILM_RANGE[1] - FILM_RANGE[0]) / LEVELS
"""Step of packed film positions [length]."""


@dataclass(frozen=True, kw_only=True)
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
    registry: Registry
    root: str | Path | None = None  # folder of all data sets
    progress: Callable[[Progress], None] | None = None
    confirmed: list[Confirmation] = field(default_factory=list)

    def of_file(self, path: str | Path) -> Iterator[Finding]:
        """Yield where predictions differ from what the leaderboard says of them.

        A file that cannot be read or is not valid is a finding: it is opened by the scorer
        alone, after its checks in a child process.
        """
        where = str(path)
        try:
            card = self._card(path)
        except (UnreadableFileError, ChecksFailedError) as error:
            got = f"{error.what}: {error.got}"
            fix = "lagbench validate says what is wrong"
            yield finding("rescored", where, got, expected="valid predictions", fix=fix)
            return
        yield from self._floors(card)
        known = [
            (entry, inner, said)
            for entry in self.entries
            for inner, said in zip(entry.score_paths, entry.score.files, strict=True)
            if said.predictions_sha256 == card.predictions_sha256
        ]
        if not known:
            yield finding(
                "rescored", where, card.predictions_sha256, expected="an entry with these predictions"
            )
        for entry, inner, said in known:
            yield from self._compared(path, card, entry, inner, said)

    def entries_confirmed(self) -> list[Entry]:
        """Return the entries of which every score file was confirmed."""
        found = {one.score_file for one in self.confirmed}
        return [entry for entry in self.entries if found.issuperset(entry.score_paths)]

    def _card(self, path: str | Path, extras: Collection[str] = ()) -> ScoreCard:
        return score(
            path, root=self.root, registry=self.registry, progress=self.progress, extras=extras, write=False
        )

    def _floors(self, card: ScoreCard) -> Iterator[Finding]:
        """Yield floors whose scores are not those that were measured beside the predictions."""
        for path in self.folder.floor_files(card.header.split, card.header.size):
            if path.stem in card.tallies and path.stem != SUBMISSION:
                held = read_stored(self.folder.path / path).scores
                if held.identity["dataset_sha256"] != card.header.dataset_sha256:
                    continue
                told = _unlike(dict(card.tallies[path.stem]), held)
                if told[0]:
                    yield finding("rescored", path, _listed(told[0]), fix=FLOORS_ANEW)

    def _compared(
        self, path: str | Path, card: ScoreCard, entry: Entry, inner: Path, said: ScoredFile
    ) -> Iterator[Finding]:
        """Yield where a score card differs from a score file and what the entry says of it."""
        if inner not in self.sound:
            return  # told by the checks of the score file
        where, theirs = str(path), read_stored(self.folder.path / inner)
        extras = _extras(theirs.scores)
        if extras:
            try:
                card = self._card(path, extras)
            except UsageError as error:
                got = f"{error.what}, which measures some of them"
                yield finding("rescored", where, got, expected=f"the statistics of {inner}")
                return
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / "scores.nc"
            write_statistics(card, file)
            ours, stored = scored_file(card, file), read_stored(file)
        differing, difference = _unlike(dict(stored.scores.tallies), theirs.scores)
        differing += _other_pictures(stored, theirs)
        if differing:
            yield finding("rescored", where, _listed(differing), expected=f"what {inner} holds")
        for name in ("flags", "warnings", "diverged_at"):
            one, other = _named(getattr(ours, name)), _named(getattr(said, name))
            if one != other:
                differing.append(name)
                yield finding("rescored", where, one, expected=f"{name} {other}")
        made = entry.predictions[entry.score_paths.index(inner)]
        if made.budget != card.header.budget:
            differing.append("budget")
            yield finding("rescored", where, card.header.budget, expected=f"budget {made.budget}")
        if not differing:
            found = Confirmation(
                predictions=Path(path), entry=entry.yaml_path, score_file=inner, difference=difference
            )
            self.confirmed.append(found)


def _unlike(ours: dict[int, Tally], theirs: StoredScores) -> tuple[list[str], float]:
    """Return the names of statistics that differ, and the greatest relative difference of the others."""
    if set(ours) != set(theirs.tallies) or any(
        tally.frames != theirs.tallies[i].frames for i, tally in ours.items()
    ):
        return ["scenarios or frames"], np.inf
    first = next(iter(theirs.tallies.values()))
    # of a long rollout the last bits may have pushed a value over to the next step of its rounding
    room = 2.0 ** (1 - LONG_BITS) if len(first.frames) > LONG_ROLLOUT else TOLERANCE
    names = dict.fromkeys((*next(iter(ours.values())).names, *first.names))
    apart = {
        name: max(farthest(tally, theirs.tallies[i], name) for i, tally in ours.items()) for name in names
    }
    return [n for n in names if apart[n] > room], max((v for v in apart.values() if v <= room), default=0.0)


def farthest(one: Tally, other: Tally, name: str) -> float:
    """Return the greatest relative difference of a statistic in a scenario; infinite where gaps differ."""
    if name not in one.names or name not in other.names:
        return np.inf
    a, b = one.series(name), other.series(name)
    if not np.array_equal(one.measured(name), other.measured(name)) or (np.isnan(a) != np.isnan(b)).any():
        return np.inf
    # what is stored are single precision floats
    a, b = a.astype(np.float32).astype(np.float64), b.astype(np.float32).astype(np.float64)
    apart = np.abs(a - b)[a != b]
    scale = np.maximum(np.abs(a), np.abs(b))[a != b]
    return float(np.nanmax(apart / scale, initial=0.0))


def _other_pictures(one: Stored, other: Stored) -> list[str]:
    """Return which pictures differ by more than the steps in which they are packed."""
    step = max(one.precision, other.precision)
    rooms = {"vorticity": 1.01 * step, "film": 1.01 * FILM_STEP}
    found = []
    for name, room in rooms.items():
        a, b = (np.asarray(getattr(held.preview, name), np.float64) for held in (one, other))
        if a.shape != b.shape or not np.allclose(a, b, rtol=1e-5, atol=room, equal_nan=True):
            found.append(f"{name} pictures")
    return found


def _extras(held: StoredScores) -> tuple[str, ...]:
    """Return the extras whose metrics a score file has."""
    names = next(iter(held.tallies.values())).names
    found = {METRICS[name].extra for name in names if name in METRICS}
    return tuple(sorted(extra for extra in found if extra is not None))


def _named(held: object) -> object:
    """Return flags as their names, marks of divergence by scenario."""
    if isinstance(held, dict):
        return dict(sorted(held.items()))
    return sorted(flag.name for flag in held) if isinstance(held, tuple) else held


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"other {', '.join(names[:5])}{more}"
