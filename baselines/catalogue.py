"""The baselines by name, from the entry points of installed packages.

An entry point of the group ``lagbench.baselines`` names a subclass of
:class:`~lagbench.baselines.baseline.Baseline`, or one of
:class:`~lagbench.baselines.operators.operator.Operator`. An operator becomes a graph
network with that operator.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

from lagbench.data.registry import list_entry_points
from lagbench.errors import UsageError, suggest_name

from .baseline import Baseline
from .operators.operator import Operator
from .simulator import GraphNetwork

GROUP = "lagbench.baselines"  # of entry points; the modules of this package lie there
RECIPES = Path(__file__).parent / "recipes"
# recipe file of all operators, so that they differ in the operator only
OPERATOR_RECIPES = "gns"


@dataclass(frozen=True, kw_only=True)
class CatalogueEntry:
    """A baseline that an entry point names."""

    name: str  # name on the command line
    model: type[Baseline]  # its class
    recipes: Path | None  # YAML file of its recipes; None where there is none


def list_names() -> tuple[str, ...]:
    """Return the names of all baselines, sorted; nothing is imported."""
    return tuple(sorted(_find_points()))


def find(name: str) -> CatalogueEntry:
    """Return a baseline by name.

    Raises:
        UsageError: there is no such baseline, or its entry point names none.
    """
    points = _find_points()
    if name not in points:
        raise UsageError(f"no baseline {name!r}; {suggest_name(name, points)}")
    point = points[name]
    model = point.load()
    if inspect.isclass(model) and issubclass(model, Baseline):
        recipes = _find_recipes(model, name)
        return CatalogueEntry(name=name, model=model, recipes=recipes)
    if inspect.isclass(model) and issubclass(model, Operator):
        network = GraphNetwork.with_operator(model)
        recipes = _find_recipes(model, OPERATOR_RECIPES)
        return CatalogueEntry(name=name, model=network, recipes=recipes)
    raise UsageError(
        f"the entry point {name} names {point.value}, which is no subclass of Baseline "
        "or Operator: docs/extending.md"
    )


def _find_points() -> dict[str, EntryPoint]:
    """Return the entry points by name; those of this package cannot be replaced."""
    points: dict[str, EntryPoint] = {}
    own_first = sorted(
        list_entry_points(GROUP), key=lambda point: not point.value.startswith(GROUP)
    )
    for point in own_first:
        points.setdefault(point.name, point)
    return points


def _find_recipes(model: type, name: str) -> Path | None:
    """Return the recipe file of a class.

    A class attribute ``recipes`` names it, from the folder of its module; else it is
    the file of that name in this package, if there is one.
    """
    stated: str | Path | None = getattr(model, "recipes", None)
    if not stated:
        path = RECIPES / f"{name}.yaml"
        if path.is_file():
            return path
        return None
    owner = next(base for base in model.__mro__ if "recipes" in vars(base))
    return Path(inspect.getfile(owner)).parent / stated
