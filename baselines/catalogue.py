"""The baselines by name, from the entry points of installed packages.

An entry point of the group ``lagbench.baselines`` names a subclass of
:class:`~lagbench.baselines.baseline.Baseline`, or one of
:class:`~lagbench.baselines.operators.operator.Operator`. An operator becomes a graph
network with that operator.
"""

from __future__ import annotations

import inspect
import re
import warnings
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

from lagbench.data.registry import (
    PluginWarning,
    Size,
    list_entry_points,
    package_of,
)
from lagbench.errors import (
    LagbenchError,
    UsageError,
    describe_exception,
    suggest_name,
)

from .baseline import Baseline
from .operators.operator import Operator
from .simulator import GraphNetwork

GROUP = "lagbench.baselines"  # of entry points; the modules of this package lie there
RECIPES = Path(__file__).parent / "recipes"
NAME = re.compile("[a-z0-9]+(-[a-z0-9]+)*")  # of a baseline: it names folders
# what a subclass of Baseline defines
REQUIRED = ("history", "forward", "start", "advance")
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
        UsageError: there is no such baseline, or its package cannot be imported.
    """
    points = _find_points()
    if name not in points:
        raise UsageError(
            f"no baseline {name!r}",
            where="--baseline",
            expected="the name of a reference model",
            got=repr(name),
            fix=suggest_name(name, points),
        )
    try:
        return _load_entry(points[name])
    except Exception as error:  # importing a stranger's module may raise anything
        raise UsageError(
            f"the baseline {name!r} cannot be loaded",
            where=package_of(points[name]),
            expected="a module that can be imported",
            got=_describe_error(error),
            fix="mend or uninstall that package",
        ) from error


def check_data_set(entry: CatalogueEntry, size: Size) -> None:
    """Refuse a data set that no recipe makes fit for a baseline.

    Args:
        entry: the baseline.
        size: description of the data set.

    Raises:
        UsageError: the baseline does not know such data.
    """
    entry.model.check_data_set(
        size.split, size.name, size.box, is_full_box=size.is_full_box
    )


def load_all() -> dict[str, CatalogueEntry]:
    """Return every baseline that can be loaded; warn of others with PluginWarning."""
    entries = {}
    for name, point in _find_points().items():
        try:
            entries[name] = _load_entry(point)
        except Exception as error:  # importing a stranger's module may raise anything
            _warn_of_point(point, _describe_error(error))
    return entries


def _find_points() -> dict[str, EntryPoint]:
    """Return the entry points by name; those of this package cannot be replaced."""
    points: dict[str, EntryPoint] = {}
    for point in sorted(list_entry_points(GROUP), key=_is_foreign):
        if not NAME.fullmatch(point.name):
            reason = "a name has small letters, digits and single hyphens"
            _warn_of_point(point, reason)
            continue
        holder = points.setdefault(point.name, point)
        if holder.value != point.value:
            _warn_of_point(point, "its name is taken")
    return points


def _is_foreign(point: EntryPoint) -> bool:
    return not point.value.startswith(f"{GROUP}.")


def _warn_of_point(point: EntryPoint, reason: str) -> None:
    package = package_of(point)
    message = f"package {package} adds no baseline {point.name!r}: {reason}"
    warnings.warn(message, PluginWarning, stacklevel=4)


def _load_entry(point: EntryPoint) -> CatalogueEntry:
    loaded_class = point.load()
    if not inspect.isclass(loaded_class):
        raise UsageError(
            f"{point.value} is no class",
            where=package_of(point),
            expected="a subclass of Baseline or Operator",
            got=type(loaded_class).__name__,
            fix="name the class in its entry point, as in package.module:MyModel",
        )
    if issubclass(loaded_class, Baseline):
        _check_complete(loaded_class, point)
        _check_option_names(loaded_class, point)
        recipes = _find_recipes(loaded_class, point.name)
        return CatalogueEntry(name=point.name, model=loaded_class, recipes=recipes)
    if issubclass(loaded_class, Operator):
        model = GraphNetwork.with_operator(loaded_class)
        recipes = _find_recipes(loaded_class, OPERATOR_RECIPES)
        return CatalogueEntry(name=point.name, model=model, recipes=recipes)
    raise UsageError(
        f"{point.value} is no baseline",
        where=package_of(point),
        expected="a subclass of Baseline or Operator",
        got=", ".join(base.__name__ for base in loaded_class.__bases__),
        fix="derive it from lagbench.baselines.baseline.Baseline: docs/baselines.md",
    )


def _check_complete(model: type[Baseline], point: EntryPoint) -> None:
    """Refuse a baseline that lacks a method of the contract."""
    missing = []
    present = []
    for name in REQUIRED:
        if getattr(model, name) is getattr(Baseline, name):
            missing.append(name)
        else:
            present.append(name)
    if missing:
        raise UsageError(
            f"{point.value} lacks {', '.join(missing)}",
            where=package_of(point),
            expected=", ".join(REQUIRED),
            got=", ".join(present) or "none",
            fix="add them: docs/baselines.md has the contract",
        )


def _check_option_names(model: type[Baseline], point: EntryPoint) -> None:
    """Refuse a baseline that names options it does not have."""
    options = model.Options
    unknown_names = []
    for name in sorted(options.in_training | options.of_weights):
        if name not in options.model_fields:
            unknown_names.append(name)
    if unknown_names:
        raise UsageError(
            f"in_training or of_weights of {point.value} name no option",
            where=package_of(point),
            expected=f"names of options: {', '.join(options.model_fields) or 'none'}",
            got=", ".join(unknown_names),
            fix="correct these names in the class of the options",
        )


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
    path = Path(stated)
    if path.is_absolute():
        return path
    owner = next(base for base in model.__mro__ if "recipes" in vars(base))
    module = Path(inspect.getfile(owner))
    return module.parent / path


def _describe_error(error: Exception) -> str:
    if isinstance(error, LagbenchError):
        return str(error)
    return describe_exception(error)
