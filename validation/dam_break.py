"""A column of liquid breaks: its front beside the experiment of Martin & Moyce (1952).

    python -m validation.dam_break --size full --json dam.json
    python -m validation.dam_break --split fluid-3d --size mini

A column of width a and height 2 a stands at rest in the corner of the box of ``fluid``
and is let go; in ``fluid-3d`` it fills the cube along z. Its front z runs along the
floor; Martin and Moyce measured Z = z / a against T = t sqrt(2 g / a) (Phil. Trans. R.
Soc. A 244, 312-324, columns with n^2 = 2). The solver has the constants of the split at
a size; the particles fill cells as densely as :data:`PER_SIDE` says.

The deviation counts from Z = 1.44 on: before, the experiment's gate was still opening.
Exit code 0: done; 2: bad options; 5: the solver failed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import round_digits
from lagbench.data.registry import load
from lagbench.errors import LagbenchError, UsageError, WorkFailedError
from lagbench.generators.constants import free_surface_walls, solver_constants
from lagbench.generators.draws import quantise
from lagbench.generators.solver import build
from lagbench.generators.split import FreeSurfaceParameters, InitialState, Material

from .output import check_writable

_EXPERIMENT = """
0.41 1.11  0.84 1.22  1.19 1.44  1.43 1.67  1.63 1.89
1.83 2.11  1.98 2.33  2.20 2.56  2.32 2.78  2.51 3.00
2.65 3.22  2.83 3.44  2.98 3.67  3.11 3.89  3.33 4.11
"""
EXPERIMENT_TIME = np.array(_EXPERIMENT.split()[::2], dtype=np.float64)
"""T of the experiment [1]."""

EXPERIMENT_FRONT = np.array(_EXPERIMENT.split()[1::2], dtype=np.float64)
"""Z of the experiment at these times [1]."""

WIDTH = {"fluid": 0.2, "fluid-3d": 0.17}
"""Width a of the column [length], by split: the front must not reach the other wall."""

PER_SIDE = 2
"""Particles along each side of a cell."""

FIRST_FRONT = 1.44
"""Least Z of the experiment that counts [1]."""

SPRAY = 0.002
"""Share of the particles that may run ahead of the front."""


@dataclass(frozen=True, kw_only=True)
class DamBreak:
    """The front of a breaking column beside that of the experiment."""

    split: str  # split whose constants were used
    size: str  # its size
    particles: int  # particles of the column
    time: tuple[float, ...]  # T of the experiment [1]
    front: tuple[float, ...]  # Z of the solver at these times [1]
    experiment: tuple[float, ...]  # Z of the experiment [1]
    deviation: float  # mean of abs(Z / Z_experiment - 1) where it counts [1]
    bias: float  # mean of Z / Z_experiment - 1 where it counts [1]


def column(
    parameters: FreeSurfaceParameters, bounds: Sequence[tuple[float, float]], a: float
) -> InitialState:
    """Return a column at rest at the left wall, on a lattice of particles.

    Args:
        parameters: constants of the solver.
        bounds: walls along each axis [length].
        a: width of the column [length].
    """
    sides = [a, 2.0 * a]
    if len(bounds) == 3:
        low, high = bounds[2]
        sides.append(high - low)
    axes = []
    for (low, _), side in zip(bounds, sides, strict=True):
        count = round(side * parameters.grid * PER_SIDE)
        axes.append(low + (np.arange(count) + 0.5) * (side / count))
    lattice = np.meshgrid(*axes, indexing="ij")
    position = np.stack([coordinate.ravel() for coordinate in lattice], axis=-1)
    particle_count, dimension = position.shape
    return InitialState(
        position=quantise(position),
        velocity=np.zeros((particle_count, dimension)),
        affine=np.zeros((particle_count, dimension, dimension)),
        material=np.full(particle_count, Material.LIQUID, dtype=np.int8),
        area=math.prod(sides),
        wall_velocity=np.zeros((2 * dimension, dimension)),
    )


def front_of(position: NDArray[np.float32], low: float, a: float) -> float:
    """Return Z: how far the front has run, without the spray ahead of it [1]."""
    return (float(np.quantile(position[:, 0], 1.0 - SPRAY)) - low) / a


def run(size: str, split: str = "fluid") -> DamBreak:
    """Let the column break with the constants of a split's size.

    Raises:
        LagbenchError: there is no such size, or the solver failed.
    """
    tier = load().size(split, size)
    low, _ = free_surface_walls(tier)
    width = WIDTH[split]
    constants = solver_constants(tier)
    if not isinstance(constants, FreeSurfaceParameters):
        raise UsageError(
            f"a dam breaks on a free surface only: got {split}, expected "
            f"{', '.join(sorted(WIDTH))}",
            where="--split",
        )
    state = column(constants, tier.box.bounds, width)
    constants = replace(constants, particles=len(state.position))
    solver = build(constants)
    solver.load([state])

    time_unit = math.sqrt(width / (2.0 * constants.gravity))  # of T [s]
    times: list[float] = []
    fronts: list[float] = []
    substep = 0
    stride = max(1, tier.substeps_per_frame // 4)
    while not times or times[-1] < EXPERIMENT_TIME[-1]:
        times.append(substep * constants.dt / time_unit)
        fronts.append(front_of(solver.position()[0], low, width))
        solver.advance(stride)
        substep += stride

    front = np.interp(EXPERIMENT_TIME, times, fronts)
    counts = EXPERIMENT_FRONT >= FIRST_FRONT
    relative = front[counts] / EXPERIMENT_FRONT[counts] - 1.0
    return DamBreak(
        split=split,
        size=size,
        particles=constants.particles,
        time=tuple(EXPERIMENT_TIME.tolist()),
        front=tuple(round_digits(value) for value in front.tolist()),
        experiment=tuple(EXPERIMENT_FRONT.tolist()),
        deviation=round_digits(float(np.abs(relative).mean())),
        bias=round_digits(float(relative.mean())),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.dam_break",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--split", default="fluid", choices=sorted(WIDTH))
    parser.add_argument("--size", default="full", help="size of the split")
    parser.add_argument("--json", type=Path, metavar="FILE", help="results")
    options = parser.parse_args(arguments)
    try:
        # before the long run
        check_writable("--json", options.json)
        result = run(options.size, options.split)
        if options.json is not None:
            text = json.dumps(asdict(result), indent=1) + "\n"
            options.json.write_text(text, encoding="utf-8")
    except (LagbenchError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return getattr(error, "exit_code", WorkFailedError.exit_code)
    lines = ["     T  Z here  Z 1952"]
    rows = zip(result.time, result.front, result.experiment, strict=True)
    for time, front, experiment in rows:
        lines.append(f"{time:6.2f}{front:8.2f}{experiment:8.2f}")
    percent = 100.0 * result.deviation
    lines.append(f"mean deviation {percent:.1f} %, bias {100.0 * result.bias:+.1f} %")
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
