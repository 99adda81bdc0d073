"""Trainings that start from weights: what they go on from, what they cost, what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import torch
from simple_models import Drift, trainer

from lagbench.baselines.baseline import facts_of
from lagbench.baselines.checkpoint import Checkpoint, load, save
from lagbench.baselines.predict import fits, predict, training_words
from lagbench.baselines.train import TrainingResult
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Registry
from lagbench.errors import DataError, LagbenchError, UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.work.progress import Progress

Run = Callable[..., TrainingResult]
STILL = ("steps=1", "learning_rate=1e-30")
"""One step that changes no weight by as much as its rounding."""


class AnySize(Drift):
    """A Drift in the units of its statistics, of any size; ``unit`` says what its weight means."""

    any_size = True

    class Options(Drift.Options):
        """See above."""

        of_weights = frozenset({"unit"})
        unit: float = 1.0

    def advance(self, state: Any) -> Any:
        """Drift by a share of what is usual."""
        state, position = super().advance(state)
        return state, position + self.facts.statistics["velocity_std"][0] * self.a


@pytest.fixture
def run(
    generated: GenerationResult, unmeasured: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Run:
    """Train on tiny curl-noise data."""
    return trainer(generated.root, unmeasured, tmp_path, monkeypatch, drift=Drift, any=AnySize)


@pytest.fixture
def stored(generated: GenerationResult, unmeasured: Registry, tmp_path: Path) -> Callable[..., Path]:
    """Store weights of a made-up training; ``facts`` change those of the data."""

    def call(
        baseline: str = "any",
        *,
        facts: dict[str, Any] | None = None,
        model: dict[str, Any] | None = None,
        weights: dict[str, torch.Tensor] | None = None,
        **training: Any,
    ) -> Path:
        here = facts_of("curl-noise", "tiny", root=generated.root, registry=unmeasured)
        built = AnySize.build({"start": 0.5, **(model or {})}, here)
        told = {"step": 9, "recipe": {"name": "curl-noise/mini-made-up"}, **training}
        checkpoint = Checkpoint(
            baseline=baseline,
            options=built.options.model_dump(),
            facts=replace(here, **(facts or {})),
            weights=built.state_dict() if weights is None else weights,
            training=told,
        )
        save(tmp_path / "start.pt", checkpoint)
        return tmp_path / "start.pt"

    return call


def positions(path: Path) -> np.ndarray:
    """Return what a predictions.nc predicts."""
    with netCDF4.Dataset(path) as data:
        return np.asarray(data["position"][:])


@pytest.mark.parametrize("size", ["tiny", "mini"])
def test_it_goes_on_where_the_weights_are(
    run: Run,
    stored: Callable[..., Path],
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    size: str,
) -> None:
    """A step that changes nothing predicts what the weights do, also in units of another size."""
    units = dict.fromkeys(("velocity_std", "acceleration_std", "position_std"), (1e-3, 1e-3))
    other = {"size": "mini", "dataset_sha256": "0" * 64, "statistics": units, "radius": 0.5}
    start = stored(facts=other if size == "mini" else None)
    result = run("any", *STILL, start=start)
    options: dict[str, Any] = {"root": generated.root, "registry": unmeasured, "threads": 1, "size": "tiny"}
    predict(result.weights, tmp_path / "went-on.nc", **options)
    predict(start, tmp_path / "weights.nc", **options)
    assert np.array_equal(positions(tmp_path / "went-on.nc"), positions(tmp_path / "weights.nc"))


def test_it_learns_from_there(run: Run, stored: Callable[..., Path]) -> None:
    """A training from its own end begins at the loss that it ended with; random weights do not."""
    first = run("gns", "steps=30", "validate_every=0", to="first")
    further = run("gns", "steps=1", "validate_every=0", start=first.checkpoint, to="further")
    anew = run("gns", "steps=1", "validate_every=0", to="anew")
    assert further.loss["total"] < 0.95 * anew.loss["total"]


def test_what_came_before_is_told(run: Run, stored: Callable[..., Path], tmp_path: Path) -> None:
    """Hours are with those of the start, other figures are not; words and record name the weights."""
    spent = {"cpu_hours": 2.0, "gpu_hours": 0.5, "validation_hours": 0.25, "steps": 9, "windows": 18}
    start = stored(budget=spent)
    result = run("any", *STILL, start=start)
    record = json.loads((tmp_path / "run/training.json").read_text())
    budget = record["budget"]
    assert 2.0 < budget["cpu_hours"] < 2.1
    assert budget["gpu_hours"] == 0.5
    assert 0.25 < budget["validation_hours"] < 0.35
    assert (budget["steps"], budget["windows"]) == (1, 2)
    assert record["recipe"]["start"]["sha256"] == file_sha256(start)
    held = load(result.weights)
    words = training_words(held)
    assert words.endswith(f"curl-noise/mini-made-up, weights {file_sha256(start)[:12]}")
    assert fits(words, held)
    again = run("any", *STILL, start=result.weights, to="again")
    assert 2.0 < load(again.weights).training["budget"]["cpu_hours"] < 2.1


def test_hours_that_nobody_knows(run: Run, stored: Callable[..., Path]) -> None:
    """Weights without a budget leave the sum unknown."""
    budget = load(run("any", *STILL, start=stored()).weights).training["budget"]
    assert budget["cpu_hours"] is None


def test_it_can_be_interrupted(run: Run, stored: Callable[..., Path]) -> None:
    """It goes on with its own weights, and only from the same start; the bits are those of one run."""

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
    one, two = (load(result.checkpoint).weights for result in (whole, parts))
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.parametrize(
    ("baseline", "start", "kind"),
    [
        ("drift", {}, UsageError),  # of another baseline
        ("any", {"facts": {"split": "fluid"}}, UsageError),
        ("any", {"facts": {"dataset_sha256": "0" * 64}}, DataError),
        ("any", {"facts": {"size": "mini", "version": "0.9.0"}}, DataError),
        ("any", {"facts": {"size": "mini", "frame_interval": 9.0}}, UsageError),
        ("drift", {"baseline": "drift", "facts": {"size": "mini"}}, UsageError),  # for one size only
        ("any", {"model": {"unit": 2.0}}, UsageError),
        ("any", {"weights": {"a": torch.zeros(2), "calls": torch.zeros(())}}, UsageError),
        (
            "any",
            {"weights": {"a": torch.full((1,), float("nan")), "calls": torch.zeros(())}},
            UnreadableFileError,
        ),
        ("var", {"baseline": "var"}, UsageError),  # fitted, not trained
        ("any", {"recipe": {"name": "x", "start": {"sha256": "../x", "recipe": "x"}}}, UnreadableFileError),
    ],
)
def test_weights_that_do_not_fit(
    run: Run, stored: Callable[..., Path], baseline: str, start: dict[str, Any], kind: type[LagbenchError]
) -> None:
    """They are refused before a step is made."""
    with pytest.raises(kind):
        run(baseline, *STILL, start=stored(**start))
