"""Read and write the YAML files of entries.

Strangers write these files: their kind and length are looked at before they are read,
and all that does not fit the schema is reported together.
"""

from __future__ import annotations

import enum
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from lagbench.data.checksums import file_sha256
from lagbench.data.field_errors import describe_expectation, is_own_sentence
from lagbench.data.yamlfile import format_yaml, read_yaml
from lagbench.errors import (
    ChecksFailedError,
    UnreadableFileError,
    UsageError,
    format_count,
    suggest_file,
    suggest_name,
)
from lagbench.scoring.boards import advise_board_check
from lagbench.submission.issues import quote

from .entry import Entry, Meta, Status, Weights
from .folder import Folder, Place, entry_path

MAX_ENTRY_BYTES = 64_000
"""Longest YAML file of an entry [bytes]; twenty seeds and all metrics take half of it.
"""

MOST_FILE_BYTES = 40_000_000
"""Longest file of a board that is hashed [bytes]; all weights have no more."""

ENTRY_FIX = "describe the method in a few lines; predictions go elsewhere"
"""What to do about a file that is no entry."""

MOST_ISSUES = 20  # issues of one file that are reported

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class SchemaIssue:
    """One place where a file does not fit its schema."""

    where: str  # key, as in "predictions.0.url"
    what: str
    got: str  # the value there, shortened and escaped
    fix: str | None = None  # the nearest known key where one is unknown

    def __str__(self) -> str:
        """Return the issue as one line."""
        line = f"{self.where}: {self.what}; got {self.got}"
        if self.fix:
            return f"{line}; {self.fix}"
        return line


def load_plain(
    path: Path,
    *,
    longest: int = MAX_ENTRY_BYTES,
    fix: str = "restore the file",
) -> Any:  # noqa: ANN401
    """Return the content of a YAML file of a leaderboard as plain values.

    Args:
        path: the file, which a stranger may have written.
        longest: the most that it may have [bytes].
        fix: what to do about a file that is too long, or no file.

    Raises:
        UnreadableFileError: no regular file, too long, or no plain YAML.
    """
    try:
        is_regular = path.is_file()
        length = path.stat().st_size
    except OSError as error:
        raise UnreadableFileError(
            "cannot read the YAML file",
            where=str(path),
            expected="a file that can be read",
            got=error.strerror,
            fix=suggest_file(path) or "check the path and that you may read the file",
        ) from error

    if is_regular and length <= longest:
        return read_yaml(path)
    if is_regular:
        got = f"{length} bytes"
    else:
        got = "something that is no regular file"
    raise UnreadableFileError(
        "not a YAML file of a leaderboard",
        where=str(path),
        expected=f"a regular file of at most {longest} bytes",
        got=got,
        fix=fix,
    )


def examine(
    kind: type[Model], value: object
) -> tuple[Model | None, tuple[SchemaIssue, ...]]:
    """Return the model that a value describes, or None and what is wrong with it.

    Of what is wrong, the first :data:`MOST_ISSUES` places are returned.
    """
    try:
        return kind.model_validate(value), ()
    except ValidationError as error:
        errors = error.errors(include_url=False)

    # pydantic reports a list with a faulty member as too short, too
    containers = set()
    for item in errors:
        for depth in range(1, len(item["loc"])):
            containers.add(item["loc"][:depth])
    innermost = []
    for item in errors:
        if item["loc"] not in containers:
            innermost.append(item)
    issues = []
    for item in innermost[:MOST_ISSUES]:
        issues.append(_issue_from(kind, item))
    return None, tuple(issues)


def format_issues(issues: Sequence[SchemaIssue]) -> str:
    """Return issues one below the other."""
    return "\n    ".join(["", *map(str, issues)])


def read_entry(path: Path) -> Entry:
    """Read the entry of a YAML file.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it does not fit the schema.
    """
    entry, issues = examine(Entry, load_plain(path, fix=ENTRY_FIX))
    if entry is None:
        count = format_count(len(issues), "mistake")
        if len(issues) == MOST_ISSUES:
            count = f"at least {count}"
        raise ChecksFailedError(
            f"{count} in an entry",
            where=str(path),
            expected="known keys, with values of their kinds",
            got=format_issues(issues),
            fix="correct the keys named above; docs/submitting.md describes them",
        )
    return entry


def read_meta(path: Path | None, options: Mapping[str, object]) -> Meta:
    """Return the description of a method from a YAML file and options.

    Options replace the values of the file. None and empty options count as not given.

    Raises:
        UsageError: the file holds no keys with values, or these do not fit `Meta`.
        UnreadableFileError: no regular file, too long, or no plain YAML.
    """
    description: object = {}
    if path is not None:
        description = load_plain(path, fix=ENTRY_FIX)
    if not isinstance(description, dict):
        raise UsageError(
            "the file does not describe a method",
            where=str(path),
            expected="lines of key: value",
            got=f"{type(description).__name__}: {repr(description)[:60]}",
            fix="write lines as `name: My model`; docs/submitting.md has a whole file",
        )

    description = dict(description)
    for key, value in options.items():
        is_given = value not in (None, "", (), [])
        if is_given:
            description[key] = value

    meta, issues = examine(Meta, description)
    if meta is None:
        where = "options"
        if path is not None:
            where = f"{path}, or options"
        raise UsageError(
            "the description of the method does not fit",
            where=where,
            expected="known keys, with values of their kinds",
            got=format_issues(issues),
            fix="correct the keys named above; docs/submitting.md describes them",
        )
    return meta


def schema_bytes() -> bytes:
    """Return the JSON schema of an entry as the bytes of leaderboard/schema.json."""
    schema = Entry.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "Entry of the lagbench leaderboard"
    _join_description_lines(schema)
    return f"{json.dumps(schema, indent=1, ensure_ascii=False)}\n".encode()


def _join_description_lines(value: object) -> None:
    """Join the lines of every paragraph of every description of a schema, in place.

    Descriptions come from docstrings, whose wrapping means nothing.
    """
    if isinstance(value, list):
        for member in value:
            _join_description_lines(member)
    if not isinstance(value, dict):
        return
    for key, member in value.items():
        if key == "description" and isinstance(member, str):
            paragraphs = []
            for paragraph in member.split("\n\n"):
                paragraphs.append(" ".join(paragraph.split()))
            value[key] = "\n\n".join(paragraphs)
        else:
            _join_description_lines(member)


def entry_bytes(entry: Entry) -> bytes:
    """Return the bytes of an entry's YAML file; equal entries give equal bytes."""
    values = entry.model_dump(mode="python", exclude_defaults=True)
    ordered = {}
    for key in Entry.KEY_ORDER:
        if key in values:
            ordered[key] = values[key]
    return yaml_bytes(ordered)


def yaml_bytes(value: object) -> bytes:
    """Return plain values as the bytes of a YAML file."""
    return format_yaml(_to_plain(value), default_flow_style=None).encode()


def _to_plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _to_plain(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_plain(member) for member in value]
    if isinstance(value, enum.Enum):
        return str(value)
    return value


def _issue_from(kind: type[BaseModel], item: ErrorDetails) -> SchemaIssue:
    """Return one error of pydantic as an issue."""
    location = item["loc"]
    where = quote(".".join(map(str, location)))[1:-1] or "the file"
    got = quote(item["input"])

    if item["type"] == "extra_forbidden":
        owner = _model_at(kind, location[:-1])
        fix = suggest_name(str(location[-1])[:100], list(owner.model_fields))
        return SchemaIssue(where=where, what="unknown key", got=got, fix=fix)
    if item["type"] == "missing":
        return SchemaIssue(where=where, what="this key is missing", got="no such key")

    if is_own_sentence(item):
        what = describe_expectation(item)
    else:
        what = f"is not {describe_expectation(item)}"
    return SchemaIssue(where=where, what=what, got=got)


def _model_at(
    kind: type[BaseModel], location: tuple[int | str, ...]
) -> type[BaseModel]:
    """Return the model that stands at a location inside a model."""
    for key in location:
        # a number is a position in a list; other texts are names in a mapping
        if isinstance(key, str) and key in kind.model_fields:
            kind = _model_in(kind.model_fields[key].annotation) or kind
    return kind


def _model_in(annotation: object) -> type[BaseModel] | None:
    """Return the model that a type names, inside a tuple, mapping or option too."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        model = _model_in(inner)
        if model is not None:
            return model
    return None


def read_entry_if_valid(path: Path) -> Entry | None:
    """Return an entry; None where there is none and where it cannot be read.

    `lagbench leaderboard check` reports entries that cannot be read.
    """
    if not path.exists():
        return None
    try:
        return read_entry(path)
    except (ChecksFailedError, UnreadableFileError):
        return None


def is_unchanged(folder: Folder, path: Path, sha256: str) -> bool:
    """Tell whether a file has the hash that its entry names, and is no link."""
    file = folder.path / path
    if not file.is_file() or folder.link_in(path) is not None:
        return False
    # Hashing a sparse file of a terabyte would take an hour.
    if file.stat().st_size > MOST_FILE_BYTES:
        return False
    return file_sha256(file) == sha256


def require_unchanged_model(folder: Folder, weights: Weights) -> Path:
    """Refuse a model that is not the one that its entry names; return its path.

    Args:
        folder: the leaderboard's folder.
        weights: path and hash that the entry states.

    Raises:
        ChecksFailedError: the file is not the one that the entry names.
    """
    path = folder.path / weights.path
    if not is_unchanged(folder, Path(weights.path), weights.sha256):
        raise ChecksFailedError(
            "the model is not the one that the entry names",
            where=str(path),
            expected=f"SHA-256 {weights.sha256[:16]}",
            got="another file, or none",
            fix=f"restore the file; {advise_board_check(folder.path)}",
        )
    return path


def read_rivals(folder: Folder, place: Place) -> dict[Path, Entry]:
    """Return the other active entries of a split and size, by path in the folder."""
    rivals = {}
    for path in folder.entries():
        if path.parts[1:3] != place[:2] or path == entry_path(place):
            continue
        entry = read_entry_if_valid(folder.path / path)
        if entry is not None and entry.status is Status.ACTIVE:
            rivals[path] = entry
    return rivals
