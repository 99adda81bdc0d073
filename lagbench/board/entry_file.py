"""Read and write YAML files: those of submitters, where all stays text, and the list of
verified entries.

That list, leaderboard/verified.yaml, names the entries whose predictions the
maintainers scored again. It lies apart from the entries, so that nobody can claim it
for his own: ``leaderboard check --base`` names every change to it. A line holds while
the entry has the very score files that it names;
``leaderboard check --predictions FILE --record`` writes it.
"""

from __future__ import annotations

import datetime
import enum
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, RootModel, ValidationError
from pydantic_core import ErrorDetails

from lagbench.atomic import write_atomically
from lagbench.data.checksums import file_sha256
from lagbench.data.yamlfile import read_yaml, spell_yaml
from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError, nearest
from lagbench.submission.issues import quote

from .entry import PATTERNS, Entry, Meta, Status, Verification
from .folder import VERIFIED, Folder, Place, entry_path

MAX_ENTRY_BYTES = 64_000
"""Longest YAML file of an entry [bytes]; twenty seeds and all metrics take half of it.
"""

MOST_MISTAKES = 20  # mistakes of one file that are told


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """One thing in a file that does not fit its schema."""

    where: str  # key, as in "predictions.0.url"
    what: str
    got: str  # what stands there, shortened and escaped
    fix: str | None = None  # the nearest known key where one is unknown

    def __str__(self) -> str:
        """Return the mistake as one line."""
        return f"{self.where}: {self.what}; got {self.got}" + (
            f"; {self.fix}" if self.fix else ""
        )


Model = TypeVar("Model", bound=BaseModel)


def load_plain(path: Path) -> Any:  # noqa: ANN401
    """Return what a YAML file of a submitter holds, after looking at its kind and
    length.
    """
    try:
        regular = path.is_file()
        length = path.stat().st_size
    except OSError as error:
        raise UnreadableFileError(
            "cannot read the YAML file", where=str(path), got=error.strerror
        ) from error
    if not regular or length > MAX_ENTRY_BYTES:
        raise UnreadableFileError(
            "not a YAML file of an entry",
            where=str(path),
            expected=f"a regular file of at most {MAX_ENTRY_BYTES} bytes",
            got=f"{length} bytes" if regular else "something that is no regular file",
            fix="describe the method in a few lines; predictions go elsewhere",
        )
    return read_yaml(path)


def examine(
    kind: type[Model], value: object
) -> tuple[Model | None, tuple[Mistake, ...]]:
    """Return the model that a value describes, or what is wrong with it."""
    try:
        return kind.model_validate(value), ()
    except ValidationError as error:
        found = error.errors(include_url=False)
    # a list with a faulty member is said to be too short as well
    inner = {
        item["loc"][:depth] for item in found for depth in range(1, len(item["loc"]))
    }
    told = [item for item in found if item["loc"] not in inner][:MOST_MISTAKES]
    return None, tuple(_mistake(kind, item) for item in told)


def listed(mistakes: Sequence[Mistake]) -> str:
    """Return mistakes one below the other."""
    return "\n    ".join(["", *map(str, mistakes)])


def read_entry(path: Path) -> Entry:
    """Read the entry of a YAML file."""
    entry, mistakes = examine(Entry, load_plain(path))
    if entry is None:
        fix = "mend the keys named above; docs/submitting.md describes them"
        what = f"{len(mistakes)} mistake(s) in an entry"
        raise ChecksFailedError(what, where=str(path), got=listed(mistakes), fix=fix)
    return entry


def read_meta(path: Path | None, options: Mapping[str, object]) -> Meta:
    """Return what a YAML file and options say; options win, None and empty ones are not
    given.
    """
    held: object
    if path is None:
        held = {}
    else:
        held = load_plain(path)
    if not isinstance(held, dict):
        expected = "lines of key: value"
        raise UsageError(
            "the file does not describe a method", where=str(path), expected=expected
        )
    given = {
        key: value for key, value in options.items() if value not in (None, "", (), [])
    }
    meta, mistakes = examine(Meta, {**held, **given})
    if meta is None:
        raise UsageError(
            "what is said of the method does not fit",
            where="options" if path is None else f"{path}, or options",
            got=listed(mistakes),
            fix="docs/submitting.md describes the keys",
        )
    return meta


def schema_bytes() -> bytes:
    """Return the JSON schema of an entry as the bytes of leaderboard/schema.json."""
    schema = {
        **Entry.model_json_schema(),
        "$schema": "https://json-schema.org/draft/2020-12/schema",
    }
    schema["title"] = "Entry of the lagbench leaderboard"
    return f"{json.dumps(schema, indent=1, ensure_ascii=False)}\n".encode()


def spell(value: Any) -> bytes:  # noqa: ANN401
    """Return an entry, or plain values, as the bytes of a YAML file; equal ones give
    equal bytes.
    """
    if isinstance(value, Entry):
        held = value.model_dump(mode="python", exclude_defaults=True)
        value = {key: held[key] for key in Entry.ORDER if key in held}
    return spell_yaml(_plain(value), default_flow_style=None).encode()


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(held) for key, held in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(held) for held in value]
    if isinstance(value, enum.Enum):
        return str(value)
    return value


def _mistake(kind: type[BaseModel], item: ErrorDetails) -> Mistake:
    place = item["loc"]
    given = quote(item["input"])
    where = quote(".".join(map(str, place)))[1:-1] or "the file"
    if item["type"] == "extra_forbidden":
        for key in place[:-1]:
            if (
                isinstance(key, str) and key in kind.model_fields
            ):  # else a position, or a name in a mapping
                kind = _model_in(kind.model_fields[key].annotation) or kind
        fix = nearest(str(place[-1])[:100], list(kind.model_fields))
        return Mistake(where=where, what="unknown key", got=given, fix=fix)
    if item["type"] == "missing":
        return Mistake(where=where, what="this key is missing", got="no such key")
    pattern = item.get("ctx", {}).get("pattern", "")
    wanted = "a list" if item["type"] == "tuple_type" else PATTERNS.get(pattern)
    what = (
        item["msg"].removeprefix("Value error, ")
        if wanted is None
        else f"is not {wanted}"
    )
    return Mistake(where=where, what=what, got=given)


def _model_in(annotation: object) -> type[BaseModel] | None:
    """Return the model that a type names, inside a tuple, mapping or option too."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(
        (found for inner in get_args(annotation) if (found := _model_in(inner))), None
    )


def readable(path: Path) -> Entry | None:
    """Return an entry; None of none and of one that cannot be read: `leaderboard check`
    tells of those.
    """
    with suppress(ChecksFailedError, UnreadableFileError):
        if path.exists():
            return read_entry(path)
        return None
    return None


def is_there(folder: Folder, path: Path, sha256: str) -> bool:
    """Tell whether a file lies where its entry says, as it says, and not behind a
    link.
    """
    file = folder.path / path
    return (
        file.is_file() and folder.link_in(path) is None and file_sha256(file) == sha256
    )


def active_beside(folder: Folder, place: Place) -> dict[Path, Entry]:
    """Return the other active entries of a split and size, by their paths in the
    folder.
    """
    beside = [
        path
        for path in folder.entries()
        if path.parts[1:3] == place[:2] and path != entry_path(place)
    ]
    found = {path: readable(folder.path / path) for path in beside}
    return {
        path: one
        for path, one in found.items()
        if one is not None and one.status is Status.ACTIVE
    }


class _List(RootModel[dict[str, Verification]]):
    """Entries, by path relative to the leaderboard's folder."""


def read_verified(folder: Folder) -> Mapping[str, Verification]:
    """Return the list; empty where there is none."""
    path = folder.path / VERIFIED
    if not path.exists() and not path.is_symlink():
        return {}
    held = load_plain(path)
    found, mistakes = examine(_List, {} if held is None else held)
    if found is None:
        raise ChecksFailedError(
            "the list of verified entries does not fit",
            where=str(path),
            expected="entry path: {scores: [SHA-256, ...], lagbench: VERSION, date: "
            "YYYY-MM-DD}",
            got=listed(mistakes),
            fix="`lagbench leaderboard check --predictions FILE --record` writes it",
        )
    return found.root


def verification_of(
    entry: Entry, known: Mapping[str, Verification]
) -> Verification | None:
    """Return the line of an entry; None without one, or if it is of other score
    files.
    """
    line = known.get(entry.yaml_path.as_posix())
    if line and line.scores == tuple(held.sha256 for held in entry.score.files):
        return line
    return None


def unverified(folder: Folder, entry: Entry) -> bytes | None:
    """Return the list without an entry's line of other score files; None where it has
    no such line.
    """
    known = read_verified(folder)
    name = entry.yaml_path.as_posix()
    if name not in known or verification_of(entry, known) is not None:
        return None
    return spell(
        {path: line.model_dump() for path, line in known.items() if path != name}
    )


def record(folder: Folder, entries: Sequence[Entry]) -> None:
    """Add entries to the list, or renew their lines; without any the list stays as it
    is.
    """
    if not entries:
        return
    held: dict[str, object] = {
        path: line.model_dump() for path, line in read_verified(folder).items()
    }
    for entry in entries:
        held[entry.yaml_path.as_posix()] = {
            "scores": tuple(file.sha256 for file in entry.score.files),
            "lagbench": version("lagbench"),
            "date": datetime.datetime.now(datetime.UTC).date(),
        }
    write_atomically(
        folder.path / VERIFIED, spell(dict(sorted(held.items()))), option="--board"
    )
