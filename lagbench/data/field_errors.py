"""What is wrong with the fields of a file that pydantic checks."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

MOST_FAULTS = 10


def describe_faults(error: ValidationError) -> str:
    """Return key, pydantic's message and value of each wrong field, on lines."""
    lines = []
    for detail in error.errors(include_url=False)[:MOST_FAULTS]:
        key = ".".join(str(part) for part in detail["loc"])
        value = describe_value(detail["input"])
        lines.append(f"{key or '(whole file)'}: {detail['msg']} (got {value})")
    return "\n    ".join(lines)


def describe_value(value: object) -> str:
    """Return a value of a file, shortened."""
    return ascii(value)[:80]
