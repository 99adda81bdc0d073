"""Changes of training windows: mirror images of the box, and random-walk noise.

The flow in a square box without gravity looks the same from its eight sides; with
gravity a mirror image in x remains. A model that is trained on random mirror images of
its windows sees more flows than there are scenarios. The data and the windows in the
files stay as they are.

With noise a model learns to undo the errors of its own rollouts (Sanchez-Gonzalez et
al. 2020). A random walk moves the velocities of the given frames, and its sum moves
their positions. The frames to predict move with the last given position. So the target
is the true next velocity, and the acceleration that leads to it undoes the noise.

Rollouts come farther off the true path than any noise. Where a training rolls its
windows out without gradients first (the pushforward trick of Brandstetter, Worrall and
Welling 2022, arXiv 2202.03376), the model learns from there to come back:
:func:`velocity_towards_path` is added to the true velocity.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lagbench.data import WALL
from lagbench.data.registry import Size
from lagbench.errors import UsageError
from lagbench.tensors import Batch, TensorBox

from .baseline import Baseline
from .graph import Bounds

# accelerations in the way back to the true path at most, in their deviations
_MOST_DEVIATIONS = 3.0


class Symmetry(enum.StrEnum):
    """Which mirror images of a window are as good as the window."""

    NONE = "none"
    MIRROR = "mirror"
    """x -> -x about the middle of the box, in 3-D z -> -z too: not with a stream."""
    SQUARE = "square"
    """All eight images of the square, or 48 of the cube: see :func:`check_symmetry`."""


def check_symmetry(symmetry: object, size: Size, forcing: Collection[str]) -> None:
    """Refuse mirror images that are no motion of the split.

    A split whose description names neither gravity nor a fringe, as that of an imported
    split, passes.

    Args:
        symmetry: the images that are asked for.
        size: the data set.
        forcing: what drives the flow, by the names in batches.

    Raises:
        UsageError: mirror images are asked for where a stream flows along x; or all
            images of the square where gravity or a force on layers acts, or where only
            some axes are periodic.
    """
    if size.has_fringe and symmetry in (Symmetry.MIRROR, Symmetry.SQUARE):
        raise UsageError(
            f"the stream in {size.split} flows along x; in a mirror image it would "
            f"flow backwards; set "
            "model.symmetry=none",
            where="model.symmetry",
        )
    if symmetry != Symmetry.SQUARE:
        return
    lengths = size.box.lengths
    if len(set(size.box.periodic)) > 1 or lengths.max() - lengths.min() > 1e-6:
        raise UsageError(
            f"the axes of {size.split} differ in length or in period: they cannot "
            "change places; set model.symmetry=mirror",
            where="model.symmetry",
        )
    gravity = size.parameters.get("gravity")
    if gravity and gravity.value:
        raise UsageError(
            f"gravity in {size.split} points down; in a rotated image of the square "
            f"the particles would fall sideways or up; "
            "set model.symmetry=mirror",
            where="model.symmetry",
        )
    if "body_force" in forcing:
        raise UsageError(
            f"a force acts on layers along y in {size.split}: y cannot change places "
            f"with another axis; set model.symmetry=mirror",
            where="model.symmetry",
        )


def mirror_matrices(symmetry: Symmetry, dimension: int = 2) -> Tensor:
    """Return the matrices of all mirror images, the identity first.

    Their shape is [image, axis, axis].
    """
    last_axis_first = itertools.product((1.0, -1.0), repeat=dimension)
    signs = torch.tensor(list(last_axis_first)).flip(1)
    upright = torch.diag_embed(signs)
    if symmetry is Symmetry.NONE:
        return upright[:1]
    if symmetry is Symmetry.MIRROR:
        return upright[signs[:, 1] > 0.0]
    orders = itertools.permutations(range(dimension))
    return torch.cat([upright[:, :, list(order)] for order in orders])


def mirror_field(field: Tensor, matrix: Tensor, channels: Sequence[Tensor]) -> Tensor:
    """Return the mirror image of a field in a box of that symmetry.

    Args:
        field: values of nodes, shape [window, channel, x node, y node], in three
            dimensions with z nodes.
        matrix: signed permutation of the axes, shape [axis, axis].
        channels: blocks of the diagonal matrix by which the image changes the values
            of a node.
    """
    channel_matrix: Tensor = torch.block_diag(*channels)  # type: ignore[no-untyped-call]
    channel_matrix = channel_matrix.to(field)
    image = torch.einsum("dc,wc...->wd...", channel_matrix, field)

    # New axis i is that old axis where row i of the matrix is not 0.
    old_axes = matrix.abs().argmax(dim=1)
    order = [0, 1]  # windows and channels stay
    for old_axis in old_axes.tolist():
        order.append(old_axis + 2)
    image = image.permute(order)

    signs = matrix.sum(dim=1)
    flipped_axes = []
    for axis, sign in enumerate(signs.tolist()):
        if sign < 0.0:
            flipped_axes.append(axis + 2)
    return image.flip(flipped_axes)


def draw_mirror_matrices(
    symmetry: Symmetry,
    windows: int,
    generator: torch.Generator,
    *,
    dimension: int = 2,
) -> Tensor:
    """Return the matrix of one random mirror image per window, [window, axis, axis]."""
    device = generator.device
    if dimension == 3:
        return _draw_solid_matrices(symmetry, windows, generator)
    shape = (3, windows)
    bits = torch.randint(2, shape, generator=generator, device=device)
    is_square = symmetry is Symmetry.SQUARE
    flip_x, flip_y, swap = bits * is_square
    if symmetry is Symmetry.MIRROR:
        flip_x = bits[0]
    flips = torch.stack([flip_x, flip_y], dim=1)
    signs = 1.0 - 2.0 * flips
    upright = torch.diag_embed(signs)
    swapped = upright.flip(2)
    is_swapped = swap.bool()[:, None, None]
    return torch.where(is_swapped, swapped, upright)


def _draw_solid_matrices(
    symmetry: Symmetry, windows: int, generator: torch.Generator
) -> Tensor:
    """Return a random signed permutation of three axes per window, [window, 3, 3].

    Where gravity acts along the second axis it stays as it is.
    """
    device = generator.device
    shape = (windows, 3)
    flips = torch.randint(2, shape, generator=generator, device=device)
    signs = 1.0 - 2.0 * flips
    axes = torch.arange(3, device=device)
    order = axes.expand(windows, 3)
    if symmetry is Symmetry.SQUARE:
        draws = torch.rand(shape, generator=generator, device=device)
        order = draws.argsort(dim=1)
    else:
        signs[:, 1] = 1.0
    if symmetry is Symmetry.NONE:
        signs = torch.ones_like(signs)
    identity = torch.eye(3, device=device)
    permutation = identity[order]
    return signs[:, :, None] * permutation


def mirror_batch(batch: Batch, matrix: Tensor, bounds: Bounds) -> Batch:
    """Return an image of each window: mirrored or turned about the middle of the box.

    Args:
        batch: windows.
        matrix: signed permutation of the axes for each window, shape [window, axis,
            axis].
        bounds: box (low, high) along each axis [length].
    """
    middles = [(low + high) / 2 for low, high in bounds]
    matrix = matrix.to(batch.position)
    centre = batch.position.new_tensor(middles)
    by_particle = matrix[batch.sample]

    from_centre = batch.position - centre
    position = _multiply(by_particle[:, None], from_centre) + centre
    origin = batch.origin
    if origin is not None:
        from_centre = origin - centre
        origin = _multiply(by_particle, from_centre) + centre
    walls = batch.wall_velocity
    if walls is not None:
        # A wall takes the place of the wall to which its mirrored normal points.
        permutation = wall_permutation(matrix)
        source_wall = permutation.argmax(dim=2)  # shape [window, wall of the image]
        walls = _multiply(matrix[:, None, None], walls)
        source_walls = source_wall[:, None, :, None].expand_as(walls)
        walls = walls.gather(2, source_walls)
    force = batch.body_force
    if force is not None:
        image = _multiply(matrix[:, None, None], force)
        is_upside_down = matrix[:, 1, 1] < 0.0
        force = torch.where(is_upside_down[:, None, None, None], image.flip(2), image)
    obstacle = batch.obstacle
    if obstacle is not None:
        radius = obstacle[:, -1:]
        from_centre = obstacle[:, :-1] - centre
        place = _multiply(matrix, from_centre) + centre
        obstacle = torch.cat([place, radius], dim=1)
    return replace(
        batch,
        position=position,
        wall_velocity=walls,
        origin=origin,
        body_force=force,
        obstacle=obstacle,
    )


def shift_batch(batch: Batch, box: TensorBox, generator: torch.Generator) -> Batch:
    """Return each window displaced at random along the periodic axes of the box.

    A body force differs from layer to layer up y: with one, no window moves along y.

    Args:
        batch: windows.
        box: box that holds the particles.
        generator: source of the displacements, uniform over a period.
    """
    dimension = batch.position.shape[2]
    shape = (batch.windows, dimension)
    draws = torch.rand(shape, generator=generator, device=generator.device)
    ways = draws.to(box.period) * box.period
    # The period of an axis with walls is infinite.
    is_periodic = box.period.isfinite()
    shift = torch.where(is_periodic, ways, 0.0)
    if batch.body_force is not None:
        shift[:, 1] = 0.0
    shift = shift.to(batch.position)
    by_particle = shift[batch.sample]

    moved = batch.position + by_particle[:, None]
    position = box.wrap(moved)
    origin = batch.origin
    if origin is not None:
        moved = origin + by_particle
        origin = box.wrap(moved)
    obstacle = batch.obstacle
    if obstacle is not None:
        radius = obstacle[:, -1:]
        moved = obstacle[:, :-1] + shift
        place = box.wrap(moved)
        obstacle = torch.cat([place, radius], dim=1)
    return replace(
        batch,
        position=position,
        origin=origin,
        obstacle=obstacle,
    )


def wall_permutation(matrix: Tensor) -> Tensor:
    """Return the permutation of the walls by an image, [..., new wall, old wall]."""
    dimension = matrix.shape[-1]
    normals = torch.zeros(2 * dimension, dimension)
    for axis in range(dimension):
        lower_wall = 2 * axis
        upper_wall = lower_wall + 1
        normals[lower_wall, axis] = -1.0
        normals[upper_wall, axis] = 1.0
    normals = normals.to(matrix)

    matrix_of_walls = matrix[..., None, :, :]
    image_normals = _multiply(matrix_of_walls, normals)  # [..., wall, axis]
    new_normals = normals[:, None]
    old_normals = image_normals[..., None, :, :]
    products = new_normals * old_normals
    cosines = products.sum(dim=-1)
    is_same_wall = cosines > 0.5
    return is_same_wall.to(matrix)


def strain_matrix(matrix: Tensor) -> Tensor:
    """Return the matrix by which an image changes a symmetric tensor, shape [3, 3].

    The components of the tensor are (xx, xy, yy).
    """
    (a, b), (c, d) = matrix
    xx = torch.stack([a * a, 2 * a * b, b * b])
    xy = torch.stack([a * c, a * d + b * c, b * d])
    yy = torch.stack([c * c, 2 * c * d, d * d])
    return torch.stack([xx, xy, yy])


def _multiply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return products of matrices and vectors."""
    products = matrix * vector.unsqueeze(-2)
    return products.sum(dim=-1)


def add_walk_noise(
    position: Tensor,
    history: int,
    std: float | Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return the positions of windows with noise on their history.

    The noise of velocities is a walk of ``history - 1`` steps of
    ``std / sqrt(history - 1)`` each. That of positions [length] is its sum, 0 in the
    first frame. The frames after the history move along. One frame has no velocity, so
    it has no noise.

    Args:
        position: positions [length], shape [particle, frame, axis].
        history: frames that a model sees.
        std: deviation of the noise on the last velocity [length/frame], a number or
            one for each particle, shape [particle, 1, 1].
        generator: source of the noise.
    """
    particles, frame_count, dimension = position.shape
    velocity_count = history - 1
    if velocity_count == 0:
        return position
    shape = (particles, velocity_count, dimension)
    normal = torch.randn(shape, generator=generator, device=generator.device)
    step_std = std / math.sqrt(velocity_count)
    step = normal * step_std

    velocity_noise = step.cumsum(dim=1)
    position_noise = velocity_noise.cumsum(dim=1)
    position_noise = position_noise.to(position)
    first = torch.zeros_like(position_noise[:, :1])
    last = position_noise[:, -1:]
    future_frames = frame_count - history
    future = last.expand(-1, future_frames, -1)
    noise = torch.cat([first, position_noise, future], dim=1)
    return position + noise


def velocity_towards_path(
    gap: Tensor, frames: float | None, *, acceleration_std: float
) -> Tensor:
    """Return the velocity that leads back to the true path, shape [particle, axis].

    It is ``gap / frames``. The gap is measured anew in each frame, so each frame closes
    1/frames of what is left of it. However far off a particle is, the velocity is no
    longer than three standard deviations of an acceleration, acting for one frame.

    Args:
        gap: true less reached positions [length], shape [particle, axis].
        frames: frames to come back in; None for no way back.
        acceleration_std: deviation of accelerations [length/frame^2].
    """
    if frames is None:
        return torch.zeros_like(gap)
    velocity = gap / frames
    limit = _MOST_DEVIATIONS * acceleration_std
    speed: Tensor = torch.linalg.vector_norm(velocity, dim=1, keepdim=True)
    divisor = speed.clamp(min=limit)
    return velocity * limit / divisor


def augment(
    model: Baseline,
    batch: Batch,
    generator: torch.Generator,
    *,
    noise_spread: bool = False,
) -> Batch:
    """Return the batch as a random mirror image, with noise, as the options say.

    With ``noise_spread`` each window has noise of a deviation of its own, from none to
    the option ``noise_std``.
    """
    symmetry = model.options.symmetry
    noise_std = model.options.noise_std
    if symmetry is not Symmetry.NONE:
        matrix = draw_mirror_matrices(
            symmetry,
            batch.windows,
            generator,
            dimension=batch.position.shape[2],
        )
        batch = mirror_batch(batch, matrix, model.info.bounds)
    if noise_std > 0.0:
        deviation: float | Tensor = noise_std
        if noise_spread:
            device = generator.device
            share = torch.rand(batch.windows, generator=generator, device=device)
            by_particle = share[batch.sample.to(device)]
            deviation = noise_std * by_particle[:, None, None]
        position = add_walk_noise(batch.position, model.history, deviation, generator)
        if model.info.wall_particles:
            is_wall = (batch.material == WALL)[:, None, None]
            position = torch.where(is_wall, batch.position, position)
        batch = replace(batch, position=position)
    return batch
