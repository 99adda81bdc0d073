"""LSTM in a learned latent space, with and without an MLP between its layers (thesis
section 4.7).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from lagbench.data.grid import Grid, Placement

from .baseline import Batch, Facts
from .frame_model import FrameNetwork, FrameNetworkOptions, FrameWindow, squared_errors
from .mlp import Activation, dense
from .torch_grid import transfer

Share = Annotated[float, Field(ge=0, lt=1)]


class LSTM(FrameNetwork):
    """Two frames in, the next one out (Table 4.6).

    Each frame is encoded particle by particle and averaged over the particles; two LSTM
    layers read the latent vectors, each followed by dropout; a decoder turns the last
    output into the states of all particles. LSTM cells use tanh, as PyTorch's do; the
    table's ELU stands in encoder, interleaved MLP and decoder.
    """

    method = "lstm"
    inputs = 2
    interleaved: ClassVar[bool] = False

    class Options(FrameNetworkOptions):
        """Options of both LSTMs."""

        in_training = FrameNetworkOptions.in_training | {"dropout", "density_weight"}

        # length of the latent vector of a frame and width of both LSTM layers
        latent: PositiveInt = 1250
        # widths of pointwise layers before the latent one
        encoder: tuple[PositiveInt, ...] = ()
        decoder: tuple[PositiveInt, ...] = (
            1250,
        )  # widths of hidden layers after the second LSTM layer
        # after the first and after the second LSTM layer
        dropout: tuple[Share, Share] = 0.2, 0.1
        # of the density term in the loss. The thesis states none; with 1 the gradient
        # within a cell drowns that of the positions, which then are not learned.
        density_weight: float = Field(default=0.03, ge=0, allow_inf_nan=False)

    options: Options

    def __init__(self, options: Options, facts: Facts) -> None:
        super().__init__(options, facts)
        latent = options.latent
        pointwise = dense(
            (self.input_features, *options.encoder, latent), Activation.ELU
        )
        self.encoder = nn.Sequential(*pointwise, nn.ELU())
        self.first = nn.LSTM(latent, latent, batch_first=True)
        self.between = (
            nn.Sequential(nn.Linear(latent, latent), nn.ELU())
            if self.interleaved
            else None
        )
        self.second = nn.LSTM(latent, latent, batch_first=True)
        self.dropout = nn.ModuleList(nn.Dropout(share) for share in options.dropout)
        self.decoder = dense((latent, *options.decoder, self.features), Activation.ELU)

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of the density term; the others have 1."""
        return {"density": self.options.density_weight}

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the errors of position and velocity, and that of the density map
        [1].
        """
        truth, predicted = self.one_step(batch, generator)
        grid = Grid(self.facts.score_cells, Placement(self.facts.score_placement))
        places = (self.frame_state.position(state) for state in (truth, predicted))
        density, guess = (transfer(x, torch.zeros_like(x), grid).weight for x in places)
        # over the nodes of the scorer's grid: 1 for an empty map
        error = (guess - density).square().sum() / density.square().sum()
        return {**squared_errors(truth, predicted), "density": error}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        latent = self.encoder(self.given(window)).mean(dim=2)
        latent = self.dropout[0](self.first(latent)[0])
        if self.between is not None:
            latent = self.between(latent)
        last = self.dropout[1](self.second(latent)[0][:, -1])
        return self.meant(self.decoder(last), window)


class LSTMWithMLP(LSTM):
    """The LSTM with an ELU layer of the same width between its two layers."""

    method = "lstm-mlp"
    interleaved = True
