"""A model of whole frames: the next state from the last few states.

A model is a file with its layers and :meth:`FrameModel.next_state`, which serves
training and rollouts. A state is positions and velocities of all particles,
standardised:

    z = (q - mean) / std,   q = (x, y, u, v),   u(f) = x(f) - x(f-1)          (Eq. 4.15)

with the public statistics of the training scenarios, one number per feature; a feature
that never varies has the deviation of :func:`.deviations.replace_zeros`. The first
frame of a window has no frame before it: it takes the velocity of the second. In three
dimensions q has six components. Along periodic axes positions are wrapped, velocities
and errors follow the shortest way.
"""

from __future__ import annotations

import enum
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from lagbench.errors import DataError
from lagbench.tensors import TensorBox

from . import baseline
from .baseline import Baseline, Batch, DatasetInfo
from .deviations import replace_zeros
from .graph import MATERIALS


class FrameState(nn.Module):
    """Turns positions into standardised states, and back."""

    mean: Tensor
    std: Tensor

    def __init__(self, info: DatasetInfo) -> None:
        super().__init__()
        self.box = TensorBox(info.box)
        self.dimension = info.box.dimension
        statistics = info.statistics
        mean = (*statistics["position_mean"], *statistics["velocity_mean"])
        position_std = replace_zeros(statistics["position_std"])
        velocity_std = replace_zeros(statistics["velocity_std"])
        std = (*position_std, *velocity_std)
        mean_tensor = torch.tensor(mean, dtype=torch.float64)
        std_tensor = torch.tensor(std, dtype=torch.float64)
        self.register_buffer("mean", mean_tensor, persistent=False)
        self.register_buffer("std", std_tensor, persistent=False)

    def _position_statistics(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return mean and deviation of positions [length], each of shape [axis]."""
        mean = self.mean[: self.dimension]
        std = self.std[: self.dimension]
        return mean.to(dtype), std.to(dtype)

    def standardise(self, position: Tensor) -> Tensor:
        """Return the states [1], shape [..., frame, particle, 2 axis].

        Raises:
            DataError: there are fewer than two consecutive frames.
        """
        frame_count = position.shape[-3]
        if frame_count < 2:
            raise DataError(
                f"a velocity needs two frames: {frame_count}, expected 2 or more"
            )
        before = position[..., :-1, :, :]
        after = position[..., 1:, :, :]
        velocity = self.box.displacement(before, after)
        first_velocity = velocity[..., :1, :, :]
        velocity = torch.cat([first_velocity, velocity], dim=-3)
        state = torch.cat([position, velocity], dim=-1)

        mean = self.mean.to(state.dtype)
        std = self.std.to(state.dtype)
        return (state - mean) / std

    def position(self, state: Tensor) -> Tensor:
        """Return the positions of states [length], [..., axis] from [..., 2 axis]."""
        mean, std = self._position_statistics(state.dtype)
        standardised = state[..., : self.dimension]
        return standardised * std + mean

    def wrap(self, state: Tensor) -> Tensor:
        """Return states whose positions lie in the box along periodic axes."""
        if not self.box.box.is_periodic:
            return state
        mean, std = self._position_statistics(state.dtype)
        position = self.position(state)
        wrapped = self.box.wrap(position)
        standardised = (wrapped - mean) / std
        velocity = state[..., self.dimension :]
        return torch.cat([standardised, velocity], dim=-1)

    def squared_errors(self, truth: Tensor, predicted: Tensor) -> dict[str, Tensor]:
        """Return squared errors of positions and velocities [1], halves of Eq. 4.16."""
        dimension = self.dimension
        difference = predicted - truth
        if self.box.box.is_periodic:
            _, std = self._position_statistics(truth.dtype)
            true_position = self.position(truth)
            predicted_position = self.position(predicted)
            way = self.box.displacement(true_position, predicted_position)
            position_difference = way / std
            velocity_difference = difference[..., dimension:]
            difference = torch.cat([position_difference, velocity_difference], dim=-1)
        error = difference.square()
        position_error = error[..., :dimension]
        velocity_error = error[..., dimension:]
        return {
            "position": position_error.mean(),
            "velocity": velocity_error.mean(),
        }


def require_particles(counts: Iterable[int], particles: int) -> None:
    """Refuse windows or scenarios with another number of particles than the model's.

    Raises:
        DataError: one has another number.
    """
    distinct_counts = sorted(set(counts))
    if distinct_counts != [particles]:
        raise DataError(
            "a model of whole frames needs one number of particles: got "
            f"{', '.join(map(str, distinct_counts))}, expected {particles} particles "
            "in each scenario; train neuralmpm, or a graph network such as gns",
            where="scenarios of this data set",
        )


def arrange_in_frames(batch: Batch, particles: int) -> tuple[Tensor, Tensor]:
    """Return positions and materials of a batch, window by window.

    Positions [length] have shape [window, frame, particle, axis], materials shape
    [window, particle].

    Raises:
        DataError: a window has another number of particles.
    """
    counts = torch.bincount(batch.sample, minlength=batch.windows)
    require_particles(counts.tolist(), particles)
    windows = batch.windows
    position = batch.position.view(windows, particles, batch.frames, -1)
    material = batch.material.view(windows, particles)
    return position.transpose(1, 2), material


@dataclass(frozen=True)
class FrameWindow:
    """The state of a rollout: the input of :meth:`FrameModel.next_state`."""

    # the last standardised states [1], shape [window, frame, particle, 2 axis]
    state: Tensor
    material: Tensor  # material of each particle, shape [window, particle]


class FrameModel(Baseline):
    """Base of MLP, LSTM and VAR. A rollout feeds the predicted velocities back too.

    Class attributes:
        precision: type of the states; predicted positions are float32 whatever it is.
    """

    precision: ClassVar[torch.dtype] = torch.float32

    def __init__(self, options: Any, info: DatasetInfo) -> None:  # noqa: ANN401 (each has its own)
        super().__init__(options, info)
        self.frame_state = FrameState(info)

    @property
    def forcing_seen(self) -> frozenset[str]:
        """Neither a force nor an obstacle."""
        return frozenset()

    @property
    @abstractmethod
    def inputs(self) -> int:
        """Frames whose states the model is given."""

    @abstractmethod
    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 2 axis]."""

    @property
    def history(self) -> int:
        """One frame more than the input states: the first has a velocity, too."""
        return self.inputs + 1

    @property
    def features(self) -> int:
        """Numbers that describe a frame: in two dimensions 4 per particle."""
        return 2 * self.info.box.dimension * self.info.particles

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the squared errors of position and velocity after one step [1]."""
        truth, predicted = self.predict_last_frame(batch, generator)
        return self.frame_state.squared_errors(truth, predicted)

    def predict_last_frame(
        self, batch: Batch, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Return the true and the predicted state of the last frame."""
        window = self._standardise(batch)
        truth = window.state[:, -1]
        first_input = -1 - self.inputs
        inputs = window.state[:, first_input:-1]
        noisy_inputs = self.add_noise(inputs, generator)
        predicted = self.next_state(FrameWindow(noisy_inputs, window.material))
        return truth, predicted

    def _standardise(self, batch: Batch) -> FrameWindow:
        position, material = arrange_in_frames(batch, self.info.particles)
        position = position.to(self.precision)
        state = self.frame_state.standardise(position)
        return FrameWindow(state, material)

    def add_noise(self, state: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return the inputs of training: a model with noise adds it here."""
        del generator
        return state

    def start(self, given: Batch) -> FrameWindow:
        """Return the last states of the given frames.

        Where too few frames are given, the first one repeats.
        """
        window = self._standardise(given)
        state = window.state[:, -self.inputs :]
        missing_frames = self.inputs - state.shape[1]
        first_state = state[:, :1]
        repeated = first_state.expand(-1, missing_frames, -1, -1)
        full_state = torch.cat([repeated, state], dim=1)
        return FrameWindow(full_state, window.material)

    def advance(self, state: FrameWindow) -> tuple[FrameWindow, Tensor]:
        """Return the next window and positions [length], shape [particle, axis]."""
        predicted = self.next_state(state)
        new_state = self.frame_state.wrap(predicted)
        latest_states = state.state[:, 1:]
        new_frame = new_state.unsqueeze(1)
        states = torch.cat([latest_states, new_frame], dim=1)
        window = replace(state, state=states)
        position = self.frame_state.position(new_state)
        position = position.flatten(0, 1)
        return window, position.to(torch.float32)


class FrameTarget(enum.StrEnum):
    """What the output of a network of whole frames means."""

    STATE = "state"
    CHANGE = "change"


class FrameNetworkOptions(baseline.Options):
    """Options of a network of whole frames.

    The thesis's networks predict the next state itself, without noise;
    ``target: change`` and ``noise_std`` are ours. A network that predicts states forms
    each one anew, so that even its first step is off by the error of a whole state. A
    network that predicts changes keeps the features that it cannot predict.
    """

    in_training = frozenset({"noise_std"})
    of_weights = frozenset({"target"})

    # the next state, or its change in units of the change's deviation over train
    target: FrameTarget = FrameTarget.STATE
    # give the material as a fifth, constant feature of every particle
    material: bool = False
    # of the noise on the states that training gives to the network [standardised]
    noise_std: float = Field(default=0.0, ge=0, allow_inf_nan=False)


class FrameNetwork(FrameModel):
    """Base of the networks: inputs are states, and materials if the recipe says so."""

    any_box = True
    options: FrameNetworkOptions
    typical_change: Tensor

    def __init__(self, options: FrameNetworkOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.input_features = 2 * info.box.dimension + options.material
        # the standard deviation of a state's change per frame [standardised]
        statistics = info.statistics
        change_of_state = {
            "position_std": "velocity_std",
            "velocity_std": "acceleration_std",
        }
        ratios = []
        for state_name, change_name in change_of_state.items():
            state_stds = replace_zeros(statistics[state_name])
            change_stds = statistics[change_name]
            for state_std, change_std in zip(state_stds, change_stds, strict=True):
                ratios.append(change_std / state_std)
        typical_change = torch.tensor(ratios)
        self.register_buffer("typical_change", typical_change, persistent=False)

    def add_noise(self, state: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return the states with independent normal noise; none without a generator."""
        if generator is None or self.options.noise_std == 0.0:
            return state
        normal = torch.randn(
            state.shape,
            generator=generator,
            device=state.device,
            dtype=state.dtype,
        )
        noise = self.options.noise_std * normal
        return state + noise

    def network_inputs(self, window: FrameWindow) -> Tensor:
        """Return the network's inputs [1], shape [window, frame, particle, feature].

        After the state comes the material, with 0 ... 3 mapped to -1 ... 1.
        """
        if not self.options.material:
            return window.state
        frame_count = window.state.shape[1]
        number = window.material.to(torch.float32)
        step = 2.0 / (MATERIALS - 1)
        material = (number * step - 1.0)[:, None, :, None]
        material = material.expand(-1, frame_count, -1, -1)
        return torch.cat([window.state, material], dim=-1)

    def decode_state(self, output: Tensor, window: FrameWindow) -> Tensor:
        """Return the next state [1], shape [window, particle, 2 axis], from an output.

        The output of the network has shape [window, feature].
        """
        last_state = window.state[:, -1]
        output = output.view(last_state.shape)
        output = output.to(last_state.dtype)
        if self.options.target is FrameTarget.STATE:
            return output
        change = self.typical_change * output
        return last_state + change
