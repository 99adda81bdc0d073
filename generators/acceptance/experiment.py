"""A closed-box experiment of any size: checked settings, solver constants, initial state.

The splits in datasets.yaml come in three sizes; an experiment scales size ``full`` to any grid.
The box stays where it is as nearly as nodes allow, dt shrinks with dx, the particles per cell
and the constants per substep stay.
"""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from lagbench.data import registry
from lagbench.errors import UsageError
from lagbench.generators import cavity, curl_noise
from lagbench.generators.draws import quantise
from lagbench.generators.lattice import fill
from lagbench.generators.noise import gradients
from lagbench.generators.split import WALLS, ClosedBoxParameters, InitialState, Material

from .diagnostics import Box, box_of

__all__ = ["Case", "Experiment", "initial_state", "plan", "solver_parameters"]


_FULL_GRID = 40
_LEAST_GRID = 16
_VISCOUS_LIMIT = 0.2
_ACOUSTIC_LIMIT = 0.5
_MACH_LIMIT = 1.0 / 3.0
_LARGEST_FREQUENCY = 14
"""Beyond it velocity gradients outgrow what :func:`.draws.quantise` holds."""

_DEFAULT_LID_SPEED = 0.15
_DEFAULT_FREQUENCY = 4


class Case(enum.StrEnum):
    """Which closed box: driven by its lid, or stirred once."""

    CAVITY = "cavity"
    CURL_NOISE = "curl-noise"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment:
    """Settings of one run, checked and complete; :func:`plan` makes them."""

    case: Case  # which box
    # U L / nu with the lid speed U, or the initial RMS speed in curl noise [1]; None for an inviscid fluid
    reynolds: float | None
    grid: int  # cells across the unit box
    particles: int
    substeps: int  # solver steps
    dt: float  # substep [s]
    lid_speed: float  # speed of the top wall [length/s]; 0 in curl noise
    lid_off_after: int | None  # substep after which the lid stands still, None for never
    frequency: int  # Perlin lattice cells across the box; 0 in the cavity
    seed: int  # seed of the particle lattice and of the stirring

    @property
    def frame_substeps(self) -> int:
        """Substeps between two records, as near to the split's frame interval as they allow."""
        return max(1, round(_full(self.case).frame_interval / self.dt))


def _full(case: Case) -> registry.Size:
    return registry.load().size(case.value, "full")


def plan(
    case: Case,
    *,
    substeps: int,
    reynolds: float | None = None,
    grid: int = _FULL_GRID,
    particles: int | None = None,
    dt: float | None = None,
    lid_speed: float | None = None,
    lid_off_after: int | None = None,
    frequency: int | None = None,
    seed: int = 0,
) -> Experiment:
    """Complete and check the settings of a run; attributes as in :class:`Experiment`."""
    full = _full(case)
    _check_case(case, reynolds=reynolds, lid=(lid_speed, lid_off_after), frequency=frequency)
    _check(grid >= _LEAST_GRID, "the grid is too small", "--grid", f"at least {_LEAST_GRID}", grid)
    _check(substeps >= 1, "there is nothing to simulate", "--substeps", "at least 1", substeps)
    _check(seed >= 0, "a seed is not negative", "--seed", "at least 0", seed)
    driven = case is Case.CAVITY
    experiment = Experiment(
        case=case,
        reynolds=reynolds,
        grid=grid,
        particles=round(full.particles * (grid / full.grid) ** 2) if particles is None else particles,
        substeps=substeps,
        dt=full.dt * full.grid / grid if dt is None else dt,
        lid_speed=(_DEFAULT_LID_SPEED if lid_speed is None else lid_speed) if driven else 0.0,
        lid_off_after=lid_off_after,
        frequency=0 if driven else (_DEFAULT_FREQUENCY if frequency is None else frequency),
        seed=seed,
    )
    _check_ranges(experiment)
    return experiment


def _check(holds: bool, what: str, where: str, expected: object, got: object) -> None:
    if not holds:
        raise UsageError(what, where=where, expected=expected, got=got)


def _check_case(
    case: Case, *, reynolds: float | None, lid: tuple[float | None, int | None], frequency: int | None
) -> None:
    """Refuse settings that mean nothing in this case."""
    if case is Case.CAVITY:
        _check(reynolds is not None, "a cavity needs a Reynolds number", "--re", "a positive number", None)
        _check(frequency is None, "a cavity has no stirring", "--frequency", "not given", frequency)
    else:
        _check(lid == (None, None), "curl noise has no lid", "--lid-speed, --lid-off-after", "not given", lid)


def _check_ranges(experiment: Experiment) -> None:
    """Refuse what the solver cannot resolve or is unstable at."""
    parameters = solver_parameters(experiment)
    box = box_of(parameters)
    sound = math.sqrt(parameters.modulus / parameters.density)
    fastest = _ACOUSTIC_LIMIT / (sound * parameters.grid)
    e = experiment
    _check(
        e.particles >= box.cells**2,
        "fewer particles than cells",
        "--particles",
        f"at least {box.cells**2} in {box.cells} x {box.cells} cells",
        e.particles,
    )
    _check(0.0 < e.dt <= fastest, "sound outruns the grid", "--dt", f"above 0, at most {fastest:.3g}", e.dt)
    if e.case is Case.CAVITY:
        top = _MACH_LIMIT * sound
        _check(
            0.0 < e.lid_speed <= top,
            "not a subsonic lid",
            "--lid-speed",
            f"above 0, at most {top:.3g}",
            e.lid_speed,
        )
        off = e.lid_off_after
        _check(
            off is None or 0 < off < e.substeps,
            "the lid stops outside the run",
            "--lid-off-after",
            f"from 1 to {e.substeps - 1}",
            off,
        )
    else:
        most = min(box.cells // 2, _LARGEST_FREQUENCY)
        _check(
            1 <= e.frequency <= most,
            "the grid cannot hold this frequency",
            "--frequency",
            f"from 1 to {most}",
            e.frequency,
        )
    _check_reynolds(e, box)


def _check_reynolds(e: Experiment, box: Box) -> None:
    """Refuse a viscosity at which explicit diffusion is unstable."""
    if e.reynolds is None:
        return
    positive = math.isfinite(e.reynolds) and e.reynolds > 0.0
    _check(positive, "not a Reynolds number", "--re", "a positive number", e.reynolds)
    if e.case is Case.CAVITY:
        speed = e.lid_speed
    else:
        speed = _root_mean_square_speed(initial_state(dataclasses.replace(e, reynolds=None)))
    least = speed * box.width * e.dt / (_VISCOUS_LIMIT * box.spacing**2)
    _check(
        e.reynolds >= least,
        "too viscous for the substep",
        "--re",
        f"at least {least:.3g} at dt = {e.dt:.3g}",
        e.reynolds,
    )


def solver_parameters(experiment: Experiment) -> ClosedBoxParameters:
    """Return the constants of size ``full``, scaled to the experiment's grid."""
    full = _full(experiment.case)
    driven = experiment.case is Case.CAVITY
    parameters = cavity.solver_parameters(full) if driven else curl_noise.solver_parameters(full)
    wall = (parameters.wall + 0.5) * experiment.grid / parameters.grid - 0.5
    return dataclasses.replace(
        parameters,
        particles=experiment.particles,
        grid=experiment.grid,
        dt=experiment.dt,
        # Python rounds halves to even, NumPy alike: 4.5 gives 4.
        wall=round(wall),
    )


def initial_state(experiment: Experiment) -> InitialState:
    """Fill the box with particles: at rest under a moving lid, or stirred by curl noise."""
    box = box_of(solver_parameters(experiment))
    full = _full(experiment.case)
    rng = np.random.Generator(np.random.PCG64(experiment.seed))
    position = fill(rng, experiment.particles, low=box.low, high=box.high, jitter=full.value("jitter"))
    velocity, affine = np.zeros_like(position), np.zeros((*position.shape, 2))
    if experiment.case is Case.CURL_NOISE:
        psi = curl_noise.stream_function(
            position,
            gradients(rng, experiment.frequency),
            low=box.low,
            high=box.high,
            scale=full.value("velocity_scale"),
        )
        velocity = quantise(np.stack([psi.y, -psi.x], axis=-1))
        affine = quantise(np.stack([psi.xy, psi.yy, -psi.xx, -psi.xy], axis=-1)).reshape(affine.shape)
    wall_velocity = np.zeros((len(WALLS), 2))
    wall_velocity[WALLS.index("top"), 0] = experiment.lid_speed
    state = InitialState(
        position=position,
        velocity=velocity,
        affine=affine,
        material=np.full(len(position), Material.LIQUID, dtype=np.int8),
        area=box.width**2,
        wall_velocity=quantise(wall_velocity),
    )
    return dataclasses.replace(state, viscosity=_viscosity(experiment, state, box))


def _root_mean_square_speed(state: InitialState) -> float:
    return float(np.sqrt(np.mean(np.sum(state.velocity**2, axis=-1))))


def _viscosity(experiment: Experiment, state: InitialState, box: Box) -> float:
    """Return nu = U L / Re [length^2/s]."""
    if experiment.reynolds is None:
        return 0.0
    speed = experiment.lid_speed or _root_mean_square_speed(state)
    return speed * box.width / experiment.reynolds
