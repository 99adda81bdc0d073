"""The changes of a recipe by a training, from the log or the weights of the training.

Both may come from a stranger. Options that are unknown here are passed over.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import yaml

from lagbench.errors import LagbenchError

from .catalogue import find
from .recipe import (
    ANY,
    LATER_OPTIONS,
    Recipe,
    change_options,
    recipe_for,
    recipe_names,
)

# options that do not change the learned weights' meaning, or are told elsewhere
UNLISTED = ("seed", "compile", "log_every", "checkpoint_every")
LONGEST_VALUE = 200  # letters of a value; longer ones become dots
_NOT_SET = object()  # stands for an option that a recipe does not state


def list_settings(recipe: object) -> tuple[str, ...]:
    """Return the changes of a shipped recipe, in the form of ``--set``.

    ``recipe`` is the recipe of a log. Where it names no shipped recipe, there are none.
    """
    if not isinstance(recipe, Mapping):
        return ()
    shipped = _find_shipped_recipe(recipe)
    if shipped is None:
        return ()
    shipped_options = {
        "model": shipped.model,
        "training": shipped.training.model_dump(mode="json"),
    }
    settings = []
    for key, value in _find_changes(shipped_options, recipe, LATER_OPTIONS):
        settings.append(f"{key}={_format_yaml(value)}")
    return tuple(sorted(settings))


def list_effective_settings(
    baseline: str, options: Mapping[str, Any], settings: Sequence[str]
) -> tuple[str, ...]:
    """Return the settings of a prediction that change the model, in one form and order.

    A setting that states the value of the weights' own recipe, or of its default,
    changes nothing and is left out. If the model refuses one setting, the result is
    empty: nobody can predict with them. Settings of a model that is not installed are
    returned as they are written.

    Args:
        baseline: name of the baseline in the weights.
        options: options of the model in the weights.
        settings: settings of the prediction, as in ``model.average=true``.
    """
    try:
        entry = find(baseline)
        before = change_options(entry, options, ())
    except LagbenchError:
        return tuple(sorted(set(settings)))
    try:
        after = change_options(entry, options, settings)
    except LagbenchError:
        return ()
    changes = []
    for name, value in after.items():
        if value != before[name]:
            changes.append(f"model.{name}={json.dumps(value, sort_keys=True)}")
    return tuple(sorted(changes))


def find_refusal(
    baseline: str, options: Mapping[str, Any], settings: Sequence[str]
) -> str | None:
    """Return why a model does not take the settings of a prediction, None if it does.

    None also where nobody can say: the model is not installed, or has other options
    than the weights state.

    Args:
        baseline: name of the baseline in the weights.
        options: options of the model in the weights.
        settings: settings of the prediction, as in ``model.average=true``.
    """
    try:
        entry = find(baseline)
        change_options(entry, options, ())
    except LagbenchError:
        return None
    try:
        change_options(entry, options, settings)
    except LagbenchError as error:
        return f"{error.what}: {error.got}"
    return None


def _find_shipped_recipe(recipe: Mapping[str, Any]) -> Recipe | None:
    """Return the shipped recipe that a log names; None where there is none."""
    split, _, size_name = str(recipe.get("name")).partition("/")
    size, _, variant = size_name.partition("-")
    names = {f"{split}/{size_name}", f"{ANY}/{size_name}"}
    try:
        entry = find(str(recipe.get("baseline")))
        if names.isdisjoint(recipe_names(entry)):
            return None
        return recipe_for(entry, split, size, variant=variant or None)
    except LagbenchError:
        return None


def describe_changes(recipe: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the changes of a recipe, and the weights of its start if it has any."""
    changes = list_settings(recipe)
    start = describe_start(recipe.get("start"))
    if start:
        return (*changes, f"started from {start}")
    return changes


def describe_start(start: Mapping[str, Any] | None) -> str:
    """Return recipe and hash of the weights of a start; nothing for random ones."""
    if start:
        return f"{start['recipe']}, weights {start['sha256'][:12]}"
    return ""


def first_difference(expected: Mapping[str, Any], logged: object) -> str:
    """Return the first key whose value differs, with both values.

    Where nothing differs, the text says so. If one of the two lacks an option of
    :data:`LATER_OPTIONS`, its value there counts.
    """
    if not isinstance(logged, Mapping):
        logged = {}
    whole_expected = _fill_later_options(expected, logged)
    whole_logged = _fill_later_options(logged, expected)
    return _describe_difference(whole_expected, whole_logged)


def _fill_later_options(
    recipe: Mapping[str, Any], other: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a recipe with those options that only the other one states."""
    filled = dict(recipe)
    for group, defaults in LATER_OPTIONS.items():
        options = recipe.get(group)
        other_options = other.get(group)
        if not isinstance(options, Mapping) or not isinstance(other_options, Mapping):
            continue
        filled_options = dict(options)
        for name in other_options:
            if name in defaults:
                filled_options.setdefault(name, defaults[name])
        filled[group] = filled_options
    return filled


def _describe_difference(
    expected: Mapping[str, Any], logged: Mapping[str, Any], path: str = ""
) -> str:
    """Return the first key whose value differs, below a path, with both values."""
    for key in sorted({*expected, *logged}):
        expected_value = expected.get(key, _NOT_SET)
        logged_value = logged.get(key, _NOT_SET)
        if expected_value == logged_value:
            continue
        if isinstance(expected_value, Mapping) and isinstance(logged_value, Mapping):
            return _describe_difference(expected_value, logged_value, f"{path}{key}.")
        return (
            f"{path}{key} = {_describe_value(expected_value)}, as asked for; the "
            f"folder has {_describe_value(logged_value)}"
        )
    return "the same recipe"


def _describe_value(value: object) -> str:
    return "not set" if value is _NOT_SET else repr(value)


def _find_changes(
    shipped: Mapping[str, Any],
    logged: object,
    defaults: Mapping[str, Any],
    path: str = "",
) -> Iterator[tuple[str, Any]]:
    """Yield paths such as model.loss.vorticity and the values of a log that differ.

    ``defaults`` are the values of options that the log lacks.
    """
    if not isinstance(logged, Mapping):
        return
    for key, shipped_value in shipped.items():
        value = logged.get(key, defaults.get(key, shipped_value))
        if isinstance(shipped_value, Mapping):
            inner_defaults = defaults.get(key, {})
            yield from _find_changes(
                shipped_value, value, inner_defaults, f"{path}{key}."
            )
        elif key not in UNLISTED and value != shipped_value:
            yield f"{path}{key}", value


def _format_yaml(value: object) -> str:
    """Return a value as a line of YAML; quote a text that YAML would read otherwise."""
    if not isinstance(value, str) or not value.isascii() or not value.isprintable():
        text = json.dumps(value)
    elif _is_plain_yaml(value):
        text = value
    else:
        text = json.dumps(value)
    if len(text) > LONGEST_VALUE:
        return "..."
    return text


def _is_plain_yaml(text: str) -> bool:
    """Return whether YAML reads a text without quotes as that text."""
    if len(text) > LONGEST_VALUE:
        return True
    try:
        return bool(yaml.safe_load(text) == text)
    except (yaml.YAMLError, ValueError):  # ValueError: it looks like a date and is none
        return False
