"""Hand in a registered architecture that you trained with a program of your own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lagbench.atomic import checked_path
from lagbench.baselines.baseline import Baseline
from lagbench.baselines.catalogue import find
from lagbench.baselines.checkpoint import SUFFIX, Checkpoint, load, restore, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.recipe import check_options
from lagbench.data.layout import expand_home
from lagbench.data.registry import Registry
from lagbench.errors import UsageError

__all__ = ["build_registered", "export_safetensors"]

RECIPE = "own-training"
"""Name of the recipe of a model that `lagbench train` did not train."""


def build_registered(
    baseline: str,
    *,
    split: str | Path,
    size: str | None = None,
    options: Mapping[str, Any] | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Baseline:
    """Return an untrained model of a registered architecture, a ``torch.nn.Module``.

    Args:
        baseline: name of the architecture, such as ``gns`` or ``neuralmpm``.
        split: name of the split.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        options: options of the model; those that are missing have their defaults.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: no such architecture, an option that does not fit, or it cannot be
            built for this data set.
        DataError: the data set is not generated.
    """
    info = read_dataset_info(split, size, root=root, registry=registry)
    model = find(baseline).model
    stated = dict(options or {})
    check_options(model.Options, stated, "options", group="model")
    return model.build(stated, info)


def export_safetensors(
    model: Baseline, path: str | Path, *, baseline: str, seed: int = 0, step: int = 0
) -> Path:
    """Write a trained model as a file of safetensors, for an entry of a leaderboard.

    Args:
        model: a model of :func:`build_registered`.
        path: file to write, named ``.safetensors``.
        baseline: name of its architecture.
        seed: seed of the training, below 2^63.
        step: steps of the training, below 2^63.

    Raises:
        UsageError: the file has another suffix, or no such architecture is installed.
        UnreadableFileError: weights are not finite, or the model is of another
            architecture.
        WorkFailedError: the file cannot be written.
    """
    target = expand_home(path, "export_safetensors, path")
    if target.suffix != SUFFIX:
        raise UsageError(f"name the file {target.stem}{SUFFIX}")
    checkpoint = Checkpoint(
        baseline=baseline,
        options=model.options.model_dump(mode="json"),
        info=model.info,
        weights=model.state_dict(),
        training={
            "step": int(step),
            "recipe": {"name": RECIPE, "training": {"seed": int(seed)}},
        },
    )
    restore(checkpoint, where=str(target))
    with checked_path(target, option="path") as unchecked:
        save(unchecked, checkpoint)
        load(unchecked)
    return target
