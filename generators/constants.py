"""From a size in datasets.yaml to its split's module, constants, walls and ranges.

This is where the constants of a solver are checked, so that wrong names and values are
refused before work starts.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any, TypeVar, cast

from lagbench.data.box import Box
from lagbench.data.limits import Limit
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
    describe_exception,
    find_place_in_extension,
)

from .draws import RandomSource, draw_integer, uniform
from .full_box_parameters import FullBoxParameters
from .shapes import Region
from .solver import IMPLEMENTATIONS
from .split import (
    FreeSurfaceParameters,
    SolverParameters,
    SplitGenerator,
)

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = [
    "blamed_on_parameters",
    "check_constants",
    "constants",
    "draw_between",
    "free_surface_walls",
    "interval",
    "ranges",
    "shift_number",
    "solver_constants",
    "split_module",
    "start_frame",
]


ParametersType = type[FreeSurfaceParameters] | type[FullBoxParameters]

_POSITIVE = Limit(low=0.0, open_low=True)
_NOT_NEGATIVE = Limit(low=0.0)
_SHARE = Limit(low=0.0, high=1.0)
_POISSON = Limit(low=0.0, high=0.5, open_high=True)

LIMITS = {
    "particles": Limit(low=1, whole=True),
    "grid": Limit(low=4, whole=True),
    "wall": Limit(low=0, whole=True),
    "force_layers": Limit(low=0, whole=True),
    "substeps_per_frame": Limit(low=1, whole=True),
    "obstacle_particles": Limit(low=0, whole=True),
    "fringe_length": _NOT_NEGATIVE,
    "fringe_rate": _NOT_NEGATIVE,
    "dt": _POSITIVE,
    "density": _POSITIVE,
    "modulus": _POSITIVE,
    "liquid_modulus": _POSITIVE,
    "jelly_modulus": _POSITIVE,
    "rope_modulus": _POSITIVE,
    "snow_modulus": _POSITIVE,
    "snow_hardening_min": _POSITIVE,
    "snow_hardening_max": _POSITIVE,
    "snow_jp_min": _POSITIVE,
    "snow_jp_max": _POSITIVE,
    "shift": _NOT_NEGATIVE,
    "liquid_viscosity": _NOT_NEGATIVE,
    "elastic_damping": _NOT_NEGATIVE,
    "snow_stretch": _NOT_NEGATIVE,
    "snow_hardening": _NOT_NEGATIVE,
    "jelly_poisson": _POISSON,
    "rope_poisson": _POISSON,
    "snow_poisson": _POISSON,
    "velocity_relaxation": _SHARE,
    "jacobian_relaxation": _SHARE,
    "density_coupling": _SHARE,
    "jacobian_min": Limit(low=0.0, high=1.0, open_low=True),
    "jacobian_max": Limit(low=1.0),
    "snow_compression": Limit(low=0.0, high=1.0, open_high=True),
}
"""Limits of constants that both the solvers and their stability rest on; others are
finite numbers.
"""


PARAMETER_ERRORS = (TypeError, ValueError, ArithmeticError, LookupError)
"""What a split of ours raises over parameters that it cannot use."""


def place_of(size: Size) -> str:
    """Return where a size is described, for messages."""
    return f"{size.file}, splits.{size.split}, size {size.name}"


def check_constants(
    kind: ParametersType, values: Mapping[str, object], size: Size
) -> None:
    """Refuse constants that a solver cannot use.

    Raises:
        UnreadableFileError: a constant is missing or has an impossible value.
    """
    for field in fields(kind):
        name = field.name
        where = f"{place_of(size)}, parameter {name}"
        needs_length = name == "fringe_length" and values.get("fringe_rate")
        if name not in values:
            if field.default is MISSING or needs_length:
                raise UnreadableFileError(
                    "a parameter is missing; declare it under parameters of the split",
                    where=where,
                )
            continue
        value = values[name]
        limit = LIMITS.get(name, Limit())
        if name == "wall" and limit.holds(value):
            # Between the walls lie four cells at least.
            high = (int(str(values["grid"])) - 4) // 2
            limit = Limit(low=0, high=high, whole=True)
        elif needs_length:
            high_end = float(size.box.lengths[0])
            limit = Limit(low=0.0, high=high_end, open_low=True)
        is_possible = limit.holds(value)
        if field.type == "bool":
            is_possible = isinstance(value, bool)
        # The registry has checked the box.
        if not is_possible and not isinstance(value, Box):
            raise UnreadableFileError(
                f"{value!r} is no possible value, expected {limit}; correct it in the "
                "file of the split",
                where=where,
            )


@contextmanager
def blamed_on_parameters(size: Size, work: str) -> Iterator[None]:
    """Turn what a split's module raises over its parameters into an error of ours.

    It names the file of the parameters. Where the split is of another package, it names
    the line of its module too.

    Raises:
        WorkFailedError: the module of another package failed.
        UnreadableFileError: a module of ours cannot use the parameters, or another
            asks for one that is not there.
    """
    try:
        yield
    except UsageError as error:
        places = [place_of(size), find_place_in_extension(error, size.generator)]
        raise UnreadableFileError(
            error.text,
            where=", ".join(place for place in places if place),
        ) from error
    except (LagbenchError, MemoryError):
        raise
    # A stranger's module may raise anything, or end the program.
    except (Exception, SystemExit) as error:
        place = find_place_in_extension(error, size.generator)
        if place is not None:
            raise WorkFailedError(
                f"{work} failed in the module of split {size.split!r}: got "
                f"{type(error).__name__}: {error}, expected no exception; "
                "mend this line of the module, or the parameters that it uses: "
                f"{place_of(size)}",
                where=place,
            ) from error
        if not isinstance(error, PARAMETER_ERRORS):
            raise
        raise UnreadableFileError(
            f"{work} failed with these parameters: got {type(error).__name__}: "
            f"{error}, expected parameters that {size.generator} "
            "can use; compare the parameters with those in the datasets.yaml of "
            "lagbench",
            where=place_of(size),
        ) from error


Kind = TypeVar("Kind", FreeSurfaceParameters, FullBoxParameters)


def constants(kind: type[Kind], size: Size, **fixed: object) -> Kind:
    """Return the solver constants that a size names; others keep their defaults."""
    values: dict[str, Any] = {"dt": size.dt}
    for field in fields(kind):
        if field.name in size.parameters:
            values[field.name] = size.value(field.name)
    values.update(fixed)
    check_constants(kind, values, size)
    return kind(**values)


def free_surface_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, each on a node [length]."""
    low = float(size.value("wall")) / size.grid
    return low, 1.0 - low


def interval(size: Size, name: str) -> tuple[float, float]:
    """Return the parameters ``<name>_min`` and ``<name>_max``."""
    low = size.value(f"{name}_min")
    high = size.value(f"{name}_max")
    return float(low), float(high)


def draw_between(rng: RandomSource, size: Size, name: str) -> float:
    """Draw uniformly between the parameters ``<name>_min`` and ``<name>_max``."""
    low, high = interval(size, name)
    return uniform(rng, low, high)


def start_frame(size: Size, scenario: int, rng: RandomSource) -> int:
    """Draw how many frames a scenario is simulated before frame 0; the first draw."""
    del scenario  # the same range for all
    return draw_integer(rng, *interval(size, "start_frame"))


def shift_number(size: Size, scenario: int) -> int | None:
    """Return the place of a scenario in the subset ``shift``; None in other subsets."""
    shifted = sorted(size.subsets.get("shift", ()))
    if scenario not in shifted:
        return None
    return shifted.index(scenario)


def ranges(size: Size, name: str) -> Region:
    """Return the intervals of ``<name>_x`` and ``<name>_y``."""
    return interval(size, f"{name}_x"), interval(size, f"{name}_y")


def split_module(size: Size) -> SplitGenerator:
    """Return the module that draws the scenarios of a size.

    Raises:
        UsageError: it cannot be imported, or lacks one of the functions of a split.
    """
    try:
        module = importlib.import_module(size.generator)
    except MemoryError:
        raise
    # A stranger's module may raise anything, or end the program.
    except (Exception, SystemExit) as error:
        raise UsageError(
            f"the generator of split {size.split!r} cannot be imported: got "
            f"{describe_exception(error, size.generator)}, expected a module that can "
            "be imported; mend the module, or correct the key generator of the split",
            where=size.generator,
        ) from error
    needed = ("solver_parameters", "initial_state")
    missing = [name for name in needed if not hasattr(module, name)]
    if missing:
        raise UsageError(
            f"a generator lacks {' and '.join(missing)}: got a module without these "
            f"functions, expected {' and '.join(needed)}; add the functions: "
            "docs/extending.md has the contract of a split",
            where=size.generator,
        )
    return cast("SplitGenerator", module)


def solver_constants(size: Size) -> SolverParameters:
    """Return the solver's constants of a size, which its generator derives.

    Raises:
        UnreadableFileError: a parameter of the size in datasets.yaml is impossible.
        UsageError: the generator returns something else than constants of a solver.
    """
    module = split_module(size)
    with blamed_on_parameters(size, "choosing the solver's constants"):
        parameters = module.solver_parameters(size)
    if type(parameters) not in IMPLEMENTATIONS:
        type_names = [known_type.__name__ for known_type in IMPLEMENTATIONS]
        raise UsageError(
            "a split returned no constants of a solver: got "
            f"{type(parameters).__name__}, expected an object of one of these types: "
            f"{', '.join(type_names)}; return constants(FreeSurfaceParameters, size), "
            "or those of another of these types",
            where=f"{size.generator}.solver_parameters",
        )
    return parameters
