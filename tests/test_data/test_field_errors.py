"""No message of pydantic reaches users: its errors are told in our words."""

from __future__ import annotations

import ast
import importlib
import os
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from uuid import UUID

import pytest
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core.core_schema import ErrorType

import lagbench
from lagbench.data.field_errors import (
    EXPECTATIONS,
    OTHER,
    PATTERN_WORDS,
    describe_expectation,
    describe_input,
)

PACKAGE = Path(lagbench.__file__).parent

CONTEXT = (
    "gt",
    "ge",
    "lt",
    "le",
    "multiple_of",
    "min_length",
    "max_length",
    "expected",
    "error",
    "expected_schemes",
)
"""What pydantic adds to its errors, as far as the table asks for it."""


class Inner(BaseModel):
    """A mapping with one key."""

    model_config = ConfigDict(extra="forbid")

    key: int


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (int, "many", "a whole number"),
        (int, 1.5, "a whole number"),
        (int, [], "a whole number"),
        (int, "9" * 5000, "a whole number with fewer digits"),
        (float, "many", "a number"),
        (Sequence[str], "x,y", "a list in brackets"),
        (Sequence[str], 3, "a list in brackets"),
        (Mapping[str, int], [], "keys with values"),
        (float, None, "a number"),
        (Annotated[float, Field(allow_inf_nan=False)], "nan", "a finite number"),
        (Annotated[int, Field(gt=0)], 0, "a number greater than 0"),
        (Annotated[int, Field(ge=1)], 0, "a number not less than 1"),
        (Annotated[int, Field(lt=1)], 1, "a number less than 1"),
        (Annotated[int, Field(le=1)], 2, "a number not greater than 1"),
        (bool, "maybe", "true or false"),
        (str, 3, "a text"),
        (Annotated[str, Field(min_length=2)], "a", "a text of at least 2 characters"),
        (Annotated[str, Field(min_length=1)], "", "a text of at least 1 character"),
        (Annotated[str, Field(pattern="^a$")], "b", OTHER),
        (Annotated[str, Field(pattern="^[0-9a-f]{64}$")], "b", "64 hexadecimal digits"),
        (list[int], 3, "a list in brackets"),
        (tuple[int, ...], "3", "a list in brackets"),
        (Annotated[list[int], Field(min_length=2)], [1], "a list of at least 2 values"),
        (
            Annotated[list[int], Field(max_length=1)],
            [1, 2],
            "a list of at most 1 value",
        ),
        (
            Annotated[dict[str, int], Field(min_length=1)],
            {},
            "a mapping of at least 1 value",
        ),
        (dict[str, int], 3, "keys with values"),
        (Inner, 3, "keys with values"),
        (Inner, {}, "a value of this key"),
        (Inner, {"key": 1, "more": 2}, "no such key"),
        (Literal["a", "b"], "c", "'a' or 'b'"),
        (date, "soon", "a date, as in 2026-01-31"),
        (set[int], [[]], "a whole number"),
        (UUID, "3", OTHER),
    ],
)
def test_errors_of_pydantic_are_described_in_our_words(
    kind: object, value: object, expected: str
) -> None:
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(kind).validate_python(value)
    assert describe_expectation(caught.value.errors()[0]) == expected


@pytest.mark.parametrize("kind", get_args(ErrorType))
def test_no_description_has_the_words_of_pydantic(kind: str) -> None:
    """The sentence for a type that the table does not have is ours too."""
    if kind in {"value_error", "assertion_error"}:  # these are sentences of ours
        return
    context = dict.fromkeys(CONTEXT, 3)
    detail: Any = {
        "type": kind,
        "loc": (),
        "msg": "Input should be pydantic's",
        "input": None,
        "ctx": context | {"pattern": "^[0-9a-f]{64}$"},
    }
    expectation = describe_expectation(detail)
    assert expectation
    assert "pydantic" not in expectation
    if kind not in EXPECTATIONS and kind != "string_pattern_mismatch":
        assert expectation == OTHER


def test_each_pattern_has_words() -> None:
    """Users of the registry saw regular expressions."""
    patterns = set()
    for folder, _, names in os.walk(PACKAGE, followlinks=True):
        for name in names:
            if name.endswith(".py"):
                patterns |= patterns_in(Path(folder, name))
    assert len(patterns) > 10
    assert patterns == set(PATTERN_WORDS)


def patterns_in(path: Path) -> set[str]:
    """Return the patterns of a module's fields, those with names included."""
    module = path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    patterns = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.keyword) or node.arg != "pattern":
            continue
        if isinstance(node.value, ast.Constant):
            patterns.add(str(node.value.value))
        elif isinstance(node.value, ast.Name):
            names = vars(importlib.import_module(f"lagbench.{module}"))
            patterns.add(names[node.value.id])
    return patterns


def test_the_value_of_a_missing_key_is_not_the_whole_file() -> None:
    with pytest.raises(ValidationError) as caught:
        Inner.model_validate({})
    assert describe_input(caught.value.errors()[0]) == "no such key"


def test_a_value_with_thousands_of_digits_is_described_by_its_bits() -> None:
    """Python would raise an error over its digits."""
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(str).validate_python(10**5000)
    assert describe_input(caught.value.errors()[0]) == "a whole number of 16610 bits"


def test_no_module_but_the_table_reads_messages_of_pydantic() -> None:
    """The only ``["msg"]`` of the package stands in the table's module."""
    readers = set()
    for folder, _, names in os.walk(PACKAGE, followlinks=True):
        for name in names:
            if not name.endswith(".py"):
                continue
            path = Path(folder, name)
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Constant) and node.value == "msg":
                    readers.add(path.relative_to(PACKAGE).as_posix())
    assert readers == {"data/field_errors.py"}
