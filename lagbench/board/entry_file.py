"""Read and write the YAML file of an entry; whatever a stranger put there stays text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from lagbench.data.yamlfile import read_yaml
from lagbench.errors import ChecksFailedError, UnreadableFileError, nearest
from lagbench.submission.findings import quoted

from .entry import PATTERNS, Entry

__all__ = ["MAX_ENTRY_BYTES", "Mistake", "examine", "load_plain", "read_entry", "spell_entry"]

MAX_ENTRY_BYTES = 64_000
"""Longest YAML file of an entry [bytes]; twenty seeds and all metrics take half of it."""

MOST_MISTAKES = 20
"""Mistakes of one file that are told."""

WIDTH = 110

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """One thing in an entry that does not fit the schema."""

    where: str  # key, as in "predictions.0.url"
    what: str  # what is wrong
    got: str  # what stands there, shortened and escaped
    fix: str | None = None  # the nearest known key where one is unknown, else None

    def __str__(self) -> str:
        """Return the mistake as one line."""
        return f"{self.where}: {self.what}; got {self.got}" + (f"; {self.fix}" if self.fix else "")


def load_plain(path: Path) -> Any:  # noqa: ANN401
    """Return what a YAML file of a submitter holds, after looking at its length."""
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
    return None, tuple(_mistake(kind, it["loc"], it["type"], _said(it), it["input"]) for it in told)


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


def spell_entry(entry: Entry) -> bytes:
    """Return an entry as the bytes of its YAML file; equal entries give equal bytes."""
    text = yaml.dump(
        entry.plain(),
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        width=WIDTH,
        default_flow_style=None,
    )
    return text.encode()


class _Dumper(yaml.SafeDumper):
    """Writes twice what stands twice; our reader refuses aliases."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _mistake(
    kind: type[BaseModel], place: tuple[int | str, ...], code: str, message: str, given: object
) -> Mistake:
    where = quoted(".".join(map(str, place)))[1:-1] or "the file"
    if code == "extra_forbidden":
        known = _fields(kind, place[:-1])
        return Mistake(
            where=where, what="unknown key", got=quoted(given), fix=nearest(str(place[-1])[:100], known)
        )
    if code == "missing":
        return Mistake(where=where, what="this key is missing", got="no such key")
    return Mistake(where=where, what=message, got=quoted(given))


def _said(item: ErrorDetails) -> str:
    """Return what is wrong in words, without a regular expression."""
    wanted = PATTERNS.get(item.get("ctx", {}).get("pattern", ""))
    return item["msg"].removeprefix("Value error, ") if wanted is None else f"is not {wanted}"


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
