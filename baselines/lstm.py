"""LSTM in a learned latent space, and one with an MLP between its layers.

Source: thesis section 4.7.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from .baseline import Batch, DatasetInfo
from .frame_model import FrameNetwork, FrameNetworkOptions, FrameWindow
from .mlp import Activation, dense
from .particle_grid import ParticleGrid, score_grid

DropoutRate = Annotated[float, Field(ge=0, lt=1)]


class LSTMOptions(FrameNetworkOptions):
    """Options of both LSTMs."""

    in_training = FrameNetworkOptions.in_training | {"dropout", "density_weight"}

    # length of the latent vector of a frame and width of both LSTM layers
    latent: PositiveInt = 1250
    # widths of hidden layers after the second LSTM layer
    decoder: tuple[PositiveInt, ...] = (1250,)
    # after the first and after the second LSTM layer
    dropout: tuple[DropoutRate, DropoutRate] = (0.2, 0.1)
    # of the density term in the loss. The thesis states none; with 1 the gradient
    # within a cell drowns that of the positions, which then are not learned.
    density_weight: float = Field(default=0.03, ge=0, allow_inf_nan=False)


class LSTM(FrameNetwork):
    """Two frames in, the next one out (Table 4.6).

    Each frame is encoded particle by particle and averaged over the particles. Two LSTM
    layers read the latent vectors, each followed by dropout. A decoder turns the last
    output into the states of all particles. LSTM cells use tanh, as PyTorch's do; the
    table's ELU stands in encoder, interleaved MLP and decoder.
    """

    method = "lstm"
    inputs = 2
    interleaved: ClassVar[bool] = False

    Options = LSTMOptions
    options: LSTMOptions

    def __init__(self, options: LSTMOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.grid: ParticleGrid | None = score_grid(info)
        latent = options.latent
        decoder_widths = (latent, *options.decoder, self.features)

        encoder_layer = nn.Linear(self.input_features, latent)
        self.encoder = nn.Sequential(encoder_layer, nn.ELU())
        self.first = nn.LSTM(latent, latent, batch_first=True)
        self.between: nn.Module | None = None
        if self.interleaved:
            layer = nn.Linear(latent, latent)
            self.between = nn.Sequential(layer, nn.ELU())
        self.second = nn.LSTM(latent, latent, batch_first=True)
        self.dropout = nn.ModuleList()
        for rate in options.dropout:
            self.dropout.append(nn.Dropout(rate))
        self.decoder = dense(decoder_widths, Activation.ELU)

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of the density term; the others have 1."""
        return {"density": self.options.density_weight}

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the errors of position, velocity and density map [1].

        The density error is relative over the nodes of the scorer's grid: it is 1 for
        an empty map. In three dimensions and in periodic boxes there is no such error.
        """
        truth, predicted = self.predict_last_frame(batch, generator)
        errors = self.frame_state.squared_errors(truth, predicted)
        if self.grid is not None:
            densities = []
            windows, particles, _ = truth.shape
            numbers = torch.arange(windows, device=truth.device)
            sample = numbers.repeat_interleave(particles)
            for state in (truth, predicted):
                position = self.frame_state.position(state).flatten(0, 1)
                stencil = self.grid.stencil(self.grid.box.inside(position), sample)
                one = torch.ones_like(position[:, :1])
                densities.append(self.grid.spread(stencil, one, windows))
            true_density, predicted_density = densities
            squared_error = (predicted_density - true_density).square().sum()
            errors["density"] = squared_error / true_density.square().sum()
        return errors

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        inputs = self.network_inputs(window)
        encoded = self.encoder(inputs)
        latent = encoded.mean(dim=2)  # over the particles, [window, frame, latent]

        first_dropout, second_dropout = self.dropout
        latent, _ = self.first(latent)
        latent = first_dropout(latent)
        if self.between is not None:
            latent = self.between(latent)
        latent, _ = self.second(latent)

        last_frame = latent[:, -1]
        last_frame = second_dropout(last_frame)
        output = self.decoder(last_frame)
        return self.decode_state(output, window)


class LSTMWithMLP(LSTM):
    """The LSTM with an ELU layer of the same width between its two layers."""

    method = "lstm-mlp"
    interleaved = True
