"""Trainings that start from weights: what they go on from, what they cost, what is
refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import torch
from simple_models import Drift, read_training_log, trainer

from lagbench.baselines.baseline import DatasetInfo
from lagbench.baselines.checkpoint import Checkpoint, load, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.predict import predict
from lagbench.baselines.train import TrainingResult
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Registry
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.make.generate import GenerationResult
from lagbench.work.run import Progress

Run = Callable[..., TrainingResult]
Changes = dict[str, Any] | None
STILL = ("steps=1", "learning_rate=1e-30")
"""One step that changes no weight by as much as its rounding."""


class AnySize(Drift):
    """A Drift in the units of its statistics, of any size; ``unit`` says what its
    weight means.

    ``share`` has no weights: that of weights to start from is kept.
    """

    any_size = True

    class Options(Drift.Options):
        """See above."""

        of_weights = frozenset({"unit"})
        unit: float = 1.0
        share: float = 1.0

    def __init__(self, options: Any, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.speed = info.statistics["velocity_std"][0]

    def advance(self, state: Any) -> Any:
        """Drift by a share of what is usual."""
        state, position = super().advance(state)
        distance = self.options.share * self.speed * self.a
        return state, position + distance


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
        any=AnySize,
    )


@pytest.fixture
def stored(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
) -> Callable[..., Path]:
    """Store weights of a made-up training; ``info`` change those of the data."""

    def call(
        baseline: str = "any",
        *,
        info: Changes = None,
        model: Changes = None,
        weights: Changes = None,
        **more: Any,
    ) -> Path:
        here = read_dataset_info(
            "curl-noise", "tiny", root=generated.root, registry=unmeasured
        )
        options = {"start": 0.5, **(model or {})}
        built = AnySize.build(options, here)
        training = {
            "step": 9,
            "recipe": {"name": "curl-noise/mini-made-up"},
            **more,
        }
        checkpoint = Checkpoint(
            baseline=baseline,
            options=built.options.model_dump(),
            info=replace(here, **(info or {})),
            weights=weights or built.state_dict(),
            training=training,
        )
        path = tmp_path / "start.safetensors"
        save(path, checkpoint)
        return path

    return call


@pytest.mark.parametrize("size", ["tiny", "mini"])
def test_a_training_starts_with_the_prediction_of_the_weights(
    run: Run,
    stored: Callable[..., Path],
    generated: GenerationResult,
    unmeasured: Registry,
    size: str,
) -> None:
    """A step that changes nothing predicts what the weights do, also in units of
    another size.
    """
    kinds = ("velocity_std", "acceleration_std", "position_std")
    units = dict.fromkeys(kinds, (1e-3, 1e-3))
    other = {
        "size": "mini",
        "dataset_sha256": "0" * 64,
        "statistics": units,
        "radius": 0.5,
    }
    info = None
    if size == "mini":
        info = other
    start = stored(info=info, model={"share": 0.5})
    result = run("any", *STILL, start=start)  # the recipe's share is another
    options: dict[str, Any] = {
        "root": generated.root,
        "registry": unmeasured,
        "threads": 1,
        "size": "tiny",
        "overwrite": True,
    }
    positions = []
    for weights in (start, result.weights):
        prediction = predict(weights, result.folder / "made.nc", **options)
        with netCDF4.Dataset(prediction.path) as data:
            positions.append(np.asarray(data["position"][:]))
    of_start, of_result = positions
    assert np.array_equal(of_start, of_result)


def test_the_start_weights_stay_best_where_every_step_is_worse(
    run: Run,
    stored: Callable[..., Path],
) -> None:
    """Where every step leads away, the best weights are those that it started from.

    What fails early can be tried again: a checkpoint lies beside the weights that were
    validated first.
    """
    start = stored()
    result = run(
        "any",
        "steps=4",
        "learning_rate=100.0",
        "validate_every=2",
        start=start,
    )
    assert result.best_step == 0
    best = load(result.weights).weights["a"]
    assert float(best) == 0.5
    record = read_training_log(result.folder)
    validated_steps = [entry["step"] for entry in record["validation"]]
    assert validated_steps == [0, 2, 4]
    for _ in range(2):
        with pytest.raises(WorkFailedError):
            run(
                "any",
                "steps=100",
                "learning_rate=1e38",
                "validate_every=50",
                start=start,
                to="bad",
            )


def test_the_record_counts_the_hours_before_the_start(
    run: Run,
    stored: Callable[..., Path],
    tmp_path: Path,
) -> None:
    """Hours include those of the start, other figures do not. The record and the
    sentence name the weights.
    """
    spent = {
        "cpu_hours": 2.0,
        "gpu_hours": 0.5,
        "validation_hours": 0.25,
        "steps": 9,
        "windows": 18,
    }
    start = stored(budget=spent)
    result = run("any", *STILL, start=start)
    record = read_training_log(tmp_path / "run")
    budget = record["budget"]
    assert 2.0 < budget["cpu_hours"] < 2.1
    assert budget["gpu_hours"] == 0.5
    assert 0.25 < budget["validation_hours"] < 0.35
    assert budget["steps"] == 1
    assert budget["start_steps"] == 9
    assert budget["windows"] == 2
    sha256 = file_sha256(start)
    assert record["recipe"]["start"]["sha256"] == sha256
    assert sha256[:12] in result.start
    provenance = load(result.weights).provenance()
    words = provenance.describe()
    assert words.endswith(f"curl-noise/mini-made-up, weights {sha256[:12]}")
    again = run("any", *STILL, start=result.weights, to="again")
    next_budget = load(again.weights).training["budget"]
    assert 2.0 < next_budget["cpu_hours"] < 2.1
    assert next_budget["start_steps"] == 10


def test_an_interrupted_training_goes_on_with_the_same_bits(
    run: Run,
    stored: Callable[..., Path],
) -> None:
    """It goes on with its own weights, and only from the same start; the bits are those
    of one run.
    """

    def stop(news: Progress) -> None:
        if news.stage != "predicting" and news.done == 2:
            raise KeyboardInterrupt

    start = stored()
    whole = run("any", "steps=4", start=start, to="whole")
    with pytest.raises(KeyboardInterrupt):
        run("any", "steps=4", start=start, progress=stop)
    for other in (None, stored(model={"start": 0.25})):
        with pytest.raises(UsageError):
            run("any", "steps=4", start=other)
    parts = run("any", "steps=4", start=stored())
    assert 0 < parts.first_step < 4
    whole_weights = load(whole.checkpoint).weights
    weights = load(parts.checkpoint).weights
    for name, value in whole_weights.items():
        assert torch.equal(weights[name], value)


def weights_of(value: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return weights of a Drift with another parameter."""
    return {"a": value, "calls": torch.zeros(())}


NAN = torch.full((1,), math.nan)


@pytest.mark.parametrize(
    ("baseline", "start", "kind"),
    [
        ("drift", {}, UsageError),  # of another baseline
        ("any", {"info": {"split": "fluid"}}, UsageError),
        ("any", {"info": {"size": "mini", "frame_interval": 9.0}}, UsageError),
        # for one size only
        ("drift", {"baseline": "drift", "info": {"size": "mini"}}, UsageError),
        ("any", {"weights": weights_of(torch.zeros(2))}, UnreadableFileError),
        ("any", {"weights": weights_of(NAN)}, UnreadableFileError),
        ("var", {"baseline": "var"}, UsageError),  # fitted, not trained
    ],
)
def test_weights_that_do_not_fit_are_refused(
    run: Run,
    stored: Callable[..., Path],
    baseline: str,
    start: dict[str, Any],
    kind: type[LagbenchError],
) -> None:
    """They are refused before a step is made."""
    with pytest.raises(kind):
        run(baseline, *STILL, start=stored(**start))
