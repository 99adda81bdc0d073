"""From a size in datasets.yaml to its split's module, constants, walls and the ranges
of what is drawn.

What the constants of a solver may be: wrong names and values are told before work
starts.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields
from difflib import get_close_matches
from typing import TYPE_CHECKING, TypeVar, cast

from lagbench.data.limits import Limit
from lagbench.errors import UnreadableFileError, UsageError

from .shapes import Region
from .split import ClosedBoxParameters, FreeSurfaceParameters, Split

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = [
    "blamed_on_parameters",
    "check_constants",
    "closed_box_walls",
    "constants",
    "free_surface_walls",
    "interval",
    "ranges",
    "solver_constants",
    "split_module",
]


ParametersType = type[ClosedBoxParameters] | type[FreeSurfaceParameters]

_POSITIVE = (
    *(
        "dt",
        "density",
        "modulus",
        "liquid_modulus",
        "jelly_modulus",
        "rope_modulus",
        "snow_modulus",
    ),
    *("snow_hardening_min", "snow_hardening_max", "snow_jp_min", "snow_jp_max"),
)
_NOT_NEGATIVE = (
    "shift",
    "liquid_viscosity",
    "elastic_damping",
    "snow_stretch",
    "snow_hardening",
)

LIMITS = {
    "particles": Limit(low=1, whole=True),
    "grid": Limit(low=4, whole=True),
    "wall": Limit(low=0, whole=True),
    "substeps_per_frame": Limit(low=1, whole=True),
    **dict.fromkeys(_POSITIVE, Limit(low=0.0, open_low=True)),
    **dict.fromkeys(_NOT_NEGATIVE, Limit(low=0.0)),
    **{
        f"{solid}_poisson": Limit(low=0.0, high=0.5, open_high=True)
        for solid in ("jelly", "rope", "snow")
    },
    "velocity_relaxation": Limit(low=0.0, high=1.0),
    "jacobian_relaxation": Limit(low=0.0, high=1.0),
    "density_coupling": Limit(low=0.0, high=1.0),
    "jacobian_min": Limit(low=0.0, high=1.0, open_low=True),
    "jacobian_max": Limit(low=1.0),
    "snow_compression": Limit(low=0.0, high=1.0, open_high=True),
}
"""Limits of constants that both the solvers and their stability rest on; others are
finite numbers.
"""


def check_constants(
    kind: ParametersType, given: Mapping[str, object], size: Size
) -> None:
    """Refuse constants that a solver cannot use."""
    where = f"{size.file}, splits.{size.split}, size {size.name}"
    for field in fields(kind):
        if field.name not in given:
            if field.default is MISSING:
                known = {other.name for other in fields(kind)}
                strange = [other for other in size.parameters if other not in known]
                close = get_close_matches(field.name, strange, n=3)
                declare = f"declare {field.name} under parameters of the split"
                raise UnreadableFileError(
                    "a parameter is missing",
                    where=f"{where}, parameter {field.name}",
                    expected=field.name,
                    got=", ".join(close) or "no name like it",
                    fix=f"did you mean {close[0]!r}?" if close else declare,
                )
            continue
        limit = LIMITS.get(field.name, Limit())
        value = given[field.name]
        if field.type == "bool":
            good = isinstance(value, bool)
            expected = "true or false"
        else:
            good = limit.holds(value)
            expected = str(limit)
        if field.name == "wall" and good:
            # The box between the walls is four cells wide at least.
            high = (int(str(given["grid"])) - 4) // 2
            limit = Limit(low=0, high=high, whole=True)
            good = limit.holds(value)
            expected = str(limit)
        if not good:
            raise UnreadableFileError(
                "a parameter has no possible value",
                where=f"{where}, parameter {field.name}",
                expected=expected,
                got=repr(value),
            )


@contextmanager
def blamed_on_parameters(size: Size, work: str) -> Iterator[None]:
    """Turn what a split's module raises over its parameters into an error that names
    their file.
    """
    where = f"{size.file}, splits.{size.split}, size {size.name}"
    try:
        yield
    except UsageError as error:
        raise UnreadableFileError(
            error.what,
            where=where,
            expected=error.expected,
            got=error.got,
            fix=error.fix,
        ) from error
    except (TypeError, ValueError, ArithmeticError, LookupError) as error:
        texts = [
            f"{n} = {p.value!r}"
            for n, p in size.parameters.items()
            if isinstance(p.value, bool | str)
        ]
        listing = (
            f"; parameters that are no numbers: {', '.join(texts)}" if texts else ""
        )
        raise UnreadableFileError(
            f"{work} failed with these parameters",
            where=where,
            expected=f"parameters that {size.generator} can use",
            got=f"{type(error).__name__}: {error}{listing}",
            fix="compare the parameters with those in the datasets.yaml of lagbench",
        ) from error


Kind = TypeVar("Kind", ClosedBoxParameters, FreeSurfaceParameters)


def constants(kind: type[Kind], size: Size, **fixed: object) -> Kind:
    """Return the solver constants that a size names; others keep their defaults."""
    given = {
        f.name: size.value(f.name) for f in fields(kind) if f.name in size.parameters
    }
    settled = {"dt": size.dt, **given, **fixed}
    check_constants(kind, settled, size)
    return kind(**settled)


def closed_box_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, half-way between two nodes [length]."""
    low = (float(size.value("wall")) + 0.5) / size.grid
    return low, 1.0 - low


def free_surface_walls(size: Size) -> tuple[float, float]:
    """Return the low and high wall, each on a node [length]."""
    low = float(size.value("wall")) / size.grid
    return low, 1.0 - low


def interval(size: Size, name: str) -> tuple[float, float]:
    """Return the parameters ``<name>_min`` and ``<name>_max``."""
    return float(size.value(f"{name}_min")), float(size.value(f"{name}_max"))


def ranges(size: Size, name: str) -> Region:
    """Return the intervals of ``<name>_x`` and ``<name>_y``."""
    return interval(size, f"{name}_x"), interval(size, f"{name}_y")


def split_module(size: Size) -> Split:
    """Return the module that draws the scenarios of a size."""
    try:
        module = importlib.import_module(size.generator)
    except ImportError as error:
        raise UsageError(
            f"the generator of split {size.split!r} cannot be imported",
            where=size.generator,
            got=error,
        ) from error
    missing = [
        name
        for name in ("solver_parameters", "initial_state")
        if not hasattr(module, name)
    ]
    if missing:
        raise UsageError(
            f"a generator lacks {' and '.join(missing)}", where=size.generator
        )
    return cast("Split", module)


def solver_constants(size: Size) -> ClosedBoxParameters | FreeSurfaceParameters:
    """Return the constants of the solver of a size; an impossible parameter is an
    UnreadableFileError.
    """
    module = split_module(size)
    with blamed_on_parameters(size, "choosing the solver's constants"):
        return module.solver_parameters(size)
