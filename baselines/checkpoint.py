"""Weights and checkpoints: tensors by name and a JSON text, in a file of safetensors.

Such a file holds numbers only, so nothing in it can run. The JSON text in its header,
under the key ``lagbench``, says what builds the model: baseline, options, figures of
the data set, and the log of the training. A checkpoint to go on from holds the state of
the optimiser too, as tensors named ``optimizer/<parameter>/<name>``.

Format: https://huggingface.co/docs/safetensors
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from pydantic import BaseModel, ValidationError
from torch import Tensor, nn

from lagbench.atomic import atomic_path
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    UsageError,
    check_regular,
)
from lagbench.submission.budget import Budget, parse_budget
from lagbench.submission.provenance import StartWeights, TrainingProvenance

from .baseline import Baseline, DatasetInfo
from .catalogue import find
from .dataset_info import read_dataset_info

SUFFIX = ".safetensors"
KEY = "lagbench"  # of the JSON text in the header
START_DIGITS = 12  # digits of a SHA-256 that provenance names
OPTIMIZER = "optimizer/"  # begins the names of the optimiser's tensors


class OtherVersionWarning(UserWarning):
    """A model is run on another major version of the data than it was trained on."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A model with all that it needs to predict, and to train on."""

    baseline: str  # name of the baseline
    options: Mapping[str, Any]  # options of the model, plain values
    info: DatasetInfo  # public figures of the data set of its training
    weights: Mapping[str, Tensor]  # parameters and buffers by name
    # log of the training so far, plain values
    training: Mapping[str, Any] = field(default_factory=dict)
    # tensors of the optimiser by "<parameter>/<name>"; None in a file for predictions
    optimizer: Mapping[str, Tensor] | None = None

    @property
    def budget(self) -> Budget | None:
        """Budget of the training; None where it is unknown."""
        return parse_budget(json.dumps(self.training.get("budget")))

    @property
    def recipe(self) -> Mapping[str, Any]:
        """Recipe of the training, plain values."""
        recipe: Mapping[str, Any] = self.training.get("recipe", {})
        return recipe

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return int(self.recipe.get("training", {}).get("seed", 0))

    def provenance(self) -> TrainingProvenance:
        """Return the training behind the weights.

        Raises:
            UnreadableFileError: the record of the training is damaged.
        """
        start = self.recipe.get("start")
        start_weights = None
        try:
            if start:
                start_weights = StartWeights(
                    recipe=start["recipe"], weights=start["sha256"][:START_DIGITS]
                )
            return TrainingProvenance(
                split=self.info.split,
                size=self.info.size,
                subsets=tuple(
                    self.recipe.get("training", {}).get("windows", ("train",))
                ),
                recipe=str(self.recipe.get("name")),
                step=self.training.get("step", 0),
                overrides=tuple(self.recipe.get("settings", ())),
                start=start_weights,
            )
        except (ValidationError, TypeError, KeyError) as error:
            raise UnreadableFileError(
                f"the weights record a damaged training: {error!r}"
            ) from error


class _Header(BaseModel):
    """The JSON text in the header of a file."""

    baseline: str
    options: dict[str, Any]
    facts: DatasetInfo
    training: dict[str, Any]


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; it appears whole or not at all.

    Raises:
        UsageError: a weight is no dense tensor of real numbers.
        WorkFailedError: the disk is full, or nobody may write there.
    """
    facts = asdict(checkpoint.info)
    if not checkpoint.info.wall_particles:
        del facts["wall_particles"]
    header = {
        "baseline": checkpoint.baseline,
        "options": dict(checkpoint.options),
        "facts": facts,
        "training": dict(checkpoint.training),
    }
    tensors = dict(checkpoint.weights)
    for name, tensor in (checkpoint.optimizer or {}).items():
        tensors[OPTIMIZER + name] = tensor

    copies = {}
    for name, tensor in tensors.items():
        if tensor.layout is not torch.strided or tensor.is_complex():
            raise UsageError(
                f"{name!r} is no dense tensor of real numbers; register a buffer with "
                "persistent=False",
                where=str(path),
            )
        # The format holds no two names for one memory.
        on_cpu = tensor.detach().cpu()
        copies[name] = on_cpu.contiguous().clone()
    text = json.dumps(header, sort_keys=True)
    content = safetensors.torch.save(copies, metadata={KEY: text})
    with atomic_path(path, option="--output") as temporary:
        temporary.write_bytes(content)


def load(path: str | Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        UnreadableFileError: the file is no checkpoint, or damaged.
    """
    check_regular(Path(path))
    try:
        with safetensors.safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = _Header.model_validate_json(metadata[KEY])
    except (
        safetensors.SafetensorError,
        KeyError,
        ValidationError,
        RuntimeError,
    ) as error:
        first_line = str(error).split("\n")[0]
        raise UnreadableFileError(
            f"no weights of lagbench in a .safetensors file: {first_line[:200]}; name "
            "weights that `lagbench train` wrote; if the file was copied or "
            "downloaded, compare its length",
            where=str(path),
        ) from error

    weights = {}
    optimizer = {}
    for name, tensor in tensors.items():
        if name.startswith(OPTIMIZER):
            optimizer[name.removeprefix(OPTIMIZER)] = tensor
        else:
            weights[name] = tensor
    return Checkpoint(
        baseline=header.baseline,
        options=header.options,
        info=header.facts,
        weights=weights,
        training=header.training,
        optimizer=optimizer or None,
    )


def restore(checkpoint: Checkpoint, *, where: str = "the checkpoint") -> Baseline:
    """Return the model of a checkpoint, in float32, ready to predict.

    Raises:
        UsageError: the baseline is not installed.
        UnreadableFileError: options or weights do not fit the model.
    """
    entry = find(checkpoint.baseline)
    try:
        model = entry.model.build(checkpoint.options, checkpoint.info)
    except ValidationError as error:
        raise UnreadableFileError(
            f"options of another version of {checkpoint.baseline}: {error}",
            where=where,
        ) from None
    load_weights(model, checkpoint.weights, where=where)
    return model.eval()


def load_weights(
    model: nn.Module, weights: Mapping[str, Tensor], *, where: str
) -> None:
    """Copy weights into a model; those in bfloat16 become float32.

    Raises:
        UnreadableFileError: weights are not finite, or do not fit the model.
    """
    for name, value in weights.items():
        if not value.to(torch.float32).isfinite().all():
            raise UnreadableFileError(
                f"{name} is not finite; take an earlier checkpoint", where=where
            )
    try:
        model.load_state_dict(dict(weights))
    except RuntimeError as error:
        one_line = " ".join(str(error).split())
        raise UnreadableFileError(
            f"the weights do not fit the model: {one_line[:300]}", where=where
        ) from None


def round_weights(model: nn.Module) -> dict[str, Tensor]:
    """Return parameters in bfloat16; buffers (statistics, closed forms) stay exact."""
    parameter_names = {name for name, _ in model.named_parameters()}
    rounded = {}
    for name, value in model.state_dict().items():
        if name in parameter_names:
            rounded[name] = value.detach().to(torch.bfloat16)
        else:
            rounded[name] = value.detach()
    return rounded


def check_data(
    checkpoint: Checkpoint,
    *,
    root: Path,
    registry: Registry,
    size: str | None = None,
    where: str,
) -> DatasetInfo:
    """Check that a model can be run on the data at hand, and return their info.

    ``size`` may be another size than that of the training. An
    :class:`OtherVersionWarning` tells of data of another major version.

    Raises:
        DataError: the data set is missing.
        UsageError: the model cannot be run at that size.
    """
    trained = checkpoint.info
    entry = find(checkpoint.baseline)
    try:
        registry.split(trained.split)
    except UsageError as error:
        raise DataError(
            f"no data of the training: {error.text}", where=where
        ) from error
    tier = registry.size(trained.split, size or trained.size)
    if tier.name != trained.size and not entry.model.any_size:
        raise UsageError(
            f"{entry.model.method} predicts only the size that it was trained on, "
            f"{trained.size}",
            where=where,
        )
    target = read_dataset_info(trained.split, tier.name, root=root, registry=registry)
    if target.version.partition(".")[0] != trained.version.partition(".")[0]:
        message = (
            f"{where} was trained on version {trained.version} of {trained.split}; the "
            f"data at hand are {target.version}"
        )
        warnings.warn(message, OtherVersionWarning, stacklevel=2)
    same_box = target.box == trained.box
    same_interval = target.frame_interval == trained.frame_interval
    if tier.name != trained.size and not (same_box and same_interval):
        raise UsageError(
            f"{target.split} {target.size} {target.version} has another box or frame "
            "interval than the data of the training; train on it",
            where=where,
        )
    return target
