"""The baselines by name: those that entry points of installed packages name.

An entry point of the group ``lagbench.baselines`` names a subclass of
:class:`~lagbench.baselines.baseline.Baseline`, or one of
:class:`~lagbench.baselines.operators.operator.Operator`, which becomes a graph network
that gathers by it.
"""

from __future__ import annotations

import inspect
import re
import warnings
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

from lagbench.data.registry import PluginWarning, list_entry_points
from lagbench.errors import LagbenchError, UsageError, load_entry_point, suggest_name

from .baseline import Baseline

GROUP = "lagbench.baselines"  # of entry points; where ours lie
RECIPES = Path(__file__).parent / "recipes"
NAME = re.compile("[a-z0-9]+(-[a-z0-9]+)*")  # of a baseline: it names folders
REQUIRED = (
    "history",
    "forward",
    "start",
    "advance",
)  # what a subclass of Baseline defines
# recipe file that all operators share, so that they differ in the operator only
OPERATOR_RECIPES = "gns"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A baseline as an entry point names it."""

    name: str  # name on the command line
    model: type[Baseline]  # its class
    recipes: Path | None  # YAML file of its recipes; None where there is none


def names() -> tuple[str, ...]:
    """Return the names of all baselines, sorted; nothing is imported."""
    return tuple(sorted(_points()))


def find(name: str) -> Entry:
    """Return a baseline by name."""
    points = _points()
    if name not in points:
        raise UsageError(
            f"no baseline {name!r}", where="--baseline", fix=suggest_name(name, points)
        )
    try:
        return _entry(points[name])
    except Exception as error:  # a stranger's module: importing it may raise anything
        raise UsageError(
            f"the baseline {name!r} cannot be loaded",
            where=_package(points[name]),
            got=_reason(error),
            fix="mend or uninstall that package",
        ) from error


def every_entry() -> dict[str, Entry]:
    """Return every baseline that can be loaded; others are left out with a
    PluginWarning.
    """
    found = {}
    for name, point in _points().items():
        try:
            found[name] = _entry(point)
        except Exception as error:  # as above
            message = (
                f"package {_package(point)} adds no baseline {name!r}: {_reason(error)}"
            )
            warnings.warn(message, PluginWarning, stacklevel=2)
    return found


def _points() -> dict[str, EntryPoint]:
    """Return the entry points by name; ours are not to be replaced."""
    found: dict[str, EntryPoint] = {}
    for point in sorted(
        list_entry_points(GROUP),
        key=lambda point: not point.value.startswith(f"{GROUP}."),
    ):
        reason = "a name has small letters, digits and single hyphens"
        if NAME.fullmatch(point.name):
            if found.setdefault(point.name, point).value != point.value:
                reason = "its name is taken"
            else:
                reason = ""
        if reason:
            message = (
                f"package {_package(point)} adds no baseline {point.name!r}: {reason}"
            )
            warnings.warn(message, PluginWarning, stacklevel=3)
    return found


def _entry(point: EntryPoint) -> Entry:
    found = load_entry_point(point)
    if not inspect.isclass(found):
        raise UsageError(
            f"{point.value} is no class", expected="a subclass of Baseline or Operator"
        )
    if issubclass(found, Baseline):
        bare = [
            name for name in REQUIRED if getattr(found, name) is getattr(Baseline, name)
        ]
        if bare:
            raise UsageError(
                f"{point.value} lacks {', '.join(bare)}", expected=", ".join(REQUIRED)
            )
        return Entry(name=point.name, model=found, recipes=_recipes(found, point.name))
    from lagbench.baselines.operators.operator import Operator

    from .simulator import GraphNetwork

    if not issubclass(found, Operator):
        raise UsageError(
            f"{point.value} is no baseline",
            expected="a subclass of Baseline or Operator",
        )
    model = GraphNetwork.with_operator(found)
    return Entry(
        name=point.name, model=model, recipes=_recipes(found, OPERATOR_RECIPES)
    )


def _recipes(found: type, name: str) -> Path | None:
    """Return the file that a class names as ``recipes``, from its module's folder, else
    ours of that name.
    """
    given = getattr(found, "recipes", None)
    if given:
        path = Path(given)
    else:
        path = RECIPES / f"{name}.yaml"
    if not path.is_absolute():
        owner = next(base for base in found.__mro__ if "recipes" in vars(base))
        path = Path(inspect.getfile(owner)).parent / path
    if given or path.is_file():
        return path
    return None


def _package(point: EntryPoint) -> str:
    if point.dist:
        return point.dist.name
    return point.value.partition(".")[0]


def _reason(error: Exception) -> str:
    if isinstance(error, LagbenchError):
        return str(error)
    return f"{type(error).__name__}: {error}"
