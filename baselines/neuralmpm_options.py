"""The options of NeuralMPM, and the checks that concern several of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from lagbench.data import PARTICLE_KINDS
from lagbench.errors import UsageError

from .augmentation import Symmetry
from .baseline import DatasetInfo, Options, check_moving_walls


class NeuralMPMOptions(Options):
    """Options of the grid surrogate."""

    in_training = frozenset({"calls", "pushforward", "recovery", "noise_std", "shift"})
    retired: ClassVar[Mapping[str, object]] = {
        "conserve": False,
        "shape": [],
        "density": [],
    }

    # cells of the network's grid across the box; even, so that walls lie between two
    # nodes on all sides; along a periodic axis the nearest multiple of 4
    cells: int = Field(default=18, ge=4, le=256, multiple_of=2)
    width: int = Field(default=32, ge=4, multiple_of=4)  # channels of the finest level
    velocities: int = Field(default=5, ge=1)  # last velocities that the U-Net sees
    bundle: int = Field(default=4, ge=1)  # frames that one call predicts
    # calls that training unrolls; gradients pass through all
    calls: int = Field(default=2, ge=1)
    # largest number of calls before those, without gradients: training then sees states
    # of rollouts
    pushforward: int = Field(default=0, ge=0)
    # each frame the gap to the true path is to close by 1/recovery of it: a third is
    # left after so many frames; None asks for true velocities alone
    recovery: float | None = Field(default=None, gt=1.0, allow_inf_nan=False)
    # share s of the grid's velocity per frame
    smoothing: float = Field(default=0.2, ge=0.0, le=1.0)
    # on the last velocity [length/frame]
    noise_std: float = Field(default=1e-4, ge=0.0, allow_inf_nan=False)
    # numbers of the context network, which encodes the given frames once: the U-Net
    # can learn a viscosity from them
    context: int = Field(default=0, ge=0)
    # materials that have density and velocity of their own
    materials: tuple[int, ...] = (0,)
    # whether the velocity of the walls in the coming frames is a channel
    wall_velocity: bool = False
    # whether the force on layers of the fluid in the coming frames is a channel
    body_force: bool = False
    # whether the given viscosity is a channel, the same at all nodes
    viscosity: bool = False
    # whether particles are damped towards the velocity of all materials together, as if
    # one grid carried them all
    mixture: bool = False
    # whether the U-Net sees the strain of solids since the scenario's first frame
    strain: bool = False
    # training windows are replaced by random ones of these mirror images
    symmetry: Symmetry = Symmetry.NONE
    # training windows are moved by random ways along periodic axes, if there are any:
    # the U-Net itself knows no other shifts than those by a node of its coarsest level
    shift: bool = False
    # whether calls of rollouts, not of training, are mirror-averaged, at as many times
    # the cost as there are mirror images
    average: bool = False


def check_options(options: NeuralMPMOptions, info: DatasetInfo) -> None:
    """Refuse options that do not fit each other or the data set.

    Raises:
        UsageError: no material is named, or one is unknown or named twice; `average` is
            set and there are no mirror images; `wall_velocity` is set and no wall
            moves; or `strain` is set and the box has a periodic axis or a third one.
    """
    check_moving_walls(options.wall_velocity, info)
    has_four_walls = info.box.dimension == 2 and not info.box.is_periodic
    if options.strain and not has_four_walls:
        raise UsageError(
            "model.strain needs a two-dimensional box without periodic axes"
        )
    materials = set(options.materials)
    is_repeated = len(materials) < len(options.materials)
    numbers = range(len(PARTICLE_KINDS))
    if not materials or is_repeated or not materials <= set(numbers):
        raise UsageError(
            f"model.materials={list(options.materials)}; name some of "
            f"{list(numbers)}, each once"
        )
    if options.average and options.symmetry is Symmetry.NONE:
        raise UsageError(
            "model.average is a mean over mirror images; set model.symmetry=mirror too"
        )
