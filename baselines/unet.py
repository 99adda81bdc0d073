"""Convolutions on the nodes of a grid: a U-Net, and what tells a few numbers about the
whole of it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

COARSEST = 4  # nodes of the finest level to one of the coarsest, along each axis


class Block(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.norm = nn.GroupNorm(4, outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.shortcut = (
            nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()
        )

    def forward(self, field: Tensor) -> Tensor:
        """Return the field after the block, shape [window, outputs, x node, y node]."""
        changed: Tensor = self.second(gelu(self.norm(self.first(gelu(field)))))
        past: Tensor = self.shortcut(field)
        return changed + past


class UNet(nn.Module):
    """Three levels of resolution (Ronneberger et al. 2015); the last layer starts at
    zero.
    """

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
        """Return the output in float32, shape [window, outputs, x node, y node]; sides
        are multiples of 4.
        """
        fine = self.down_fine(self.begin(field))
        middle = self.down_middle(self.halve_fine(fine))
        coarse = self.double_coarse(self.bottom(self.halve_middle(middle)))
        middle = self.double_middle(self.up_middle(torch.cat([coarse, middle], dim=1)))
        fine = self.up_fine(torch.cat([middle, fine], dim=1))
        # Three digits of bfloat16 are too few for what is added to velocities every
        # frame.
        with torch.autocast(field.device.type, enabled=False):
            output: Tensor = self.end(gelu(fine.to(field.dtype)))
        return output


class Context(nn.Module):
    """A few numbers that the given frames tell about a scenario as a whole."""

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
        numbers: Tensor = self.numbers(self.fields(field).mean(dim=(2, 3)))
        return numbers.to(field.dtype)
