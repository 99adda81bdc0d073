"""What a submitter says beside the predictions: keys of ``--from`` and options of the command."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field

from lagbench.errors import UsageError

from .entry import MOST_SEEDS, About, Link, Name, Seconds, Short
from .entry_file import examine, load_plain

__all__ = ["Meta", "read_meta"]


class Meta(About):
    """What a submitter says of a method and of this submission of it."""

    method: Name | None = Field(
        default=None, description="names the entry; by default what the predictions say"
    )
    urls: Annotated[tuple[Link, ...], Field(max_length=MOST_SEEDS, strict=False)] = ()
    scored_by: Short | None = None
    solver_seconds_per_frame: Seconds | None = None


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
    given = {key: value for key, value in options.items() if value not in (None, "", (), [])}
    if not isinstance(held, dict):
        raise UsageError(
            "the file does not describe a method", where=str(path), expected="lines of key: value"
        )
    meta, mistakes = examine(Meta, {**held, **given})
    if meta is None:
        raise UsageError(
            "what is said of the method does not fit",
            where="options" if path is None else f"{path}, or options",
            got="\n    ".join(["", *map(str, mistakes)]),
            fix="docs/submitting.md describes the keys",
        )
    return meta
