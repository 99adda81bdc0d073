"""Score predictions again and compare with their score files: the proof of a score."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Registry, Size
from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError
from lagbench.metrics import METRICS
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.score_file import write_statistics
from lagbench.submission import Finding
from lagbench.submission.truth import Truth
from lagbench.work.progress import Progress

from .entry import Entry, ScoredFile
from .entry_checks import finding
from .floor_predictions import write_floor
from .folder import Folder
from .likeness import unlike
from .score_checks import RESCORE
from .scored import scored_file
from .stored import Stored, read_stored

__all__ = ["Rescoring", "within_reach"]


@dataclass(frozen=True, kw_only=True)
class Rescoring:
    """Scores predictions of entries again."""

    folder: Folder  # the leaderboard's folder
    entries: Sequence[Entry]  # entries whose files have been checked
    sound: Collection[Path]  # score files that can be read
    registry: Registry  # where splits are described
    root: str | Path | None = None  # folder of all data sets
    progress: Callable[[Progress], None] | None = None  # told how far the scoring is

    def of_files(self, predictions: Sequence[str | Path]) -> Iterator[Finding]:
        """Yield where predictions differ from what the leaderboard says of them.

        A file that cannot be read or is not valid is a finding: it is opened by the scorer
        alone, after its checks in a child process.
        """
        for path in predictions:
            where = str(path)
            try:
                card = self._card(path)
            except (UnreadableFileError, ChecksFailedError) as error:
                got = f"{error.what}: {error.got}"
                yield _differs(where, "valid predictions", got, fix="lagbench validate says what is wrong")
                continue
            content = card.predictions_sha256
            known = [held for held in self._files() if held[1].predictions_sha256 == content]
            if not known:
                yield _differs(where, "an entry with these predictions", content)
            for inner, said in known:
                yield from self._compared(where, path, card, inner, said)

    def of_floor(self, entry: Entry) -> Iterator[Finding]:
        """Yield where a floor, predicted and scored anew, differs from its entry."""
        (inner,), (said,) = entry.score_paths[:1], entry.score.files[:1]
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "predictions.nc"
            write_floor(
                entry.method,
                path,
                split=entry.split,
                size=entry.size,
                root=self.root,
                registry=self.registry,
            )
            card = self._card(path)
            if card.predictions_sha256 != said.predictions_sha256:
                got = said.predictions_sha256
                yield _differs(str(entry.yaml_path), f"predictions {card.predictions_sha256}", got)
            yield from self._compared(str(entry.yaml_path), path, card, inner, said)

    def _files(self) -> list[tuple[Path, ScoredFile]]:
        return [
            pair for entry in self.entries for pair in zip(entry.score_paths, entry.score.files, strict=True)
        ]

    def _card(self, path: str | Path, extras: Collection[str] = ()) -> ScoreCard:
        return score(
            path, root=self.root, registry=self.registry, progress=self.progress, extras=extras, write=False
        )

    def _compared(
        self, where: str, path: str | Path, card: ScoreCard, inner: Path, said: ScoredFile
    ) -> Iterator[Finding]:
        """Yield where a score card differs from a score file and what the entry says of it."""
        if inner not in self.sound:
            return  # told by the checks of the score file
        theirs = read_stored(self.folder.path / inner)
        extras = _extras(theirs)
        if extras:
            try:
                card = self._card(path, extras)
            except UsageError as error:
                yield _differs(
                    where, f"the statistics of {inner}", f"{error.what}, which measures some of them"
                )
                return
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / "scores.nc"
            write_statistics(card, file)
            differing, ours = list(unlike(read_stored(file), theirs)), scored_file(card, file)
        if differing:
            more = f" and {len(differing) - 5} more" if len(differing) > 5 else ""
            yield _differs(where, f"what {inner} holds", f"other {', '.join(differing[:5])}{more}")
        for name, one, other in _said(ours, said):
            yield _differs(where, f"{name} {other}", str(one))


def _extras(held: Stored) -> tuple[str, ...]:
    """Return the extras whose metrics a score file has."""
    names = next(iter(held.scores.tallies.values())).names
    found = {METRICS[name].extra for name in names if name in METRICS}
    return tuple(sorted(extra for extra in found if extra is not None))


def _said(ours: ScoredFile, theirs: ScoredFile) -> Iterator[tuple[str, object, object]]:
    """Yield what the scorer says beside the numbers, where the entry says something else."""
    for name, said in (("flags", _flags), ("warnings", _warnings), ("diverged_at", _marks)):
        if said(ours) != said(theirs):
            yield name, said(ours), said(theirs)


def _flags(held: ScoredFile) -> object:
    return sorted(flag.name for flag in held.flags)


def _warnings(held: ScoredFile) -> object:
    return sorted(warning.name for warning in held.warnings)


def _marks(held: ScoredFile) -> object:
    return dict(sorted(held.diverged_at.items()))


def _differs(where: str, expected: str, got: str, *, fix: str = RESCORE) -> Finding:
    return finding(
        "rescored",
        "scored again, the predictions are not what the leaderboard says",
        where=where,
        expected=expected,
        got=got,
        fix=fix,
    )


def within_reach(size: Size, root: Path) -> bool:
    """Tell whether the test subset of a split and size lies in a folder of data sets."""
    truth = Truth(size, root)
    return all(truth.path(i).is_file() for i in size.subsets["test"])
