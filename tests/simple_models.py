"""Baselines so simple that their training and rollouts are known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from lagbench.baselines import catalogue
from lagbench.baselines.baseline import Baseline, Batch, Facts
from lagbench.baselines.baseline import Options as Base

State = tuple[Tensor, Tensor, int]

FACTS = Facts(
    split="curl-noise",
    size="tiny",
    version="1.0.0",
    dataset_sha256="0" * 64,
    particles=3,
    bounds=((0.0, 1.0), (0.0, 1.0)),
    radius=0.1,
    input_frames=6,
    horizon=20,
    score_cells=10,
    score_placement="cell_centres",
    frame_interval=0.1,
    moving_walls=True,
    statistics=dict.fromkeys(("position_mean", "position_std", "velocity_std"), (0.5, 0.5)),
)


class Drift(Baseline):
    """``x(f+1) = x(f) + a (x(f) - x(f-1))``; the best ``a`` is a quotient of two sums.

    Options:
        fail_at: call of `forward` whose loss is NaN; 0 is none.
        explode_at: frame of a rollout that is infinite; 0 is none.
    """

    method = "Drift"

    class Options(Base):
        """See above."""

        start: float = 0.0
        fail_at: int = 0
        explode_at: int = 0

    def __init__(self, options: Any, facts: Facts) -> None:
        super().__init__(options, facts)
        self.a = nn.Parameter(torch.full((1,), options.start))
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    @property
    def history(self) -> int:
        """Two frames: one velocity."""
        return 2

    def forward(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Return the same mean squared error twice."""
        before, now, after = batch.position.unbind(1)
        self.calls += 1
        error = (1e3 * (after - now - self.a * (now - before))).square().mean()
        broken = error * float("nan") if int(self.calls) == self.options.fail_at else error
        return {"motion": error, "swirl": broken}

    def start(self, given: Batch) -> State:
        """Return the last two frames and the number of the next."""
        return given.position[:, -2], given.position[:, -1], 1

    def advance(self, state: State) -> tuple[State, Tensor]:
        """Keep on drifting."""
        before, now, frame = state
        after = now + self.a * (now - before)
        if frame == self.options.explode_at:
            after = after / 0.0
        return (now, after, frame + 1), after


class Bursting(Drift):
    """A Drift of which a window bursts after three frames if its first particle is left of the middle."""

    method = "Bursting"

    def advance(self, state: State) -> tuple[State, Tensor]:
        """Advance by one frame; a batch with such a window is infinite altogether."""
        (now, after, frame), position = super().advance(state)
        first = now[:: self.facts.particles, 0]
        if frame > 4 and bool((first < 0.5).any()):
            position = torch.full_like(after, float("inf"))
        return (now, position, frame), position


def install(monkeypatch: pytest.MonkeyPatch, **models: type) -> None:
    """Let packages seem installed that add baselines, by name."""
    own = tuple(catalogue.entry_points(group=catalogue.GROUP))
    added = tuple(
        EntryPoint(name.replace("_", "-"), f"{model.__module__}:{model.__name__}", catalogue.GROUP)
        for name, model in models.items()
    )
    find: Callable[..., Any] = lambda group: own + added  # noqa: E731
    monkeypatch.setattr(catalogue, "entry_points", find)
