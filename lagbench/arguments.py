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
  fix: give a whole number without quotes: frame=3
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import numbers
import operator
import os
import re
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

from .errors import UsageError, WrongCallError, suggest_name

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

ALIASES = {
    "Scenarios": "str | Iterable[int] | None",
    "Selection": "str | Sequence[str] | None",
    "Step": "Callable",
}
"""Annotations that stand for others."""

_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?(e[+-]?[0-9]+)?")

MAX_TYPED = 80
"""The most characters of a value that an advice repeats."""

MOST_NAME_BYTES = 255
"""The longest name of a file or folder on common disks [bytes]."""

MOST_PATH_BYTES = 4095
"""The longest path that Linux takes [bytes]."""

UNCHECKED = frozenset({"Any", "ArrayLike", "OwnMetrics", "object"})
"""Annotations that take any value, or whose values the function itself checks."""


@dataclass(frozen=True)
class ArgumentKind:
    """What a value may be."""

    description: str  # as in "expected: a whole number"
    accepts: Callable[[object], bool]
    example: str  # as it is typed
    items: tuple[ArgumentKind, ...] = ()  # of a list whose items are checked


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


def _is_iterable(value: object) -> bool:
    """Tell whether a value has items; the letters of a text are none."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        return False
    if not isinstance(value, Sized):
        # an iterator stays whole
        return True
    try:
        iter(value)
    except TypeError:
        # an array without axes
        return False
    return True


def _is_list(value: object) -> bool:
    """Tell whether a value has items that can be read more than once."""
    return isinstance(value, Sized) and _is_iterable(value)


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
    "Collection": _is_list,
    "Iterable": _is_iterable,
    "Sequence": _is_list,
}
"""What accepts several values, by their annotations."""

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

    What an argument may be follows from its annotation, which is read as text: the
    module needs ``from __future__ import annotations``. Whether a value of the right
    kind fits, the function checks itself, and so it does with ``**options``.

    Raises:
        UsageError: by the decorated function, for an argument of a wrong kind.
        WrongCallError: by the decorated function, for an argument that is missing, has
            an unknown name, or is given without its name, where it needs one.
    """
    signature = inspect.signature(function)
    kinds: dict[str, tuple[ArgumentKind, ...]] = {}
    for parameter in signature.parameters.values():
        is_variable = parameter.kind in (
            inspect.Parameter.VAR_KEYWORD,
            inspect.Parameter.VAR_POSITIONAL,
        )
        is_annotated = parameter.annotation is not inspect.Parameter.empty
        if is_annotated and not is_variable:
            kinds[parameter.name] = find_kinds(str(parameter.annotation))
    is_constructor = function.__name__ == "__init__"

    @functools.wraps(function)
    def checked(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        place = function.__name__
        parameters = list(signature.parameters.values())
        values: tuple[object, ...] = args
        if is_constructor:
            # of the class that the user called, which may have inherited it
            place = type(args[0]).__name__
            parameters = parameters[1:]
            values = args[1:]
        bound = None
        with contextlib.suppress(TypeError):
            bound = signature.bind(*args, **kwargs)
        if bound is None:
            check_call(parameters, values, kwargs, where=place)
            # Python's own message names the function.
            return function(*args, **kwargs)
        for name, value in bound.arguments.items():
            if name in kinds:
                check_argument(name, value, kinds[name], where=place)
        return function(*args, **kwargs)

    return checked


def check_call(
    parameters: Sequence[inspect.Parameter],
    values: Sequence[object],
    named_values: Mapping[str, object],
    *,
    where: str,
) -> None:
    """Refuse arguments that do not fit the parameters of a function.

    Args:
        parameters: those of the function, without ``self``.
        values: arguments without a name.
        named_values: arguments by name.
        where: name of the function or class.

    Raises:
        WrongCallError: an argument is unknown, given twice, missing, or has no name.
    """
    known_names = []
    names_in_order = []
    for parameter in parameters:
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            continue
        known_names.append(parameter.name)
        if parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD:
            names_in_order.append(parameter.name)
    takes_any_name = len(known_names) < len(parameters)

    for name, value in named_values.items():
        if name not in known_names and not takes_any_name:
            raise WrongCallError(
                f"{where}() has no argument {name}",
                where=f"{where}, {name}",
                expected="the name of an argument",
                got=f"{name}={_shorten(value)}",
                fix=suggest_name(name, known_names),
            )
    if len(values) > len(names_in_order):
        others = [name for name in known_names if name not in names_in_order]
        first_value = _shorten(values[len(names_in_order)])
        fix = "leave it out"
        if others:
            listing = ", ".join(f"{name}=" for name in others)
            fix = f"write its name before it, one of: {listing}"
        raise WrongCallError(
            "an argument needs its name",
            where=where,
            expected=f"without a name only {', '.join(names_in_order) or 'nothing'}",
            got=first_value,
            fix=fix,
        )
    for name, value in zip(names_in_order, values, strict=False):
        if name in named_values:
            raise WrongCallError(
                f"{name} is given twice",
                where=f"{where}, {name}",
                expected=f"one value of {name}",
                got=f"{_shorten(value)} and {name}={_shorten(named_values[name])}",
                fix="leave one of the two out",
            )
    given_names = {*names_in_order[: len(values)], *named_values}
    for parameter in parameters:
        has_default = parameter.default is not inspect.Parameter.empty
        is_needed = parameter.name in known_names and not has_default
        if is_needed and parameter.name not in given_names:
            raise WrongCallError(
                f"{parameter.name} is missing",
                where=f"{where}, {parameter.name}",
                expected=f"a value of {parameter.name}",
                got="nothing",
                fix=f"add {parameter.name}=...",
            )


def check_argument(
    name: str, value: object, kinds: Sequence[ArgumentKind], *, where: str
) -> None:
    """Refuse a value that is of no accepted kind.

    Args:
        name: name of the argument.
        value: what the user gave.
        kinds: accepted kinds; if there are none, every value is accepted.
        where: name of the function.

    Raises:
        UsageError: a value of a wrong kind, or a list with one.
    """
    if not kinds:
        return
    accepting = [kind for kind in kinds if kind.accepts(value)]
    if not accepting:
        raise UsageError(
            f"{name} is of a wrong kind",
            where=f"{where}, {name}",
            expected=" or ".join(kind.description for kind in kinds),
            got=_shorten(value),
            fix=_suggest_value(name, value, kinds),
        )
    kind = accepting[0]
    if PLAIN_KINDS["Path"] in kinds:
        _check_path(name, value, where=where)
    if isinstance(value, range):
        # all whole numbers, and perhaps more than there is time for
        return
    if kind.items and isinstance(value, Collection) and not isinstance(value, Mapping):
        for item in value:
            if not any(item_kind.accepts(item) for item_kind in kind.items):
                raise UsageError(
                    f"{name} holds a value of a wrong kind",
                    where=f"{where}, {name}",
                    expected=kind.description,
                    got=f"{_shorten(item)} in it",
                    fix="leave that value out, or correct it",
                )
            if PLAIN_KINDS["Path"] in kind.items:
                _check_path(name, item, where=where)


def _check_path(name: str, value: object, *, where: str) -> None:
    """Refuse the path of a file that no disk can hold; addresses have other limits.

    Raises:
        UsageError: the path is too long, or has a character that no name can have.
    """
    if not isinstance(value, str | os.PathLike):
        return
    path = os.fspath(value)
    if not isinstance(path, str) or "://" in path:
        return
    if not _can_name_file(path):
        raise UsageError(
            "no file can have that name",
            where=f"{where}, {name}",
            expected=f"names of at most {MOST_NAME_BYTES} bytes in a path of at most "
            f"{MOST_PATH_BYTES}, without zero characters and halves of characters",
            got=f"{_shorten(path)}, {len(path)} characters",
            fix="use another name",
        )


def _can_name_file(path: str) -> bool:
    r"""Say whether a file on a disk can have a path.

    >>> [_can_name_file(path) for path in ("runs/a.nc", "a\0.nc", "\ud83d")]
    [True, False, False]
    """
    if "\0" in path:
        return False
    try:
        encoded = path.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        # half of a character, which has no bytes
        return False
    longest_name = max(len(part) for part in encoded.split(b"/"))
    return longest_name <= MOST_NAME_BYTES and len(encoded) <= MOST_PATH_BYTES


def find_kinds(annotation: str) -> tuple[ArgumentKind, ...]:
    """Return the kinds that an annotation allows; none where it takes any value.

    >>> [kind.description for kind in find_kinds("str | Sequence[str] | None")]
    ['a text', 'a list of texts', 'None']
    """
    members = list_members(annotation)
    if any(member in UNCHECKED for member in members):
        return ()
    return tuple(find_kind(member) for member in members)


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
    """Return the kind of a member of a union.

    A name that is unknown here is taken for that of a class.
    """
    head, _, items = member.partition("[")
    if head in PLAIN_KINDS:
        return PLAIN_KINDS[head]
    if head in LISTS:
        nouns = []
        for item in list_members(items.removesuffix("]")):
            item_head = item.partition("[")[0]
            nouns.append(PLURALS.get(item_head, f"{item_head} objects"))
        return ArgumentKind(
            f"a list of {' or '.join(nouns)}", LISTS[head], "[...]", _item_kinds(member)
        )
    if head == "Mapping":
        return ArgumentKind(
            "a dictionary", lambda value: isinstance(value, Mapping), "{...}"
        )

    name = head.rpartition(".")[2]

    def is_instance(value: object) -> bool:
        # by name: its module need not be loaded, nor be known here
        return any(parent.__name__ == name for parent in type(value).__mro__)

    return ArgumentKind(f"an object of the class {name}", is_instance, f"{name}(...)")


def _item_kinds(member: str) -> tuple[ArgumentKind, ...]:
    """Return the kinds of the items of a list of plain values; else none.

    What lists of other things may hold, their functions check.
    """
    items = member.partition("[")[2].removesuffix("]")
    kinds = []
    for item in list_members(items):
        if item not in PLAIN_KINDS:
            return ()
        kinds.append(PLAIN_KINDS[item])
    return tuple(kinds)


def _suggest_value(name: str, value: object, kinds: Sequence[ArgumentKind]) -> str:
    """Return what a user can type in the place of a value of a wrong kind."""
    example = kinds[0].example
    takes_whole = PLAIN_KINDS["int"] in kinds
    takes_any_number = PLAIN_KINDS["float"] in kinds
    if isinstance(value, str) and (takes_whole or takes_any_number):
        noun = "a number" if takes_any_number else "a whole number"
        number = _read_number(value, whole=not takes_any_number)
        if number:
            return f"give {noun} without quotes: {name}={number}"
        return f"give {noun} without quotes, as in {name}={example}"
    if takes_whole and _is_number(value):
        number = _spell(_round_number(value))
        if number:
            return f"write {name}={number}, not {name}={_shorten(value)}"
    for kind in kinds:
        if any(item_kind.accepts(value) for item_kind in kind.items):
            return f"put it into brackets: {name}=[{_spell(value) or '...'}]"
    if _is_iterable(value) and any(kind.accepts is _is_list for kind in kinds):
        return f"make a list of it: {name}=list(...)"
    if PLAIN_KINDS["None"] in kinds:
        return f"leave {name} out, or give such a value: {name}={example}"
    return f"give such a value: {name}={example}"


def _read_number(text: str, *, whole: bool) -> str:
    """Return the number in a text, spelled as in Python.

    It is empty where the text is no number, and with ``whole`` where it has a fraction.
    """
    if len(text) > MAX_TYPED or not _NUMBER.fullmatch(text):
        return ""
    if re.fullmatch("-?[0-9]+", text):
        return _spell(int(text))
    number = float(text)
    return _spell(_round_number(number) if whole else number)


def _round_number(value: object) -> int | None:
    """Return a number as a whole one; None where it has a fraction or is infinite."""
    try:
        number = int(value)  # type: ignore[call-overload]
    except (OverflowError, ValueError):
        # infinity, or not a number
        return None
    return number if number == value else None


def _spell(value: object) -> str:
    """Return a number, a text or a path as it is typed; empty where it is too long."""
    text = ""
    if _is_whole(value):
        whole_number = operator.index(value)  # type: ignore[arg-type]
        if abs(whole_number) < 10**MAX_TYPED:
            text = str(whole_number)
    elif isinstance(value, float) and math.isfinite(value):
        text = repr(float(value))
    elif isinstance(value, str):
        text = repr(str(value))
    elif isinstance(value, os.PathLike):
        text = repr(os.fspath(value))
    return text if len(text) <= MAX_TYPED else ""


def _shorten(value: object) -> str:
    """Return what messages show of a value."""
    try:
        return reprlib.repr(value)
    except ValueError:
        # a whole number of more digits than Python prints
        return f"<{type(value).__name__} too long to print>"
