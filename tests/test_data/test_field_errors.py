"""No message of pydantic reaches users: its errors are told in our words."""

from __future__ import annotations

import ast
import os
from datetime import date
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

import lagbench
from lagbench.data.field_errors import describe_expectation, describe_input

PACKAGE = Path(lagbench.__file__).parent


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
        (float, None, "a number"),
        (Annotated[float, Field(allow_inf_nan=False)], "nan", "a finite number"),
        (Annotated[int, Field(gt=0)], 0, "a number greater than 0"),
        (Annotated[int, Field(ge=1)], 0, "a number not less than 1"),
        (Annotated[int, Field(lt=1)], 1, "a number less than 1"),
        (Annotated[int, Field(le=1)], 2, "a number not greater than 1"),
        (bool, "maybe", "true or false"),
        (str, 3, "a text"),
        (Annotated[str, Field(min_length=2)], "a", "a text of at least 2 characters"),
        (Annotated[str, Field(pattern="^a$")], "b", "a text of the form ^a$"),
        (list[int], 3, "a list in brackets"),
        (tuple[int, ...], "3", "a list in brackets"),
        (Annotated[list[int], Field(min_length=2)], [1], "at least 2 values"),
        (Annotated[list[int], Field(max_length=1)], [1, 2], "at most 1 values"),
        (dict[str, int], 3, "keys with values"),
        (Inner, 3, "keys with values"),
        (Inner, {}, "a value of this key"),
        (Inner, {"key": 1, "more": 2}, "no such key"),
        (Literal["a", "b"], "c", "'a' or 'b'"),
        (date, "soon", "a date, as in 2026-01-31"),
    ],
)
def test_an_error_is_told_in_our_words(
    kind: object, value: object, expected: str
) -> None:
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(kind).validate_python(value)
    assert describe_expectation(caught.value.errors()[0]) == expected


def test_the_value_of_a_missing_key_is_not_the_whole_file() -> None:
    with pytest.raises(ValidationError) as caught:
        Inner.model_validate({})
    assert describe_input(caught.value.errors()[0]) == "no such key"


def test_a_value_with_thousands_of_digits_is_told() -> None:
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
