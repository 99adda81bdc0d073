"""MLP from frame to frame (thesis section 4.6)."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from itertools import pairwise

from pydantic import PositiveInt
from torch import Tensor, nn

from .baseline import DatasetInfo
from .frame_model import FrameNetwork, FrameNetworkOptions, FrameWindow


class Activation(enum.StrEnum):
    """The activations of Table 4.2."""

    ELU = "elu"
    RELU = "relu"
    TANH = "tanh"
    SIGMOID = "sigmoid"


ACTIVATION_LAYERS: Mapping[Activation, type[nn.Module]] = {
    Activation.ELU: nn.ELU,
    Activation.RELU: nn.ReLU,
    Activation.TANH: nn.Tanh,
    Activation.SIGMOID: nn.Sigmoid,
}


def dense(widths: tuple[int, ...], activation: Activation) -> nn.Sequential:
    """Return linear layers from the first width to the last.

    Every layer but the last is followed by the activation.
    """
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers.append(nn.Linear(inputs, outputs))
        layers.append(ACTIVATION_LAYERS[activation]())
    return nn.Sequential(*layers[:-1])


class MLPOptions(FrameNetworkOptions):
    """Options of the MLP."""

    of_weights = FrameNetworkOptions.of_weights | {"activation"}

    # units of each hidden layer
    widths: tuple[PositiveInt, ...] = (2500, 1250, 1250, 2500)
    activation: Activation = Activation.ELU  # elu, relu, tanh or sigmoid


class MLP(FrameNetwork):
    """``z(f+1) = W_n a(... a(W_1 z(f) + b_1) ...) + b_n`` of all particles at once.

    The place of a particle in the file says which inputs and outputs are its own.
    """

    method = "mlp"
    inputs = 1

    Options = MLPOptions
    options: MLPOptions

    def __init__(self, options: MLPOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        inputs = self.input_features * info.particles
        widths = (inputs, *options.widths, self.features)
        self.network = dense(widths, options.activation)

    @property
    def weights(self) -> Mapping[str, float]:
        """Halves, so that the loss is Eq. 4.16."""
        return {"position": 0.5, "velocity": 0.5}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        last_frame = self.network_inputs(window)[:, -1]
        output = self.network(last_frame.flatten(1))
        return self.decode_state(output, window)
