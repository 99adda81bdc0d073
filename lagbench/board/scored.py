"""The score block of an entry: what the scorer says, as YAML holds it.

``lagbench submit`` forms it from score cards, ``lagbench leaderboard check`` forms its numbers
again from score files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lagbench import __version__
from lagbench.data.checksums import file_sha256
from lagbench.scoring.card import ScoreCard

from .entry import LONGEST_TEXT, About, DataSet, FlagEntry, PredictionEntry, ScoreBlock, ScoredFile, Summary
from .seal import UNSEALED, sealed

__all__ = ["score_block", "scored_file"]


def scored_file(card: ScoreCard, path: Path) -> ScoredFile:
    """Return what an entry says of a score file."""
    return ScoredFile(
        sha256=file_sha256(path),
        predictions_sha256=card.predictions_sha256,
        diverged_at=dict(sorted(card.header.diverged_at.items())),
        flags=tuple(_flag(flag.name, flag.reasons) for flag in card.flags if flag.raised),
        warnings=tuple(_flag(found.check, (f"{found.what}: {found.got}",)) for found in card.warnings),
    )


def _flag(name: str, reasons: Sequence[str]) -> FlagEntry:
    return FlagEntry(name=name, reasons=tuple(reason[:LONGEST_TEXT] for reason in reasons))


def score_block(
    place: tuple[str, str, str],
    dataset: DataSet,
    predictions: Sequence[PredictionEntry],
    files: Sequence[ScoredFile],
    metrics: Mapping[str, Summary],
    *,
    about: About,
    ranking: str,
    scored_by: str,
) -> ScoreBlock:
    """Return a sealed score block."""
    block = ScoreBlock(
        scored_by=scored_by,
        lagbench=__version__,
        dataset_sha256=dataset.sha256,
        ranking_metric=ranking,
        files=tuple(files),
        metrics=dict(metrics),
        digest=UNSEALED,
    )
    return sealed(place, dataset, predictions, about, block)
