"""MLP from frame to frame (thesis section 4.6)."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from itertools import pairwise

from pydantic import PositiveInt
from torch import Tensor, nn

from .baseline import Facts
from .frame_model import FrameNetwork, FrameNetworkOptions, FrameWindow


class Activation(enum.StrEnum):
    """The activations of Table 4.2."""

    ELU = "elu"
    RELU = "relu"
    TANH = "tanh"
    SIGMOID = "sigmoid"


LAYERS = dict(zip(Activation, (nn.ELU, nn.ReLU, nn.Tanh, nn.Sigmoid), strict=True))


def dense(widths: tuple[int, ...], activation: Activation) -> nn.Sequential:
    """Return linear layers, each but the last with the activation, from the first width
    to the last.
    """
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), LAYERS[activation]()]
    return nn.Sequential(*layers[:-1])


class MLP(FrameNetwork):
    """``z(f+1) = W_n a(... a(W_1 z(f) + b_1) ...) + b_n`` over all particles of a frame
    at once.

    Particles are told apart by their place in the file.
    """

    method = "mlp"
    inputs = 1

    class Options(FrameNetworkOptions):
        """Options of the MLP."""

        of_weights = FrameNetworkOptions.of_weights | {"activation"}

        widths: tuple[PositiveInt, ...] = (
            2500,
            1250,
            1250,
            2500,
        )  # units of each hidden layer
        activation: Activation = Activation.ELU  # elu, relu, tanh or sigmoid

    options: Options

    def __init__(self, options: Options, facts: Facts) -> None:
        super().__init__(options, facts)
        inputs = self.input_features * facts.particles
        self.network = dense(
            (inputs, *options.widths, self.features), options.activation
        )

    @property
    def weights(self) -> Mapping[str, float]:
        """Halves, so that the loss is Eq. 4.16."""
        return {"position": 0.5, "velocity": 0.5}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        return self.meant(self.network(self.given(window)[:, -1].flatten(1)), window)
