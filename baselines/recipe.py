"""Recipes: the options of a model and of its training for one split and size, from YAML.

A file of recipes holds defaults and what differs from them::

    format: 1
    model: {latent: 128}
    training: {learning_rate: 1.0e-4}
    recipes:
      cavity/full: {training: {steps: 20000}}
      cavity/full-short: {training: {steps: 2000}}    # --recipe short
      "*/tiny": {model: {latent: 16}, training: {steps: 50}}

Later layers win: defaults, recipe, ``--set``. ``steps`` and ``epochs`` replace each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lagbench.errors import LagbenchError, UnreadableFileError, UsageError, nearest
from lagbench.yamlfile import read_yaml

from .catalogue import Entry
from .training_options import TrainingOptions

__all__ = ["Recipe", "recipe_for", "recipe_names"]

Layer = dict[str, Any]
ANY = "*"
Checked = TypeVar("Checked", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What a model is and how it is trained; checked, with every default filled in.

    Attributes:
        baseline: name of the baseline.
        name: name of the recipe, as in ``cavity/mini``.
        model: options of the model, plain values.
        training: options of the training.
    """

    baseline: str
    name: str
    model: Mapping[str, Any]
    training: TrainingOptions

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        training = self.training.model_dump(mode="json")
        return {"baseline": self.baseline, "name": self.name, "model": dict(self.model), "training": training}


class _Part(BaseModel):
    """One recipe: what differs from the defaults of its file."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    model: Layer = Field(default_factory=dict)
    training: Layer = Field(default_factory=dict)


class _File(_Part):
    """A whole file of recipes."""

    format: Literal[1]
    family: str = ""
    recipes: dict[str, _Part] = Field(default_factory=dict)


def recipe_names(entry: Entry) -> tuple[str, ...]:
    """Return the names of a baseline's recipes, as in ``cavity/mini``, in the order of its file."""
    return tuple(_read(entry.recipes).recipes) if entry.recipes else ()


def recipe_for(
    entry: Entry,
    split: str,
    size: str,
    *,
    variant: str | None = None,
    settings: Iterable[str] = (),
    seed: int | None = None,
) -> Recipe:
    """Return the recipe of a baseline for a split and size.

    Args:
        entry: the baseline.
        split: name of the split.
        size: name of the size.
        variant: ``short`` for the recipe ``<split>/<size>-short``; or a YAML file of recipes to
            read in place of ours.
        settings: changes, as in ``model.latent=64``; values are YAML.
        seed: seed in place of the recipe's.

    Raises:
        UsageError: there is no such recipe or key; the message names the nearest.
        UnreadableFileError: the file is no file of recipes.
    """
    own_file = variant is not None and variant.endswith((".yaml", ".yml"))
    path = Path(str(variant)) if own_file else entry.recipes
    file = _read(path) if path else _File(format=1)
    name, part = _choose(entry, file, split, size if own_file or not variant else f"{size}-{variant}")
    model, training = _merge(file.model, part.model), _merge(file.training, part.training)
    for setting in settings:
        group, changes = _setting(setting)
        if group == "model":
            model = _merge(model, changes)
        else:
            training = _merge(training, changes)
    if seed is not None:
        training["seed"] = seed
    where = f"{path.name if path else entry.name}, {name}"
    return Recipe(
        baseline=entry.name,
        name=name,
        model=_checked(entry.model.Options, model, "model", where).model_dump(mode="json"),
        training=_checked(TrainingOptions, training, "training", where),
    )


def _read(path: Path) -> _File:
    content = read_yaml(path)
    try:
        return _File.model_validate(content)
    except ValidationError as error:
        raise _complaint(error, _File, "", str(path), UnreadableFileError) from None


def _choose(entry: Entry, file: _File, split: str, size: str) -> tuple[str, _Part]:
    """Return the recipe for a split and size, ``*`` standing for any split."""
    for name in (f"{split}/{size}", f"{ANY}/{size}"):
        if name in file.recipes:
            return f"{split}/{size}", file.recipes[name]
    if not file.recipes:
        return f"{split}/{size}", _Part()
    raise UsageError(
        f"{entry.name} has no recipe {f'{split}/{size}'!r}",
        where="--split, --size, --recipe",
        fix=_closest(f"{split}/{size}", file.recipes),
    )


def _closest(wanted: str, known: Iterable[str]) -> str:
    """Return what to do without a recipe: the nearest of the same split, or one's own."""
    names = sorted(known)
    own = [name for name in names if name.split("/")[0] == wanted.split("/")[0]]
    write = "write your own: --recipe FILE.yaml, see docs/baselines.md"
    return f"{nearest(wanted, own)}; or {write}" if own else f"{write}; known: {', '.join(names)}"


def _merge(below: Layer, above: Layer) -> Layer:
    """Return two layers joined; mappings are joined key by key."""
    joined = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(joined.get(key), Mapping)
        joined[key] = _merge(joined[key], dict(value)) if both else value
    for key, other in (("steps", "epochs"), ("epochs", "steps")):
        if above.get(key) is not None and above.get(other) is None:
            joined.pop(other, None)
    return joined


def _setting(text: str) -> tuple[str, Layer]:
    """Return group and changes of a text such as ``training.schedule.every=100``."""
    key, equals, value = text.partition("=")
    group, *path = key.strip().split(".")
    if not equals or not path or group not in ("model", "training"):
        raise UsageError(
            "cannot understand the setting",
            where="--set",
            expected="model.KEY=VALUE or training.KEY=VALUE",
            got=text,
        )
    try:
        layer: Any = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise UsageError(
            "the value is no YAML", where=f"--set {key}", got=" ".join(str(error).split())
        ) from None
    for name in reversed(path):
        layer = {name: layer}
    return group, layer


def _checked(options: type[Checked], values: Layer, group: str, where: str) -> Checked:
    try:
        return options.model_validate(values)
    except ValidationError as error:
        raise _complaint(error, options, group, where, UsageError) from None


def _complaint(
    error: ValidationError, options: type[BaseModel], group: str, where: str, kind: type[LagbenchError]
) -> LagbenchError:
    """Return the first thing that is wrong with options, with the nearest key for an unknown one."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in (group, *first["loc"]) if part != "")
    if first["type"] == "extra_forbidden":
        known = _fields(options, first["loc"][:-1])
        return kind(f"unknown key {key!r}", where=where, fix=nearest(str(first["loc"][-1]), known))
    return kind(f"{key} does not fit", where=where, expected=first["msg"], got=repr(first["input"])[:80])


def _fields(options: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the keys of options, or of those nested below a path."""
    for step in path:
        field = options.model_fields.get(str(step))
        inner = field.annotation if field else None
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            options = inner
        elif step == "recipes" or options is _File:
            options = _Part
    return list(options.model_fields)
