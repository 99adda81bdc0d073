"""Check the arguments of the public functions by their annotations, in one way.

>>> @check_arguments
... def draw(split: str, frame: int = 0) -> None: ...
>>> draw("cavity", frame="3")
Traceback (most recent call last):
    ...
lagbench.errors.UsageError: frame is of a wrong kind
  where: draw, frame
  expected: a whole number
  got: '3'
  fix: give a number without quotes: frame=3
"""

from __future__ import annotations

import functools
import inspect
import numbers
import operator
import os
import re
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from .errors import UsageError

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

ALIASES = {
    "Scenarios": "str | Iterable[int] | None",
    "Selection": "str | Sequence[str] | None",
    "Step": "Callable",
}
"""Annotations that stand for others."""

_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?(e[+-]?[0-9]+)?")

UNCHECKED = frozenset({"Any", "ArrayLike", "OwnMetrics", "object"})
"""Annotations that take any value, or whose values the function itself checks."""


@dataclass(frozen=True)
class ArgumentKind:
    """What a value may be."""

    description: str  # as in "expected: a whole number"
    accepts: Callable[[object], bool]
    example: str  # as it is typed


def _is_whole(value: object) -> bool:
    """Tell whether a value counts; True and False do not, although Python adds them."""
    if isinstance(value, bool):
        return False
    try:
        operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return False
    return True


def _is_number(value: object) -> bool:
    """Tell whether a value is one real number, also one of NumPy."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _is_truth(value: object) -> bool:
    # that of NumPy by its name: this module loads no NumPy
    return type(value).__name__ in ("bool", "bool_")


def _is_list(value: object) -> bool:
    """Tell whether a value has items; the letters of a text are none."""
    return isinstance(value, Iterable) and not isinstance(value, str | bytes)


PLAIN_KINDS = {
    "str": ArgumentKind("a text", lambda value: isinstance(value, str), '"..."'),
    "Path": ArgumentKind(
        "a path", lambda value: isinstance(value, os.PathLike), '"..."'
    ),
    "int": ArgumentKind("a whole number", _is_whole, "2"),
    "float": ArgumentKind("a number", _is_number, "0.5"),
    "bool": ArgumentKind("True or False", _is_truth, "True"),
    "None": ArgumentKind("None", lambda value: value is None, "None"),
    "Callable": ArgumentKind("a function", callable, "function"),
}
"""Kinds of single values, by their annotations."""

LISTS = {
    "Collection": Collection,
    "Iterable": Iterable,
    "Sequence": Sequence,
}
"""Kinds of several values, by their annotations."""

PLURALS = {
    "str": "texts",
    "int": "whole numbers",
    "float": "numbers",
    "Path": "paths",
    "Callable": "functions",
}


def check_arguments(
    function: Callable[Parameters, Result],
) -> Callable[Parameters, Result]:
    """Decorate a function so that it refuses arguments of a wrong kind.

    What an argument may be follows from its annotation. Whether a value of the right
    kind fits, the function checks itself. Arguments that are missing or that it does
    not have raise the TypeError of Python, and so does ``**options``' own check.

    Raises:
        UsageError: by the decorated function, for an argument of a wrong kind.
    """
    signature = inspect.signature(function)
    annotations: dict[str, str] = {}
    for parameter in signature.parameters.values():
        is_variable = parameter.kind in (
            inspect.Parameter.VAR_KEYWORD,
            inspect.Parameter.VAR_POSITIONAL,
        )
        is_annotated = parameter.annotation is not inspect.Parameter.empty
        if is_annotated and not is_variable:
            annotations[parameter.name] = str(parameter.annotation)
    is_constructor = function.__name__ == "__init__"

    @functools.wraps(function)
    def checked(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError:
            # Python's own message names the function.
            return function(*args, **kwargs)
        place = function.__name__
        if is_constructor:
            # of the class that the user called, which may have inherited it
            place = type(args[0]).__name__
        for name, value in bound.arguments.items():
            if name in annotations:
                check_argument(name, value, annotations[name], where=place)
        return function(*args, **kwargs)

    return checked


def check_argument(name: str, value: object, annotation: str, *, where: str) -> None:
    """Refuse a value that its annotation does not allow.

    Args:
        name: name of the argument.
        value: what the user gave.
        annotation: as it is written in the function, as in "str | Path | None".
        where: name of the function.

    Raises:
        UsageError: a value of a wrong kind, or a list with one.
    """
    members = list_members(annotation)
    if any(member in UNCHECKED for member in members):
        return
    kinds = [find_kind(member) for member in members]
    accepted_by = None
    for member, kind in zip(members, kinds, strict=True):
        if kind.accepts(value):
            accepted_by = member
            break
    if accepted_by is None:
        raise UsageError(
            f"{name} is of a wrong kind",
            where=f"{where}, {name}",
            expected=" or ".join(kind.description for kind in kinds),
            got=reprlib.repr(value),
            fix=_suggest_value(name, value, members),
        )
    item_kinds = _item_kinds(accepted_by)
    if item_kinds and isinstance(value, Collection) and not isinstance(value, Mapping):
        for item in value:
            if not any(kind.accepts(item) for kind in item_kinds):
                raise UsageError(
                    f"{name} holds a value of a wrong kind",
                    where=f"{where}, {name}",
                    expected=find_kind(accepted_by).description,
                    got=f"{reprlib.repr(item)} in it",
                    fix="leave that value out, or mend it",
                )


def list_members(annotation: str) -> list[str]:
    """Return the members of a union, aliases resolved.

    >>> list_members("str | Sequence[str | Path] | None")
    ['str', 'Sequence[str | Path]', 'None']
    """
    members = []
    depth = 0
    begin = 0
    for place, character in enumerate(f"{annotation}|"):
        if character == "[":
            depth += 1
        elif character == "]":
            depth -= 1
        elif character == "|" and depth == 0:
            member = annotation[begin:place].strip()
            begin = place + 1
            if ALIASES.get(member, member) != member:
                members += list_members(ALIASES[member])
            else:
                members.append(member)
    return members


def find_kind(member: str) -> ArgumentKind:
    """Return the kind of a member of a union; of an unknown name, that of a class."""
    head, _, items = member.partition("[")
    if head in PLAIN_KINDS:
        return PLAIN_KINDS[head]
    if head in LISTS:
        nouns = []
        for item in list_members(items.removesuffix("]")):
            item_head = item.partition("[")[0]
            nouns.append(PLURALS.get(item_head, f"{item_head} objects"))
        return ArgumentKind(f"a list of {' or '.join(nouns)}", _is_list, "[...]")
    if head == "Mapping":
        return ArgumentKind(
            "a dictionary", lambda value: isinstance(value, Mapping), "{...}"
        )

    name = head.rpartition(".")[2]

    def is_instance(value: object) -> bool:
        # by name: its module need not be loaded, nor be known here
        return any(parent.__name__ == name for parent in type(value).__mro__)

    return ArgumentKind(f"an object of the class {name}", is_instance, f"{name}(...)")


def _item_kinds(member: str) -> list[ArgumentKind]:
    """Return the kinds of the items of a list of plain values; else none.

    What lists of other things may hold, their functions check.
    """
    head, _, items = member.partition("[")
    if head not in LISTS:
        return []
    kinds = []
    for item in list_members(items.removesuffix("]")):
        if item not in PLAIN_KINDS:
            return []
        kinds.append(PLAIN_KINDS[item])
    return kinds


def _suggest_value(name: str, value: object, members: Sequence[str]) -> str:
    """Return what a user can type in the place of a value of a wrong kind."""
    example = find_kind(members[0]).example
    is_numeric = "int" in members or "float" in members
    if is_numeric and isinstance(value, str):
        if _NUMBER.fullmatch(value):
            return f"give a number without quotes: {name}={value}"
        return f"give a number without quotes, as in {name}={example}"
    if "int" in members and _is_number(value):
        number: Any = value
        if float(number).is_integer():
            return f"write {name}={int(number)}, not {name}={number}"
    for member in members:
        if any(kind.accepts(value) for kind in _item_kinds(member)):
            return f"put it into brackets: {name}=[{reprlib.repr(value)}]"
    if "None" in members:
        return f"leave {name} out, or give such a value: {name}={example}"
    return f"give such a value: {name}={example}"
