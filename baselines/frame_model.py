"""A model of whole frames: the next state from the last few, fed with its own
predictions.

A model is a file with its layers and :meth:`FrameModel.next_state`, for training and
rollouts. A state is positions and velocities of all particles, standardised.

    z = (q - mean) / std,   q = (x, y, u, v),   u(f) = x(f) - x(f-1)          (Eq. 4.15)

with the public statistics of the training scenarios, one figure per feature. The first
frame of a window has no frame before it: it takes the velocity of the second.
"""

from __future__ import annotations

import enum
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from lagbench.errors import DataError

from . import baseline
from .baseline import Baseline, Batch, Facts
from .graph import MATERIALS

FEATURES = 4  # x, y and the two components of the velocity per frame


class FrameState(nn.Module):
    """Turns positions into standardised states, and back."""

    mean: Tensor
    std: Tensor

    def __init__(self, facts: Facts) -> None:
        super().__init__()
        known = facts.statistics
        mean = (*known["position_mean"], *known["velocity_mean"])
        std = (*known["position_std"], *known["velocity_std"])
        self.register_buffer(
            "mean", torch.tensor(mean, dtype=torch.float64), persistent=False
        )
        self.register_buffer(
            "std", torch.tensor(std, dtype=torch.float64), persistent=False
        )

    def of(self, position: Tensor) -> Tensor:
        """Return the states [1], shape [..., frame, particle, 4], of two consecutive
        frames or more.
        """
        if position.shape[-3] < 2:
            raise DataError(
                "a velocity needs two frames",
                expected="2 or more",
                got=position.shape[-3],
            )
        later = position[..., 1:, :, :] - position[..., :-1, :, :]
        velocity = torch.cat([later[..., :1, :, :], later], dim=-3)
        state = torch.cat([position, velocity], dim=-1)
        return (state - self.mean.to(state.dtype)) / self.std.to(state.dtype)

    def position(self, state: Tensor) -> Tensor:
        """Return the positions of states [length], shape [..., 2] from [..., 4]."""
        return state[..., :2] * self.std[:2].to(state.dtype) + self.mean[:2].to(
            state.dtype
        )


def side_by_side(batch: Batch, particles: int) -> tuple[Tensor, Tensor]:
    """Return positions [length], shape [window, frame, particle, 2], and materials,
    [window, particle].
    """
    counts = set(torch.bincount(batch.sample, minlength=batch.windows).tolist())
    if counts != {particles}:
        raise DataError(
            "a model of whole frames needs every particle",
            where="batch",
            expected=f"{particles} particles in each window",
            got=", ".join(map(str, sorted(counts))),
            fix="use a graph network for scenarios of other sizes",
        )
    position = batch.position.view(batch.windows, particles, batch.frames, -1)
    return position.transpose(1, 2), batch.material.view(batch.windows, particles)


@dataclass(frozen=True)
class FrameWindow:
    """The state of a rollout: what :meth:`FrameModel.next_state` is given."""

    # the last standardised states [1], shape [window, frame, particle, 4]
    state: Tensor
    material: Tensor  # material of each particle, shape [window, particle]


def squared_errors(truth: Tensor, predicted: Tensor) -> dict[str, Tensor]:
    """Return the mean squared errors of positions and of velocities, the two halves of
    Eq. 4.16 [1].
    """
    error = (predicted - truth).square()
    return {"position": error[..., :2].mean(), "velocity": error[..., 2:].mean()}


class FrameModel(Baseline):
    """Base of MLP, LSTM and VAR. A rollout feeds the predicted velocities back too.

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
        """One frame more than the states that are given: the first has a velocity,
        too.
        """
        return self.inputs + 1

    @property
    def features(self) -> int:
        """Numbers that describe a frame: 4 per particle."""
        return FEATURES * self.facts.particles

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the mean squared errors of position and velocity after one step
        [1].
        """
        return squared_errors(*self.one_step(batch, generator))

    def one_step(
        self, batch: Batch, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
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
        """Return the last states of the given frames; where too few are given, the
        first repeats.
        """
        window = self._states(given)
        state = window.state[:, -self.inputs :]
        missing = self.inputs - state.shape[1]
        first = state[:, :1].expand(-1, missing, -1, -1)
        return FrameWindow(torch.cat([first, state], dim=1), window.material)

    def advance(self, state: FrameWindow) -> tuple[FrameWindow, Tensor]:
        """Advance by one frame: the next window and positions [length], shape
        [particle, 2].
        """
        new = self.next_state(state)
        window = FrameWindow(
            torch.cat([state.state[:, 1:], new.unsqueeze(1)], dim=1), state.material
        )
        return window, self.frame_state.position(new).flatten(0, 1).to(torch.float32)


class Target(enum.StrEnum):
    """What the output of a network means."""

    STATE = "state"
    CHANGE = "change"


class FrameNetworkOptions(baseline.Options):
    """Options of a network of whole frames.

    The thesis's networks predict the next state itself, without noise;
    ``target: change`` and ``noise_std`` are ours. A state is made anew in every frame,
    so that even the first step is off by the error of the whole state; a change keeps
    what it does not know.
    """

    in_training = frozenset({"noise_std"})
    of_weights = frozenset({"target"})

    # the next state, or its change in units of the change's deviation over train
    target: Target = Target.STATE
    # give the material as a fifth, constant feature of every particle
    material: bool = False
    # of the noise on the states that training gives to the network [standardised]
    noise_std: float = Field(default=0.0, ge=0, allow_inf_nan=False)


class FrameNetwork(FrameModel):
    """Base of the networks: their inputs are states, with the material where the recipe
    wants it.
    """

    options: FrameNetworkOptions
    typical_change: Tensor

    def __init__(self, options: FrameNetworkOptions, facts: Facts) -> None:
        super().__init__(options, facts)
        self.input_features = FEATURES + options.material
        # the standard deviation of a state's change per frame [standardised]
        known = facts.statistics
        moved = zip(known["velocity_std"], known["position_std"], strict=True)
        pushed = zip(known["acceleration_std"], known["velocity_std"], strict=True)
        typical = torch.tensor(
            [change / spread for change, spread in (*moved, *pushed)]
        )
        self.register_buffer("typical_change", typical, persistent=False)

    def disturbed(self, state: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return the states with independent normal noise; unchanged without a
        generator.
        """
        if generator is None or self.options.noise_std == 0.0:
            return state
        noise = torch.randn(
            state.shape, generator=generator, device=state.device, dtype=state.dtype
        )
        return state + self.options.noise_std * noise

    def given(self, window: FrameWindow) -> Tensor:
        """Return the inputs of the network [1], shape [window, frame, particle, 4 or
        5].
        """
        if not self.options.material:
            return window.state
        # 0 ... 3 to -1 ... 1
        constant = window.material.to(torch.float32) * (2.0 / (MATERIALS - 1)) - 1.0
        constant = constant[:, None, :, None].expand(-1, window.state.shape[1], -1, -1)
        return torch.cat([window.state, constant], dim=-1)

    def meant(self, output: Tensor, window: FrameWindow) -> Tensor:
        """Return the state that an output of shape [window, feature] means, shape
        [window, particle, 4].
        """
        last = window.state[:, -1]
        output = output.view(last.shape).to(last.dtype)
        if self.options.target is Target.STATE:
            return output
        return last + self.typical_change * output
