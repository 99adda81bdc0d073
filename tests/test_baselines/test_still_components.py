"""Data in which a component never varies, as the velocity across a laminar flow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from lagbench.baselines.baseline import DatasetInfo
from lagbench.baselines.catalogue import find
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.rollout import roll_out
from lagbench.data.registry import Registry
from lagbench.make.generate import GenerationResult
from lagbench.torch import WindowDataset, collate

VELOCITY = ("velocity_std", "acceleration_std")


@pytest.fixture
def info(generated: GenerationResult, unmeasured: Registry) -> DatasetInfo:
    """The dataset info of tiny curl-noise."""
    return read_dataset_info(
        "curl-noise", "tiny", root=generated.root, registry=unmeasured
    )


@pytest.mark.parametrize(
    ("quantities", "axes"),
    [
        (("position_std", *VELOCITY), (1.0, 0.0)),
        (VELOCITY, (1.0, 0.0)),
        (VELOCITY, (0.0, 0.0)),
        (("acceleration_std",), (0.0, 0.0)),
    ],
    ids=["along a line", "shear flow", "at rest", "uniform motion"],
)
@pytest.mark.parametrize(
    ("baseline", "options"),
    [
        ("mlp", {}),
        ("mlp", {"target": "change"}),
        ("lstm", {}),
        ("gns", {"latent": 4, "layers": 1, "noise_std": 0.0, "recovery": 8.0}),
        ("neuralmpm", {"width": 4, "recovery": 8.0}),
    ],
)
def test_a_component_that_never_varies_leaves_numbers_finite(
    generated: GenerationResult,
    unmeasured: Registry,
    info: DatasetInfo,
    baseline: str,
    options: dict[str, Any],
    quantities: tuple[str, ...],
    axes: tuple[float, float],
) -> None:
    """Its deviation is 0, by which no model divides."""
    statistics = dict(info.statistics)
    for name in quantities:
        pairs = zip(statistics[name], axes, strict=True)
        statistics[name] = tuple(std * share for std, share in pairs)
    still = replace(info, statistics=statistics)
    torch.manual_seed(1)
    model = find(baseline).model.build(options, still)
    data = WindowDataset(
        "curl-noise",
        size="tiny",
        root=generated.root,
        registry=unmeasured,
        history=model.history,
        future=model.future,
    )
    batch = collate([data[0]])
    total = torch.zeros(())
    for name, term in model(batch, torch.Generator().manual_seed(2)).items():
        assert torch.isfinite(term), name
        total = total + term
    total.backward()
    for name, parameter in model.named_parameters():
        if parameter.grad is not None:
            assert torch.isfinite(parameter.grad).all(), name
    (rollout,) = roll_out(model, batch.part(slice(model.history)), 2)
    assert rollout.diverged_at is None
