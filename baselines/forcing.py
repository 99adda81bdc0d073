"""What a particle sees of the force that drives a flow, and of an obstacle in it.

    f dt^2 / s                    the force per unit mass at the particle
    d = (|x - c| - R) / reach     clipped to [-1, 1]: how far the obstacle's surface is
    (1 - max(d, 0)) n             n = (x - c) / |x - c|: which way it faces

s is the deviation of accelerations in train, which the weights state. c and R are
centre and radius of the obstacle. The force is that of the way to the next frame.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lagbench.errors import DataError
from lagbench.tensors import TensorBox

from .baseline import Batch, DatasetInfo
from .graph import safe_length


class ForcingFeatures(nn.Module):
    """The features of force and obstacle that a model asks for; none by default.

    It has no weights.

    Args:
        info: public figures of the data set.
        body_force: whether the force is seen.
        obstacle: whether the obstacle is seen.
        force_unit: force of feature 1, the deviation of accelerations [length/frame^2].
        reach: how far a particle sees the obstacle's surface [length].
    """

    def __init__(
        self,
        info: DatasetInfo,
        *,
        body_force: bool,
        obstacle: bool,
        force_unit: float,
        reach: float,
    ) -> None:
        super().__init__()
        self.info = info
        self.box = TensorBox(info.box)
        self.body_force = body_force
        self.obstacle = obstacle
        self.force_unit = force_unit
        self.reach = reach

    @property
    def count(self) -> int:
        """Features of a particle: one number an axis, and another for the obstacle."""
        axes = self.info.box.dimension
        force_features = axes * self.body_force
        obstacle_features = (axes + 1) * self.obstacle
        return force_features + obstacle_features

    @property
    def names(self) -> frozenset[str]:
        """What is seen, by the names in batches."""
        names = set()
        if self.body_force:
            names.add("body_force")
        if self.obstacle:
            names.add("obstacle")
        return frozenset(names)

    def coming_force(self, given: Batch) -> Tensor | None:
        """Return the force from the next frame on [length/frame^2].

        The shape is [window, frame, layer, axis]; beyond the known frames the last one
        stays. None where it is not seen.

        Raises:
            DataError: no force drives the flow.
        """
        if not self.body_force:
            return None
        force = require_force(given, self.info)
        next_frame = min(given.frames, force.shape[1] - 1)
        return force[:, next_frame:]

    def find_obstacle(self, given: Batch) -> Tensor | None:
        """Return centre and radius of each window's obstacle [length].

        The shape is [window, axis + 1]; None where the obstacle is not seen.

        Raises:
            DataError: there is no obstacle.
        """
        if not self.obstacle:
            return None
        if given.obstacle is None:
            raise DataError(
                "no obstacle stands in the flow; train without it: --set "
                "model.obstacle=false",
                where=f"{self.info.split} {self.info.size}",
            )
        return given.obstacle

    def forward(
        self,
        position: Tensor,
        sample: Tensor,
        body_force: Tensor | None,
        obstacle: Tensor | None,
    ) -> Tensor:
        """Return the features of each particle [1], shape [particle, count].

        Args:
            position: positions [length], shape [particle, axis].
            sample: window of each particle, shape [particle].
            body_force: force on layers along y towards the next frame
                [length/frame^2], shape [window, layer, axis]; None where the force is
                not seen.
            obstacle: centre and radius [length], shape [window, axis + 1]; None where
                the obstacle is not seen.
        """
        parts = [position[:, :0]]
        if body_force is not None:
            force = force_at(position, sample, body_force, self.box)
            parts.append(force / self.force_unit)
        if obstacle is not None:
            own_obstacle = obstacle[sample]
            features = obstacle_features(position, own_obstacle, self.reach, self.box)
            parts.append(features)
        return torch.cat(parts, dim=1)


def require_force(given: Batch, info: DatasetInfo) -> Tensor:
    """Return the force towards each frame [length/frame^2].

    The shape is [window, frame, layer, axis].

    Raises:
        DataError: no force drives the flow.
    """
    if given.body_force is None:
        raise DataError(
            "no force drives the flow; train without it: --set model.body_force=false",
            where=f"{info.split} {info.size}",
        )
    return given.body_force * info.frame_interval**2


def skip_frames(forcing: Tensor, count: int = 1) -> Tensor:
    """Return the forcing from some frames later on; the last known one stays.

    Args:
        forcing: what drives the flow in the coming frames, shape
            [window, frame, ...].
        count: frames to skip.
    """
    last_frame = forcing.shape[1] - 1
    return forcing[:, min(count, last_frame) :]


def force_at(
    position: Tensor, sample: Tensor, body_force: Tensor, box: TensorBox
) -> Tensor:
    """Return the force per unit mass that acts at each particle, [particle, axis].

    It is that of the particle's layer; layers along y have equal heights, the lowest is
    the first. A particle beyond a wall has the layer at the wall.

    Args:
        position: positions [length], shape [particle, axis].
        sample: window of each particle, shape [particle].
        body_force: force on the layers, shape [window, layer, axis], in any unit.
        box: box that holds the particles.
    """
    low, high = box.box.bounds[1]
    wrapped = box.wrap(position)
    height = wrapped[:, 1] - low
    layer_count = body_force.shape[1]
    layers_per_length = layer_count / (high - low)
    layer = (height * layers_per_length).long()
    layer = layer.clamp(0, layer_count - 1)
    return body_force[sample, layer]


def obstacle_features(
    position: Tensor, obstacle: Tensor, reach: float, box: TensorBox
) -> Tensor:
    """Return distance and direction of the obstacle's surface [1], [..., axis + 1].

    The distance is over the reach and clipped to [-1, 1], as that of a wall: beyond the
    reach it is 1, inside the obstacle negative. The direction is the outward normal
    times ``1 - distance``, 1 in the obstacle: beyond the reach it is 0, so that there
    the features do not change when one vector moves all particles.

    Args:
        position: positions [length], shape [..., axis].
        obstacle: centre and radius of each particle's obstacle [length], shape
            [..., axis + 1].
        reach: how far a particle sees the surface [length].
        box: box that holds the particles; along periodic axes the nearest image of the
            obstacle counts.
    """
    centre = obstacle[..., :-1]
    radius = obstacle[..., -1:]
    way = box.displacement(centre, position)
    length = safe_length(way)
    distance = (length - radius) / reach
    distance = distance.clamp(-1.0, 1.0)
    nearness = 1.0 - distance.clamp(min=0.0)

    # In the very centre no direction is outward.
    divisor = torch.where(length > 0.0, length, 1.0)
    normal = way / divisor
    return torch.cat([distance, nearness * normal], dim=-1)
