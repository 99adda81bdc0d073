"""What training adds to its windows: images of the box's symmetries, and random-walk
noise.

The flow in a square box without gravity looks the same from its eight sides; with
gravity a mirror image in x remains. A model that is trained on random images of its
windows sees more flows than there are scenarios. The stored data and the windows stay
as they are.

With noise a model learns to undo its own rollout errors (Sanchez-Gonzalez et al. 2020):
the velocities of the given frames are moved by a random walk, the positions by its sum.
The frames to predict move with the last given position, so that the target is the true
next velocity, and the acceleration that leads to it undoes the noise.

What rollouts come to is farther off than any noise. Where a training rolls its windows
out without gradients first (the pushforward trick of Brandstetter, Worrall and Welling
2022, arXiv 2202.03376), the model learns from there to come back: :func:`way_back` is
added to the true velocity.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lagbench.data.registry import Size
from lagbench.errors import UsageError
from lagbench.tensors import Batch

from .baseline import Baseline
from .graph import Bounds

# outward, of the walls left, right, bottom, top
_NORMALS = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])


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
    if described:
        gravity = described.value
    else:
        gravity = None
    if symmetry == Symmetry.SQUARE and gravity:
        raise UsageError(
            f"gravity in {size.split} points down, and its images of the square fall "
            f"sideways and up",
            where="model.symmetry",
            expected=f"{Symmetry.NONE} or {Symmetry.MIRROR} where gravity is {gravity}",
            got=str(symmetry),
            fix="set model.symmetry=mirror",
        )


def images(symmetry: Symmetry) -> Tensor:
    """Return all images, the identity first, as matrices of shape [image, 2, 2]."""
    signs = [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)]
    upright = torch.diag_embed(torch.tensor(signs))
    if symmetry is Symmetry.SQUARE:
        return torch.cat([upright, upright.flip(2)])
    return upright[: 2 if symmetry is Symmetry.MIRROR else 1]


def field_image(field: Tensor, matrix: Tensor, channels: Sequence[Tensor]) -> Tensor:
    """Return the image of a field, shape [window, channel, x node, y node], in a box of
    that symmetry.

    ``matrix`` is a signed permutation of the axes, shape [2, 2]; ``channels`` is what
    the image does to the values of a node, blocks of a diagonal matrix.
    """
    turned: Tensor = torch.block_diag(*channels)  # type: ignore[no-untyped-call]
    with torch.autocast(field.device.type, enabled=False):
        moved = torch.einsum("dc,wcxy->wdxy", turned.to(field), field)
    if bool(matrix[0, 1] != 0.0):
        moved = moved.transpose(2, 3)
    return moved.flip(
        [2 + axis for axis in range(2) if float(matrix[axis].sum()) < 0.0]
    )


def draw(symmetry: Symmetry, windows: int, generator: torch.Generator) -> Tensor:
    """Return one image per window, drawn evenly, as matrices of shape [window, 2,
    2].
    """
    device = generator.device
    bits = torch.randint(2, (3, windows), generator=generator, device=device)
    mirror_x, mirror_y, swap = bits * (symmetry is Symmetry.SQUARE)
    if symmetry is Symmetry.MIRROR:
        mirror_x = bits[0]
    matrix = torch.diag_embed(1.0 - 2.0 * torch.stack([mirror_x, mirror_y], dim=1))
    return torch.where(swap.bool()[:, None, None], matrix.flip(2), matrix)


def image(batch: Batch, matrix: Tensor, bounds: Bounds) -> Batch:
    """Return each window's image about the middle of the box, by a signed permutation
    of its axes each.
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
    turn = matrix[batch.sample]
    position = _turned(turn[:, None], batch.position - centre) + centre
    if batch.origin is None:
        first = None
    else:
        first = _turned(turn, batch.origin - centre) + centre
    walls = batch.wall_velocity
    if (
        walls is not None
    ):  # wall k becomes the one that the image of its normal points at
        source = wall_permutation(matrix).argmax(dim=2)
        walls = _turned(matrix[:, None, None], walls)
        walls = walls.gather(2, source[:, None, :, None].expand_as(walls))
    return replace(batch, position=position, wall_velocity=walls, origin=first)


def wall_permutation(matrix: Tensor) -> Tensor:
    """Return which wall an image puts in the place of which, 1 or 0, shape [..., wall
    there, wall here].
    """
    normals = _NORMALS.to(matrix)
    # normals of the images, shape [..., wall, 2]
    there = _turned(matrix[..., None, :, :], normals)
    return ((normals[:, None] * there[..., None, :, :]).sum(dim=-1) > 0.5).to(matrix)


def strain_image(matrix: Tensor) -> Tensor:
    """Return what an image does to the components (xx, xy, yy) of a symmetric tensor,
    shape [3, 3].
    """
    (a, b), (c, d) = matrix
    rows = [
        [a * a, 2 * a * b, b * b],
        [a * c, a * d + b * c, b * d],
        [c * c, 2 * c * d, d * d],
    ]
    return torch.stack([torch.stack(row) for row in rows])


def _turned(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the products of matrices and vectors; autocast would round matmul's to 8
    bits.
    """
    return (matrix * vector.unsqueeze(-2)).sum(dim=-1)


def noisy(
    position: Tensor, history: int, std: float, generator: torch.Generator
) -> Tensor:
    """Return the positions of windows with noise on their history; the frames after it
    move along.

    The noise of velocities is a walk of ``history - 1`` steps of
    ``std / sqrt(history - 1)`` each; that of positions [length] is its sum, 0 in the
    first frame.
    """
    shape = (len(position), history - 1, 2)
    step = torch.randn(shape, generator=generator, device=generator.device) * (
        std / math.sqrt(history - 1)
    )
    walk = step.cumsum(dim=1).cumsum(dim=1).to(position)
    first = torch.zeros_like(walk[:, :1])
    after = walk[:, -1:].expand(-1, position.shape[1] - history, -1)
    return position + torch.cat([first, walk, after], dim=1)


def way_back(gap: Tensor, frames: float | None, *, change: float) -> Tensor:
    """Return the velocity that leads back to the true path [length/frame], shape
    [particle, 2].

    The gap, true less reached positions [length], is divided by ``frames``: formed anew
    each frame, it closes by 1/frames of what is left; None for no way back. ``change``
    is the deviation of accelerations: at most three of them, for what is lost is not
    run after.
    """
    if frames is None:
        return torch.zeros_like(gap)
    back = gap / frames
    most = 3.0 * change
    speed: Tensor = torch.linalg.vector_norm(back, dim=1, keepdim=True)
    return back * most / speed.clamp(min=most)


def disturbed(model: Baseline, batch: Batch, generator: torch.Generator) -> Batch:
    """Return the batch as a random image, with noise, as the model's options ask
    for.
    """
    symmetry = model.options.symmetry
    std = model.options.noise_std
    if symmetry is not Symmetry.NONE:
        batch = image(
            batch, draw(symmetry, batch.windows, generator), model.facts.bounds
        )
    if std > 0.0:
        batch = replace(
            batch, position=noisy(batch.position, model.history, std, generator)
        )
    return batch
