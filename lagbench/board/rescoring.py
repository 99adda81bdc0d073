"""Score submitted predictions again and compare with their score files: the proof of a score."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from lagbench.errors import LagbenchError
from lagbench.metrics import Tally
from lagbench.progress import Progress
from lagbench.registry import Registry
from lagbench.score_card import ScoreCard
from lagbench.scoring import score
from lagbench.sitting import SUBMISSION
from lagbench.submission import Finding

from .entry import ScoredFile
from .entry_checks import finding
from .entry_file import read_entry
from .folder import Folder
from .score_checks import RESCORE, TOLERANCE
from .stored import read_stored

__all__ = ["check_predictions"]


def check_predictions(
    folder: Folder,
    predictions: Sequence[str | Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Iterator[Finding]:
    """Yield where predictions, scored again, differ from what the leaderboard says of them.

    Args:
        folder: the leaderboard's folder; its entries have been checked.
        predictions: predictions.nc of entries, in any order.
        root: folder of all data sets.
        registry: where splits are described; ours when None.
        workers: worker processes of the scorer.
        progress: told how far the scoring is.

    Raises:
        UnreadableFileError: predictions cannot be read.
        ChecksFailedError: they are not valid.
        DataError: the test subset is missing, or they were made from another data set.
    """
    known = _known(folder)
    for path in predictions:
        card = score(path, root=root, registry=registry, workers=workers, progress=progress, write=False)
        if card.predictions_sha256 not in known:
            yield _differs(str(path), "an entry with these predictions", card.predictions_sha256)
            continue
        inner, said = known[card.predictions_sha256]
        yield from _compared(str(path), card, folder.path / inner, said)


def _known(folder: Folder) -> dict[str, tuple[Path, ScoredFile]]:
    """Return content hash of predictions to their score file and what the entry says of it."""
    known = {}
    for path in folder.entries():
        try:
            entry = read_entry(folder.path / path)
        except LagbenchError:
            continue  # told by the checks of the entry
        for inner, said in zip(entry.score_paths, entry.score.files, strict=True):
            known[said.predictions_sha256] = inner, said
    return known


def _compared(where: str, card: ScoreCard, path: Path, said: ScoredFile) -> Iterator[Finding]:
    ours, theirs = card.tallies[SUBMISSION], read_stored(path).scores.tallies
    names = next(iter(ours.values())).names
    differing = [name for name in names if not _same(name, ours, theirs)]
    if differing:
        yield _differs(where, "the statistics of its score file", f"other {', '.join(differing[:5])}")
    raised = sorted(flag.name for flag in card.flags if flag.raised)
    if raised != sorted(flag.name for flag in said.flags):
        yield _differs(where, f"flags {[flag.name for flag in said.flags]}", f"{raised}")


def _same(name: str, ours: Mapping[int, Tally], theirs: Mapping[int, Tally]) -> bool:
    """Tell whether a statistic is the same in all scenarios and frames."""
    if set(ours) != set(theirs) or name not in next(iter(theirs.values())).names:
        return False
    return all(
        np.allclose(ours[i].series(name), theirs[i].series(name), rtol=TOLERANCE, atol=0.0, equal_nan=True)
        for i in ours
    )


def _differs(where: str, expected: str, got: str) -> Finding:
    return finding(
        "rescored",
        "scored again, the predictions are not what the leaderboard says",
        where=where,
        expected=expected,
        got=got,
        fix=RESCORE,
    )
