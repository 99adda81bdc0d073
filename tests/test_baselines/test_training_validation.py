"""Validation while a model is trained: the scorer's digits, how often, and what a
training then says.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import torch
from simple_models import Drift, trainer

from lagbench.baselines.checkpoint import load, restore
from lagbench.baselines.predict import predict
from lagbench.baselines.recipe import TrainingOptions
from lagbench.baselines.rollout import Validation
from lagbench.baselines.train import TrainingResult
from lagbench.data.registry import Registry
from lagbench.errors import DataError
from lagbench.make.generate import GenerationResult
from lagbench.scoring.score import score
from lagbench.scoring.task import load_scored_task

Run = Callable[..., TrainingResult]


@pytest.fixture
def run(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Run:
    """Train on tiny curl-noise data."""
    return trainer(
        generated.root,
        unmeasured,
        tmp_path,
        monkeypatch,
        drift=Drift,
    )


def validated_on_test(
    weights: Path,
    registry: Registry,
    root: Path,
    split: str,
) -> float:
    """Return what validation says of stored weights when the test subset stands in for
    valid.
    """
    task = load_scored_task(registry.size(split, "tiny"), root)
    frames = {}
    for scenario in task.scenarios:
        with task.opened(scenario) as opened:
            frames[scenario] = len(opened.scenario.moving_frames)
    torch.set_num_threads(1)
    model = restore(load(weights))
    return Validation(task=task, frames=frames).measure(model)


def scored(
    weights: Path,
    registry: Registry,
    root: Path,
    name: str,
) -> float:
    """Return what the score card says of the predictions of stored weights."""
    predict(
        weights,
        weights.with_name("predictions.nc"),
        root=root,
        registry=registry,
        threads=1,
    )
    card = score(
        weights.with_name("predictions.nc"),
        root=root,
        registry=registry,
        write=False,
    )
    return card.scores["submission"][name].mean


@pytest.mark.parametrize(
    "baseline", [pytest.param("gns", marks=pytest.mark.slow), "mlp"]
)
def test_digits_of_the_scorer_in_a_full_box(
    run: Run,
    generated: GenerationResult,
    unmeasured: Registry,
    baseline: str,
) -> None:
    """On the same scenarios validation and score card have the same vorticity NRMSE, to
    the digit.
    """
    result = run(baseline, "steps=2")
    assert result.metric == "vorticity_nrmse"
    there = (result.weights, unmeasured, generated.root)
    assert validated_on_test(*there, "curl-noise") == scored(*there, "vorticity_nrmse")


@pytest.mark.slow
def test_digits_of_the_scorer_on_the_free_surface(
    run: Run,
    unmeasured: Registry,
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """The same for the distance of clouds, although rollouts end where the truth
    rests.
    """
    root = tiny_split("fluid").root
    result = run("neuralmpm", "steps=2", root=root, split="fluid")
    assert result.metric == "cloud_distance"
    weights = result.weights
    validated = validated_on_test(weights, unmeasured, root, "fluid")
    assert validated == scored(weights, unmeasured, root, "cloud_distance")


def test_all_of_valid_and_no_other(run: Run, copied: Callable[[], Path]) -> None:
    """Every scenario of valid counts, the test subset is not needed, and a lost
    scenario is an error.
    """
    root = copied()
    dataset = root / "curl-noise/tiny/v2"
    for file in (dataset / "test").glob("*.nc"):
        file.unlink()
    result = run("drift", "steps=1", root=root)
    assert result.best_value is not None
    files = sorted((dataset / "valid").glob("*.nc"))
    with netCDF4.Dataset(files[-1]) as data:
        position = data["position"][:]
    assert np.isfinite(position).all()
    files[-1].unlink()
    with pytest.raises(DataError) as caught:
        run("drift", "steps=1", root=root, fresh=True)
    assert caught.value.where.endswith("root/curl-noise/tiny/v2/valid")


def validated_steps(
    options: TrainingOptions,
    *,
    steps: int,
    validations: int,
) -> list[int]:
    """Return the steps after which a training validates."""
    validated = []
    for step in range(1, steps + 1):
        if options.is_validated(step, steps=steps, validations=validations):
            validated.append(step)
    return validated


@pytest.mark.parametrize(
    ("steps", "trained", "rolled", "expected"),
    [
        (5000, 64, 720, 8),  # NeuralMPM: four windows of 16 frames a step
        (6500, 1, 720, 2),  # GNS: 0.15 * 1.5 * 6500 / 720 = 2.03
        (6300, 1, 720, 1),
        (10, 1, 720, 1),
    ],
)
def test_validations_share_a_training_evenly(
    steps: int, trained: int, rolled: int, expected: int
) -> None:
    """Validations share a training evenly, the last step among them, and take at most
    15 % of it.
    """
    options = TrainingOptions()
    count = options.count_validations(steps, trained=trained, rolled=rolled)
    validated = validated_steps(options, steps=steps, validations=count)
    assert count == expected
    assert len(validated) == count
    assert validated[-1] == steps
    if count > 1:
        assert validated[count // 2 - 1] == steps // 2
