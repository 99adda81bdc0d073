"""Convolutions on the nodes of a grid: a U-Net, and an encoder to a few numbers.

The U-Net (Ronneberger et al. 2015) maps fields to fields. The context network maps the
fields of the given frames to a few numbers that describe the whole scenario.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

# nodes of the finest level to one node of the coarsest level, along each axis
NODES_PER_COARSE_NODE = 4


class Block(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.norm = nn.GroupNorm(4, outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.shortcut: nn.Module = nn.Identity()
        if inputs != outputs:
            self.shortcut = nn.Conv2d(inputs, outputs, 1)

    def forward(self, field: Tensor) -> Tensor:
        """Return the field after the block, shape [window, outputs, x node, y node]."""
        hidden = self.first(gelu(field))
        residual: Tensor = self.second(gelu(self.norm(hidden)))
        shortcut: Tensor = self.shortcut(field)
        return residual + shortcut


class UNet(nn.Module):
    """Three levels of resolution; the weights of the last layer start at zero."""

    def __init__(self, inputs: int, outputs: int, width: int) -> None:
        super().__init__()
        fine = width
        middle = 2 * width
        coarse = 4 * width

        self.begin = nn.Conv2d(inputs, fine, 3, padding=1)
        self.down_fine = Block(fine, fine)
        self.down_middle = Block(middle, middle)
        self.halve_fine = nn.Conv2d(fine, middle, 2, stride=2)
        self.halve_middle = nn.Conv2d(middle, coarse, 2, stride=2)
        self.bottom = nn.Sequential(Block(coarse, coarse), Block(coarse, coarse))
        self.double_coarse = nn.ConvTranspose2d(coarse, middle, 2, stride=2)
        self.double_middle = nn.ConvTranspose2d(middle, fine, 2, stride=2)
        self.up_middle = Block(2 * middle, middle)
        self.up_fine = Block(2 * fine, fine)
        self.end = nn.Conv2d(fine, outputs, 3, padding=1)
        for parameter in self.end.parameters():
            nn.init.zeros_(parameter)

    def forward(self, field: Tensor) -> Tensor:
        """Return the output in float32, shape [window, outputs, x node, y node].

        The number of nodes along each axis is a multiple of 4.
        """
        fine = self.down_fine(self.begin(field))
        middle = self.down_middle(self.halve_fine(fine))
        coarse = self.bottom(self.halve_middle(middle))

        doubled = self.double_coarse(coarse)
        middle = self.up_middle(torch.cat([doubled, middle], dim=1))
        doubled = self.double_middle(middle)
        fine = self.up_fine(torch.cat([doubled, fine], dim=1))

        # Every frame adds the output to velocities: the three digits of bfloat16 are
        # too few for that.
        with torch.autocast(field.device.type, enabled=False):
            output: Tensor = self.end(gelu(fine.to(field.dtype)))
        return output


class ContextNetwork(nn.Module):
    """Encode the fields of the given frames to a few numbers about the scenario."""

    def __init__(self, inputs: int, outputs: int, width: int) -> None:
        super().__init__()
        self.fields = nn.Sequential(
            nn.Conv2d(inputs, width, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(width, width, 3, stride=2, padding=1),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GELU(),
        )
        self.numbers = nn.Sequential(
            nn.Linear(width, width), nn.GELU(), nn.Linear(width, outputs)
        )

    def forward(self, field: Tensor) -> Tensor:
        """Return the numbers, shape [window, outputs]."""
        encoded = self.fields(field)
        box_mean = encoded.mean(dim=(2, 3))
        numbers: Tensor = self.numbers(box_mean)
        return numbers.to(field.dtype)
