"""The digest of a score block: shows that somebody edited it, not who.

SHA-256 over the canonical JSON of the block without its digest, of the place of the entry,
of its data set, of the hashes and seeds of its predictions, and of what the submitter claims
and nothing can compute again: cost, parameters, hardware and training. Whoever recomputes the
digest can forge it; what proves a score is to score the predictions again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from lagbench.data.checksums import canonical_json

from .entry import About, DataSet, PredictionEntry, ScoreBlock

__all__ = ["CLAIMS", "digest_of", "sealed"]

CLAIMS = ("cost", "parameters", "hardware", "training")
"""Keys that only the submitter knows about; sealed, so that an edit after the submission is seen."""

UNSEALED = "0" * 64


def digest_of(
    place: tuple[str, str, str],
    dataset: DataSet,
    predictions: Sequence[PredictionEntry],
    about: About,
    block: ScoreBlock,
) -> str:
    """Return the digest that a score block must have."""
    value = {
        "place": list(place),
        "dataset": dataset.model_dump(),
        "predictions": [[made.sha256, -1 if made.seed is None else made.seed] for made in predictions],
        "claims": about.model_dump(mode="json", include=set(CLAIMS), exclude_none=True),
        "score": block.model_dump(mode="json", exclude={"digest"}, exclude_none=True),
    }
    return hashlib.sha256(canonical_json(value)).hexdigest()


def sealed(
    place: tuple[str, str, str],
    dataset: DataSet,
    predictions: Sequence[PredictionEntry],
    about: About,
    block: ScoreBlock,
) -> ScoreBlock:
    """Return a score block with its digest."""
    return block.model_copy(update={"digest": digest_of(place, dataset, predictions, about, block)})
