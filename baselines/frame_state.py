"""The state of a whole frame: positions and velocities of all particles, standardised.

    z = (q - mean) / std,   q = (x, y, u, v),   u(f) = x(f) - x(f-1)          (Eq. 4.15)

with the public statistics of the training scenarios, one figure per feature. The first frame of
a window has no frame before it: it takes the velocity of the second.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lagbench.errors import DataError

from .batch import Batch
from .facts import Facts

__all__ = ["FEATURES", "FrameState", "side_by_side"]

FEATURES = 4
"""x, y and the two components of the velocity per frame."""


class FrameState(nn.Module):
    """Turns positions into standardised states, and back.

    Args:
        facts: public figures of the data set; its statistics are kept as buffers.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, facts: Facts) -> None:
        super().__init__()
        known = facts.statistics
        mean = (*known["position_mean"], *known["velocity_mean"])
        std = (*known["position_std"], *known["velocity_std"])
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float64), persistent=False)
        self.register_buffer("std", torch.tensor(std, dtype=torch.float64), persistent=False)

    def of(self, position: Tensor) -> Tensor:
        """Return the states of consecutive frames [1], shape [..., frame, particle, 4].

        Args:
            position: positions of two frames or more [length], shape [..., frame, particle, 2].

        Raises:
            DataError: fewer than two frames, so that there is no velocity.
        """
        if position.shape[-3] < 2:
            raise DataError("a velocity needs two frames", expected="2 or more", got=position.shape[-3])
        later = position[..., 1:, :, :] - position[..., :-1, :, :]
        velocity = torch.cat([later[..., :1, :, :], later], dim=-3)
        state = torch.cat([position, velocity], dim=-1)
        return (state - self.mean.to(state.dtype)) / self.std.to(state.dtype)

    def position(self, state: Tensor) -> Tensor:
        """Return the positions of states [length], shape [..., 2] from [..., 4]."""
        return state[..., :2] * self.std[:2].to(state.dtype) + self.mean[:2].to(state.dtype)


def side_by_side(batch: Batch, particles: int) -> tuple[Tensor, Tensor]:
    """Return positions and materials window by window.

    Args:
        batch: windows with the same particles each.
        particles: particles in one scenario.

    Returns:
        Positions [length], shape [window, frame, particle, 2], and materials, shape
        [window, particle].

    Raises:
        DataError: a window with another number of particles: these models know no other.
    """
    count = torch.bincount(batch.sample, minlength=batch.windows)
    if not bool((count == particles).all()):
        got = ", ".join(map(str, sorted(set(count.tolist()))))
        raise DataError(
            "a model of whole frames needs every particle",
            where="batch",
            expected=f"{particles} particles in each window",
            got=got,
            fix="use a graph network for scenarios of other sizes",
        )
    position = batch.position.view(batch.windows, particles, batch.frames, -1)
    return position.transpose(1, 2), batch.material.view(batch.windows, particles)
