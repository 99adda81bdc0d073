"""What a file of weights that a submitter gives holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from lagbench.data.checksums import file_sha256
from lagbench.submission.provenance import TrainingProvenance

from .checkpoint import load
from .provenance import training_provenance


@dataclass(frozen=True, kw_only=True)
class WeightsFile:
    """What a file of weights holds."""

    path: Path
    sha256: str
    is_state: bool  # a state to go on from, with an optimiser
    baseline: str
    data_set: tuple[str, str, str]  # split, size and SHA-256
    seed: int
    provenance: TrainingProvenance
    parameters: int | None  # None where the weights are not rounded


def inspect_weights(path: Path) -> WeightsFile:
    """Read a file of weights; nothing in it is run.

    Raises:
        UnreadableFileError: the file is damaged or no weights.
    """
    checkpoint = load(path)
    info = checkpoint.info
    parameters = 0  # those in bfloat16; a file of our own training has no others
    for value in checkpoint.weights.values():
        if value.dtype == torch.bfloat16:
            parameters += value.numel()
    return WeightsFile(
        path=path,
        sha256=file_sha256(path),
        is_state=checkpoint.optimizer is not None,
        baseline=checkpoint.baseline,
        data_set=(info.split, info.size, info.dataset_sha256),
        seed=checkpoint.seed,
        provenance=training_provenance(checkpoint),
        parameters=parameters or None,
    )
