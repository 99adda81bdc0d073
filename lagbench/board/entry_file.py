"""Read and write YAML files of submitters; whatever a stranger put there stays text."""

from __future__ import annotations

import enum
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from lagbench.data.yamlfile import read_yaml, spell_yaml
from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError, nearest
from lagbench.submission.findings import quoted

from .entry import PATTERNS, Entry, Meta

__all__ = [
    "MAX_ENTRY_BYTES",
    "Mistake",
    "examine",
    "load_plain",
    "read_entry",
    "read_meta",
    "schema_bytes",
    "spell",
]

MAX_ENTRY_BYTES = 64_000
"""Longest YAML file of an entry [bytes]; twenty seeds and all metrics take half of it."""

MOST_MISTAKES = 20
"""Mistakes of one file that are told."""


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """One thing in a file that does not fit its schema."""

    where: str  # key, as in "predictions.0.url"
    what: str
    got: str  # what stands there, shortened and escaped
    fix: str | None = None  # the nearest known key where one is unknown

    def __str__(self) -> str:
        """Return the mistake as one line."""
        return f"{self.where}: {self.what}; got {self.got}" + (f"; {self.fix}" if self.fix else "")


Model = TypeVar("Model", bound=BaseModel)


def load_plain(path: Path) -> Any:  # noqa: ANN401
    """Return what a YAML file of a submitter holds, after looking at its kind and length."""
    try:
        regular, length = path.is_file(), path.stat().st_size
    except OSError as error:
        raise UnreadableFileError("cannot read the YAML file", where=str(path), got=error.strerror) from error
    if not regular or length > MAX_ENTRY_BYTES:
        raise UnreadableFileError(
            "not a YAML file of an entry",
            where=str(path),
            expected=f"a regular file of at most {MAX_ENTRY_BYTES} bytes",
            got=f"{length} bytes" if regular else "something that is no regular file",
            fix="describe the method in a few lines; predictions go elsewhere",
        )
    return read_yaml(path)


def examine(kind: type[Model], value: object) -> tuple[Model | None, tuple[Mistake, ...]]:
    """Return the model that a value describes, or what is wrong with it."""
    try:
        return kind.model_validate(value), ()
    except ValidationError as error:
        found = error.errors(include_url=False)
    # a list with a faulty member is said to be too short as well
    inner = {item["loc"][:depth] for item in found for depth in range(1, len(item["loc"]))}
    told = [item for item in found if item["loc"] not in inner][:MOST_MISTAKES]
    return None, tuple(_mistake(kind, item) for item in told)


def read_entry(path: Path) -> Entry:
    """Read the entry of a YAML file."""
    entry, mistakes = examine(Entry, load_plain(path))
    if entry is None:
        raise ChecksFailedError(
            f"{len(mistakes)} mistake(s) in an entry",
            where=str(path),
            got="\n    ".join(["", *map(str, mistakes)]),
            fix="mend the keys named above; docs/submitting.md describes them",
        )
    return entry


def read_meta(path: Path | None, options: Mapping[str, object]) -> Meta:
    """Return what a YAML file and options say; options win.

    Args:
        path: a YAML file, or None.
        options: keys of :class:`Meta` to values; None and empty ones are not given.

    Raises:
        UnreadableFileError: no regular file, too long, or no plain YAML.
        UsageError: an unknown key or a value that does not fit.
    """
    held = {} if path is None else load_plain(path)
    if not isinstance(held, dict):
        raise UsageError(
            "the file does not describe a method", where=str(path), expected="lines of key: value"
        )
    given = {key: value for key, value in options.items() if value not in (None, "", (), [])}
    meta, mistakes = examine(Meta, {**held, **given})
    if meta is None:
        raise UsageError(
            "what is said of the method does not fit",
            where="options" if path is None else f"{path}, or options",
            got="\n    ".join(["", *map(str, mistakes)]),
            fix="docs/submitting.md describes the keys",
        )
    return meta


def schema_bytes() -> bytes:
    """Return the JSON schema of an entry as the bytes of leaderboard/schema.json."""
    schema = Entry.model_json_schema()
    schema |= {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Entry of the lagbench leaderboard",
    }
    return f"{json.dumps(schema, indent=1, ensure_ascii=False)}\n".encode()


def spell(value: Any) -> bytes:  # noqa: ANN401
    """Return an entry, or plain values, as the bytes of a YAML file; equal ones give equal bytes."""
    if isinstance(value, Entry):
        held = value.model_dump(mode="python", exclude_defaults=True)
        value = {key: held[key] for key in Entry.ORDER if key in held}
    return spell_yaml(_plain(value), default_flow_style=None).encode()


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(held) for key, held in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(held) for held in value]
    return str(value) if isinstance(value, enum.Enum) else value


def _mistake(kind: type[BaseModel], item: ErrorDetails) -> Mistake:
    place, given = item["loc"], quoted(item["input"])
    where = quoted(".".join(map(str, place)))[1:-1] or "the file"
    if item["type"] == "extra_forbidden":
        fix = nearest(str(place[-1])[:100], _fields(kind, place[:-1]))
        return Mistake(where=where, what="unknown key", got=given, fix=fix)
    if item["type"] == "missing":
        return Mistake(where=where, what="this key is missing", got="no such key")
    wanted = PATTERNS.get(item.get("ctx", {}).get("pattern", ""))
    what = item["msg"].removeprefix("Value error, ") if wanted is None else f"is not {wanted}"
    return Mistake(where=where, what=what, got=given)


def _fields(kind: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """Return the keys known at a place of the schema."""
    for key in place:
        if isinstance(key, int) or key not in kind.model_fields:
            continue  # a position in a list, or a name in a mapping: the model is known already
        kind = _model_in(kind.model_fields[key].annotation) or kind
    return list(kind.model_fields)


def _model_in(annotation: object) -> type[BaseModel] | None:
    """Return the model that a type names, inside a tuple, mapping or option too."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for inner in get_args(annotation) if (found := _model_in(inner))), None)
