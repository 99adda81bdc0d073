"""What a field of a file or of options should hold, in our words.

pydantic checks these fields. Its messages are for developers ("Input should be a valid
integer, unable to parse string as an integer"). This table replaces them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lagbench.errors import format_count

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

EXPECTATIONS = {
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_parsing_size": "a whole number with fewer digits",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "greater_than": "a number greater than {gt}",
    "greater_than_equal": "a number not less than {ge}",
    "less_than": "a number less than {lt}",
    "less_than_equal": "a number not greater than {le}",
    "multiple_of": "a multiple of {multiple_of}",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "a text",
    "string_sub_type": "a text",
    "string_unicode": "a text in UTF-8",
    "string_too_short": "a text of at least {min_characters}",
    "string_too_long": "a text of at most {max_characters}",
    "bytes_type": "bytes",
    "list_type": "a list in brackets",
    "tuple_type": "a list in brackets",
    "set_type": "a list in brackets",
    "frozen_set_type": "a list in brackets",
    "iterable_type": "a list in brackets",
    "sequence_str": "a list in brackets",
    "too_short": "a {collection} of at least {min_values}",
    "too_long": "a {collection} of at most {max_values}",
    "dict_type": "keys with values",
    "mapping_type": "keys with values",
    "model_type": "keys with values",
    "model_attributes_type": "keys with values",
    "dataclass_type": "keys with values",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "none_required": "null",
    "missing": "a value of this key",
    "missing_argument": "a value of this key",
    "extra_forbidden": "no such key",
    "unexpected_keyword_argument": "no such key",
    "json_invalid": "JSON; reading it fails: {error}",
    "json_type": "JSON",
    "date_type": "a date, as in 2026-01-31",
    "date_parsing": "a date, as in 2026-01-31",
    "date_from_datetime_parsing": "a date, as in 2026-01-31",
    "date_from_datetime_inexact": "a date, as in 2026-01-31",
    "datetime_type": "a date with its time",
    "datetime_parsing": "a date with its time",
    "datetime_from_date_parsing": "a date with its time",
    "url_type": "an address, as in https://host/path",
    "url_parsing": "an address, as in https://host/path",
    "url_scheme": "an address that begins with {expected_schemes}",
}
"""What was expected, by the type of pydantic's error.

Words in braces come from its context; counts have their nouns.
"""

OTHER = "a value of another type or form"
"""What was expected, where the table has no words for it."""

PATTERN_WORDS = {
    r"^[0-9a-f]{64}$": "64 hexadecimal digits",
    r"^[0-9a-f]{16}$": "16 hexadecimal digits",
    r"^[1-9]\d*\.\d+\.\d+$": "a version, as in 1.0.0",
    r"^[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}$": "a version, as in 1.0.0",
    r"^https?://[^\s/]\S*$": "an http:// or https:// address, without spaces",
    r"^https?://[A-Za-z0-9][!#-&(-;=?-\[\]_a-z~]*$": (
        "an http:// or https:// address, without spaces and quotes"
    ),
    r"^[a-z0-9]+(-[a-z0-9]+)*$": (
        "small letters, digits and single hyphens, as in my-model"
    ),
    r"^[a-z0-9]+(-[a-z0-9]+)*(/[a-z0-9]+(-[a-z0-9]+)*){2}$": (
        "split, size and method of an entry, as in cavity/mini/gns"
    ),
    r"^[a-z0-9_]+$": "small letters, digits and underscores",
    r"^[a-z0-9_]{1,60}$": "1 to 60 small letters, digits and underscores",
    r"^[a-z][a-z0-9_-]*$": (
        "small letters, digits, underscores and hyphens; a letter first"
    ),
    r"^[a-z][a-z0-9_-]{0,63}$": (
        "1 to 64 small letters, digits, underscores and hyphens; a letter first"
    ),
    r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$": (
        "1 to 64 letters, digits, dots, underscores and hyphens; a letter or digit "
        "first"
    ),
    r"^[A-Za-z0-9._/*-]{1,100}$": "1 to 100 letters, digits and characters of ._/*-",
    r"^[!-~]{1,200}$": "1 to 200 characters of ASCII, without blanks",
    r"^[ -~]{1,100}$": "1 to 100 characters of ASCII",
    r"^[ -~]{1,1000}$": "1 to 1000 characters of ASCII",
}
"""Our patterns in words: people do not read regular expressions."""


CLASS_WORDS = {"Sequence": "a list in brackets", "Mapping": "keys with values"}
"""What an object of a class is called in a file."""


def describe_expectation(detail: ErrorDetails) -> str:
    """Return what was expected where pydantic found something else.

    Where a validator of ours found it, this is the validator's own sentence.

    >>> describe_expectation({"type": "int_parsing", "loc": (), "msg": "", "input": ""})
    'a whole number'
    """
    if is_own_sentence(detail):
        return detail["msg"].partition(", ")[2]
    context = detail.get("ctx", {})
    if detail["type"] == "string_pattern_mismatch":
        return PATTERN_WORDS.get(context["pattern"], OTHER)
    if detail["type"] == "is_instance_of":
        return CLASS_WORDS.get(context.get("class", ""), OTHER)
    words = {**context, "collection": "list"}
    if context.get("field_type") == "Dictionary":
        words["collection"] = "mapping"
    for end in ("min", "max"):
        count = context.get(f"{end}_length")
        if isinstance(count, int):
            words[f"{end}_values"] = format_count(count, "value")
            words[f"{end}_characters"] = format_count(count, "character")
    return EXPECTATIONS.get(detail["type"], OTHER).format_map(words)


def describe_input(detail: ErrorDetails) -> str:
    """Return what pydantic found, shortened."""
    if detail["type"] in {"missing", "missing_argument"}:
        return "no such key"
    return describe_value(detail["input"])


def describe_value(value: object) -> str:
    """Return a value of a file, shortened; of a list and the like only the class."""
    if isinstance(value, np.generic):
        value = value.item()
    # Python prints no thousands of digits.
    if isinstance(value, int) and value.bit_length() > 256:
        return f"a whole number of {value.bit_length()} bits"
    if value is None or isinstance(value, str | bytes | int | float):
        return ascii(value)[:80]
    return f"a {type(value).__name__}"


def is_own_sentence(detail: ErrorDetails) -> bool:
    """Return whether a validator of ours found the error and said what is wrong."""
    return detail["type"] in {"value_error", "assertion_error"}
