"""What MLP and LSTM share: material as an input, what the output means, noise in training."""

from __future__ import annotations

import enum

import torch
from pydantic import Field
from torch import Tensor

from . import baseline
from .facts import Facts
from .frame_model import FrameModel, FrameWindow
from .frame_state import FEATURES

__all__ = ["FrameNetwork", "FrameNetworkOptions", "Target", "material_feature"]

MATERIALS = 4
"""Materials that datasets.yaml knows: 0 liquid, 1 jelly, 2 snow, 3 rope."""


class Target(enum.StrEnum):
    """What the output of a network means."""

    STATE = "state"
    CHANGE = "change"


class FrameNetworkOptions(baseline.Options):
    """Options of a network of whole frames.

    The thesis's networks predict the next state itself, without noise; ``target: change`` and
    ``noise_std`` are ours. A state is made anew in every frame, so that even the first step is off by
    the error of the whole state; a change keeps what it does not know.

    Attributes:
        target: the next state, or its change in units of the change's deviation over train.
        material: give the material as a fifth, constant feature of every particle.
        noise_std: of the noise on the states that training gives to the network [standardised].
    """

    target: Target = Target.STATE
    material: bool = False
    noise_std: float = Field(default=0.0, ge=0, allow_inf_nan=False)


def material_feature(material: Tensor) -> Tensor:
    """Return the constant fifth feature: 0, 1, 2, 3 mapped to -1 ... 1, shape [..., 1]."""
    return (material.to(torch.float32) * (2.0 / (MATERIALS - 1)) - 1.0).unsqueeze(-1)


class FrameNetwork(FrameModel):
    """Base of the networks: their inputs are states, with the material where the recipe wants it."""

    options: FrameNetworkOptions
    typical_change: Tensor

    def __init__(self, options: FrameNetworkOptions, facts: Facts) -> None:
        super().__init__(options, facts)
        self.input_features = FEATURES + options.material
        self.register_buffer("typical_change", _typical_change(facts), persistent=False)

    def disturbed(self, state: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return the states with independent normal noise; unchanged without a generator."""
        if generator is None or self.options.noise_std == 0.0:
            return state
        noise = torch.randn(state.shape, generator=generator, device=state.device, dtype=state.dtype)
        return state + self.options.noise_std * noise

    def given(self, window: FrameWindow) -> Tensor:
        """Return the inputs of the network [1], shape [window, frame, particle, 4 or 5]."""
        if not self.options.material:
            return window.state
        constant = material_feature(window.material).unsqueeze(1)
        return torch.cat([window.state, constant.expand(-1, window.state.shape[1], -1, -1)], dim=-1)

    def meant(self, output: Tensor, window: FrameWindow) -> Tensor:
        """Return the state that an output of shape [window, feature] means, shape [window, particle, 4]."""
        last = window.state[:, -1]
        output = output.view(last.shape).to(last.dtype)
        return output if self.options.target is Target.STATE else last + self.typical_change * output


def _typical_change(facts: Facts) -> Tensor:
    """Return the standard deviation of a state's change per frame [standardised], shape [4]."""
    known = facts.statistics
    moved = zip(known["velocity_std"], known["position_std"], strict=True)
    pushed = zip(known["acceleration_std"], known["velocity_std"], strict=True)
    return torch.tensor([change / spread for change, spread in (*moved, *pushed)])
