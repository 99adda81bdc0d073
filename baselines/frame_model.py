"""A model of whole frames: the next state from the last few, fed with its own predictions.

Training and rollouts call the same :meth:`FrameModel.next_state`; a model is a file with its
layers and that one method.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from .baseline import Baseline
from .batch import Batch
from .facts import Facts
from .frame_state import FEATURES, FrameState, side_by_side

__all__ = ["FrameModel", "FrameWindow", "squared_errors"]


@dataclass(frozen=True)
class FrameWindow:
    """The state of a rollout: what :meth:`FrameModel.next_state` is given.

    Attributes:
        state: the last standardised states [1], shape [window, frame, particle, 4].
        material: material of each particle, shape [window, particle].
    """

    state: Tensor
    material: Tensor


def squared_errors(truth: Tensor, predicted: Tensor) -> dict[str, Tensor]:
    """Return the mean squared errors of positions and of velocities, the two halves of Eq. 4.16 [1]."""
    error = (predicted - truth).square()
    return {"position": error[..., :2].mean(), "velocity": error[..., 2:].mean()}


class FrameModel(Baseline):
    """Base of MLP, LSTM and VAR.

    The loss terms are the two halves of Eq. 4.16, in standardised units: the mean squared error
    of positions and that of velocities. A rollout feeds the predicted velocities back too.

    Class attributes:
        precision: type of the states; predicted positions are float32 whatever it is.
    """

    precision: ClassVar[torch.dtype] = torch.float32

    def __init__(self, options: Any, facts: Facts) -> None:  # noqa: ANN401 (each has its own)
        super().__init__(options, facts)
        self.frame_state = FrameState(facts)

    @property
    @abstractmethod
    def inputs(self) -> int:
        """Frames whose states the model is given."""

    @abstractmethod
    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""

    @property
    def history(self) -> int:
        """One frame more than the states that are given: the first has a velocity, too."""
        return self.inputs + 1

    @property
    def features(self) -> int:
        """Numbers that describe a frame: 4 per particle."""
        return FEATURES * self.facts.particles

    def forward(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Return the mean squared errors of position and velocity after one step [1].

        Args:
            batch: windows of ``history + 1`` frames.
            generator: source of noise.
        """
        return squared_errors(*self._one_step(batch, generator))

    def _one_step(self, batch: Batch, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Return the true and the predicted state of the last frame."""
        window = self._states(batch)
        given = self.disturbed(window.state[:, -1 - self.inputs : -1], generator)
        return window.state[:, -1], self.next_state(FrameWindow(given, window.material))

    def _states(self, batch: Batch) -> FrameWindow:
        position, material = side_by_side(batch, self.facts.particles)
        return FrameWindow(self.frame_state.of(position.to(self.precision)), material)

    def disturbed(self, state: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return the inputs of training: a model with noise adds it here."""
        del generator
        return state

    def start(self, given: Batch) -> FrameWindow:
        """Return the last states of the given frames; where too few are given, the first repeats."""
        window = self._states(given)
        state = window.state[:, -self.inputs :]
        missing = self.inputs - state.shape[1]
        first = state[:, :1].expand(-1, missing, -1, -1)
        return FrameWindow(torch.cat([first, state], dim=1), window.material)

    def advance(self, state: FrameWindow) -> tuple[FrameWindow, Tensor]:
        """Advance by one frame: the next window and positions [length], shape [particle, 2]."""
        new = self.next_state(state)
        window = FrameWindow(torch.cat([state.state[:, 1:], new.unsqueeze(1)], dim=1), state.material)
        return window, self.frame_state.position(new).flatten(0, 1).to(torch.float32)
