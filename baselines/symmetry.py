"""Symmetries of the box: training windows mirrored and turned, walls and all.

The flow in a square box without gravity looks the same from its eight sides; with gravity a
mirror image in x remains. A model that is trained on random images of its windows sees more
flows than there are scenarios. The stored data and the windows stay as they are.
"""

from __future__ import annotations

import enum
from dataclasses import replace

import torch
from torch import Tensor

from lagbench.data.registry import Size
from lagbench.errors import UsageError

from .baseline import Batch
from .facts import Pair

__all__ = ["Symmetry", "check_symmetry", "draw", "image"]

_NORMALS = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
"""Outward normals of the walls left, right, bottom, top."""


class Symmetry(enum.StrEnum):
    """Which images of a window are as good as itself."""

    NONE = "none"
    MIRROR = "mirror"
    """x -> -x about the middle of the box: any split."""
    SQUARE = "square"
    """All eight images of the square: splits without gravity."""


def check_symmetry(symmetry: object, size: Size) -> None:
    """Refuse images that fall in another direction than their windows.

    A split whose description names no gravity, as an imported one may, passes.
    """
    described = size.parameters.get("gravity")
    gravity = described.value if described else None
    if symmetry == Symmetry.SQUARE and gravity:
        raise UsageError(
            f"gravity in {size.split} points down, and its images of the square fall sideways and up",
            where="model.symmetry",
            expected=f"{Symmetry.NONE} or {Symmetry.MIRROR} where gravity is {gravity}",
            got=str(symmetry),
            fix="set model.symmetry=mirror",
        )


def draw(symmetry: Symmetry, windows: int, generator: torch.Generator) -> Tensor:
    """Return one image per window, drawn evenly, as matrices of shape [window, 2, 2]."""
    device = generator.device
    bits = torch.randint(2, (3, windows), generator=generator, device=device)
    mirror_x, mirror_y, swap = bits * (symmetry is Symmetry.SQUARE)
    if symmetry is Symmetry.MIRROR:
        mirror_x = bits[0]
    matrix = torch.diag_embed(1.0 - 2.0 * torch.stack([mirror_x, mirror_y], dim=1))
    return torch.where(swap.bool()[:, None, None], matrix.flip(2), matrix)


def image(batch: Batch, matrix: Tensor, bounds: tuple[Pair, Pair]) -> Batch:
    """Return each window's image about the middle of the box.

    Args:
        batch: windows; left unchanged.
        matrix: signed permutation of the axes for each window, shape [window, 2, 2].
        bounds: box (low, high) along x and y [length].

    Raises:
        UsageError: x and y change places in a box that is no square.
    """
    sides = [high - low for low, high in bounds]
    if abs(sides[0] - sides[1]) > 1e-6 and bool((matrix[:, 0, 1] != 0.0).any()):
        raise UsageError(
            "x and y cannot change places in this box",
            where="symmetry",
            expected="a square box",
            got=f"sides {sides[0]:g} and {sides[1]:g}",
            fix="use symmetry: mirror",
        )
    matrix = matrix.to(batch.position)
    centre = batch.position.new_tensor([(low + high) / 2 for low, high in bounds])
    position = _turned(matrix[batch.sample][:, None], batch.position - centre) + centre
    return replace(batch, position=position, wall_velocity=_walls(batch.wall_velocity, matrix))


def _turned(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the products of matrices and vectors; autocast would round matmul's to 8 bits."""
    return (matrix * vector.unsqueeze(-2)).sum(dim=-1)


def _walls(velocity: Tensor | None, matrix: Tensor) -> Tensor | None:
    """Return the walls' velocities in the image: wall k becomes the one that its normal points at."""
    if velocity is None:
        return None
    normals = _NORMALS.to(matrix)
    images = _turned(matrix[:, None], normals)  # of window and wall
    origin = (images[:, None] * normals[:, None]).sum(dim=-1).argmax(dim=2)
    turned = _turned(matrix[:, None, None], velocity)
    return turned.gather(2, origin[:, None, :, None].expand_as(turned))
