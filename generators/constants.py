"""From a size in datasets.yaml to its split's module, constants, walls and ranges.

This is where the constants of a solver are checked, so that wrong names and values are
refused before work starts.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields
from difflib import get_close_matches
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
    text_of,
)

from .draws import RandomSource, uniform
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


def check_constants(
    kind: ParametersType, values: Mapping[str, object], size: Size
) -> None:
    """Refuse constants that a solver cannot use.

    Raises:
        UnreadableFileError: a constant is missing or has an impossible value.
    """
    for field in fields(kind):
        if field.name in values:
            _check_value(field, values, size)
        elif field.default is MISSING:
            raise _missing_parameter(field.name, kind, size)
    if values.get("fringe_rate", 0.0):
        if "fringe_length" not in values:
            raise _missing_parameter("fringe_length", kind, size)
        length = values["fringe_length"]
        box_length = float(size.box.lengths[0])
        limit = Limit(low=0.0, high=box_length, open_low=True)
        if not limit.holds(length):
            raise _impossible_value("fringe_length", length, str(limit), size)


def place_of(size: Size) -> str:
    """Return where a size is described, for messages."""
    return f"{size.file}, splits.{size.split}, size {size.name}"


def _missing_parameter(
    name: str, kind: ParametersType, size: Size
) -> UnreadableFileError:
    """Return the error for a missing parameter; it suggests names that are like it."""
    constant_names = {field.name for field in fields(kind)}
    unused_names = [other for other in size.parameters if other not in constant_names]
    similar_names = get_close_matches(name, unused_names, n=3)
    fix = f"declare {name} under parameters of the split"
    if similar_names:
        fix = f"did you mean {similar_names[0]!r}?"
    return UnreadableFileError(
        "a parameter is missing",
        where=f"{place_of(size)}, parameter {name}",
        expected=name,
        got=", ".join(similar_names) or "no name like it",
        fix=fix,
    )


def _check_value(field: Field[Any], values: Mapping[str, object], size: Size) -> None:
    """Refuse a constant with an impossible value."""
    value = values[field.name]
    if isinstance(value, Box):  # the registry has checked it
        return
    limit = LIMITS.get(field.name, Limit())
    if field.type == "bool":
        is_possible = isinstance(value, bool)
        expected = "true or false"
    else:
        is_possible = limit.holds(value)
        expected = str(limit)
    if field.name == "wall" and is_possible:
        # Between the walls lie four cells at least.
        high = (int(str(values["grid"])) - 4) // 2
        limit = Limit(low=0, high=high, whole=True)
        is_possible = limit.holds(value)
        expected = str(limit)
    if not is_possible:
        raise _impossible_value(field.name, value, expected, size)


def _impossible_value(
    name: str, value: object, expected: str, size: Size
) -> UnreadableFileError:
    """Return the error for a parameter that a solver cannot use."""
    return UnreadableFileError(
        "a parameter has no possible value",
        where=f"{place_of(size)}, parameter {name}",
        expected=expected,
        got=repr(value),
        fix="correct it in the file of the split",
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
            error.what,
            where=", ".join(place for place in places if place),
            expected=error.expected,
            got=error.got,
            fix=error.fix,
        ) from error
    except (LagbenchError, MemoryError):
        raise
    # A stranger's module may raise anything, or end the program.
    except (Exception, SystemExit) as error:
        place = find_place_in_extension(error, size.generator)
        if place is not None:
            raise WorkFailedError(
                f"{work} failed in the module of split {size.split!r}",
                where=place,
                expected="no exception",
                got=f"{type(error).__name__}: {text_of(error)}",
                fix="mend this line of the module, or the parameters that it uses: "
                f"{place_of(size)}",
            ) from error
        if not isinstance(error, PARAMETER_ERRORS):
            raise
        raise UnreadableFileError(
            f"{work} failed with these parameters",
            where=place_of(size),
            expected=f"parameters that {size.generator} can use",
            got=f"{type(error).__name__}: {error}{_list_texts(size)}",
            fix="compare the parameters with those in the datasets.yaml of lagbench",
        ) from error


def _list_texts(size: Size) -> str:
    """Return the end of a sentence that lists the parameters that are no numbers."""
    texts = []
    for name, parameter in size.parameters.items():
        if isinstance(parameter.value, bool | str):
            texts.append(f"{name} = {parameter.value!r}")
    if not texts:
        return ""
    return f"; parameters that are no numbers: {', '.join(texts)}"


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
            f"the generator of split {size.split!r} cannot be imported",
            where=size.generator,
            expected="a module that can be imported",
            got=describe_exception(error, size.generator),
            fix="mend the module, or correct the key generator of the split",
        ) from error
    needed = ("solver_parameters", "initial_state")
    missing = [name for name in needed if not hasattr(module, name)]
    if missing:
        raise UsageError(
            f"a generator lacks {' and '.join(missing)}",
            where=size.generator,
            expected=" and ".join(needed),
            got="a module without these functions",
            fix="add the functions: docs/extending.md has the contract of a split",
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
            "a split returned no constants of a solver",
            where=f"{size.generator}.solver_parameters",
            expected=f"an object of one of these types: {', '.join(type_names)}",
            got=type(parameters).__name__,
            fix="return constants(FreeSurfaceParameters, size), or those of another of "
            "these types",
        )
    return parameters
