"""Convolutions on the nodes of a grid: a U-Net, and an encoder to a few numbers.

Grids have two or three axes. Beyond the ends of a periodic axis lie the nodes of its
other end, beyond walls there are zeros.

The U-Net (Ronneberger et al. 2015) maps fields to fields. The context network maps the
fields of the given frames to a few numbers that describe the whole scenario.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, pad

# nodes of the finest level to one node of the coarsest level, along each axis
NODES_PER_COARSE_NODE = 4


# by the number of axes
CONVOLUTIONS: dict[int, type[nn.Conv2d] | type[nn.Conv3d]] = {
    2: nn.Conv2d,
    3: nn.Conv3d,
}
TRANSPOSED: dict[int, type[nn.ConvTranspose2d] | type[nn.ConvTranspose3d]] = {
    2: nn.ConvTranspose2d,
    3: nn.ConvTranspose3d,
}


class Frame(nn.Module):
    """One more node on each side: that of the other end, or 0 beyond a wall."""

    def __init__(self, periodic: Sequence[bool]) -> None:
        super().__init__()
        wrapped: list[int] = []
        walled: list[int] = []
        for is_periodic in reversed(periodic):  # the last axis comes first
            wrapped += [int(is_periodic)] * 2
            walled += [int(not is_periodic)] * 2
        self.wrapped = wrapped
        self.walled = walled

    def forward(self, field: Tensor) -> Tensor:
        """Return the field with its frame."""
        with_ends = pad(field, self.wrapped, mode="circular")
        return pad(with_ends, self.walled)


def three_node_convolution(
    inputs: int,
    outputs: int,
    periodic: Sequence[bool],
    *,
    stride: int = 1,
) -> nn.Module:
    """Return a convolution over three nodes along each axis of a grid.

    Beyond walls it sees zeros, beyond a periodic axis the nodes of the other end; with
    stride 1 the grid keeps its size.

    Args:
        inputs: channels of the input.
        outputs: channels of the output.
        periodic: whether each axis is periodic.
        stride: nodes from one output node to the next.
    """
    dimension = len(periodic)
    convolution = CONVOLUTIONS[dimension]
    if not any(periodic):
        return convolution(inputs, outputs, 3, stride=stride, padding=1)
    frame = Frame(periodic)
    layer = convolution(inputs, outputs, 3, stride=stride)
    return nn.Sequential(frame, layer)


class ResidualBlock(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, periodic: Sequence[bool]) -> None:
        super().__init__()
        self.first = three_node_convolution(inputs, outputs, periodic)
        self.norm = nn.GroupNorm(4, outputs)
        self.second = three_node_convolution(outputs, outputs, periodic)
        self.shortcut: nn.Module = nn.Identity()
        if inputs != outputs:
            convolution = CONVOLUTIONS[len(periodic)]
            self.shortcut = convolution(inputs, outputs, 1)

    def forward(self, field: Tensor) -> Tensor:
        """Return the field after the block, shape [window, outputs, x node, y node]."""
        hidden = self.first(gelu(field))
        hidden = self.norm(hidden)
        residual: Tensor = self.second(gelu(hidden))
        shortcut: Tensor = self.shortcut(field)
        return residual + shortcut


class UNet(nn.Module):
    """Three levels of resolution; the weights of the last layer start at zero.

    Args:
        inputs: channels of the input.
        outputs: channels of the output.
        width: channels of the finest level.
        periodic: whether each axis of the grid repeats itself.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        width: int,
        periodic: Sequence[bool] = (False, False),
    ) -> None:
        super().__init__()
        dimension = len(periodic)
        convolution = CONVOLUTIONS[dimension]
        transposed = TRANSPOSED[dimension]
        fine = width
        middle = 2 * width
        coarse = 4 * width

        self.begin = three_node_convolution(inputs, fine, periodic)
        self.down_fine = ResidualBlock(fine, fine, periodic)
        self.down_middle = ResidualBlock(middle, middle, periodic)
        self.halve_fine = convolution(fine, middle, 2, stride=2)
        self.halve_middle = convolution(middle, coarse, 2, stride=2)
        first_block = ResidualBlock(coarse, coarse, periodic)
        second_block = ResidualBlock(coarse, coarse, periodic)
        self.bottom = nn.Sequential(first_block, second_block)
        self.double_coarse = transposed(coarse, middle, 2, stride=2)
        self.double_middle = transposed(middle, fine, 2, stride=2)
        self.up_middle = ResidualBlock(2 * middle, middle, periodic)
        self.up_fine = ResidualBlock(2 * fine, fine, periodic)
        self.end = three_node_convolution(fine, outputs, periodic)
        for parameter in self.end.parameters():
            nn.init.zeros_(parameter)

    def forward(self, field: Tensor) -> Tensor:
        """Return the output in float32, shape [window, outputs, x node, y node].

        In three dimensions there is an axis of z nodes too. The number of nodes along
        each axis is a multiple of 4.
        """
        fine = self.begin(field)
        fine = self.down_fine(fine)
        middle = self.halve_fine(fine)
        middle = self.down_middle(middle)
        coarse = self.halve_middle(middle)
        coarse = self.bottom(coarse)

        doubled = self.double_coarse(coarse)
        both = torch.cat([doubled, middle], dim=1)
        middle = self.up_middle(both)
        doubled = self.double_middle(middle)
        both = torch.cat([doubled, fine], dim=1)
        fine = self.up_fine(both)

        output: Tensor = self.end(gelu(fine))
        return output


class ContextNetwork(nn.Module):
    """Encode the fields of the given frames to a few numbers about the scenario."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        width: int,
        periodic: Sequence[bool] = (False, False),
    ) -> None:
        super().__init__()
        self.fields = nn.Sequential(
            three_node_convolution(inputs, width, periodic),
            nn.GELU(),
            three_node_convolution(width, width, periodic, stride=2),
            nn.GELU(),
            three_node_convolution(width, width, periodic),
            nn.GELU(),
        )
        hidden = nn.Linear(width, width)
        last = nn.Linear(width, outputs)
        self.numbers = nn.Sequential(hidden, nn.GELU(), last)

    def forward(self, field: Tensor) -> Tensor:
        """Return the numbers, shape [window, outputs]."""
        encoded = self.fields(field)
        by_channel = encoded.flatten(2)
        box_mean = by_channel.mean(dim=2)
        numbers: Tensor = self.numbers(box_mean)
        return numbers
