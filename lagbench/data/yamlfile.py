"""Read YAML that strangers may have written: safe types only, bounded size, no aliases.

Aliases are refused because a few hundred bytes of them can expand to gigabytes; duplicate
keys because the second would silently replace the first.
"""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from lagbench.errors import UnreadableFileError

__all__ = [
    "MAX_BYTES",
    "MAX_DEPTH",
    "read_yaml",
]


MAX_BYTES = 4 * 2**20
"""Largest YAML file that is read [bytes]."""

MAX_DEPTH = 32
"""Deepest nesting of mappings and lists that is read."""


class _StrictLoader(yaml.CSafeLoader):
    """Safe loader that refuses duplicate keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable) or key in seen:
                message = f"key {key!r} is given twice or cannot be a key"
                raise yaml.constructor.ConstructorError(None, None, message, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def _check_structure(text: str) -> None:
    """Raise on the first alias or tag and on deep nesting, before anything is built."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        what = None
        if depth > MAX_DEPTH:
            what = f"nested deeper than {MAX_DEPTH}"
        elif isinstance(event, yaml.AliasEvent):
            what = "aliases are not allowed"
        elif getattr(event, "tag", None) is not None:
            what = "tags are not allowed"
        if what is not None:
            message = f"{what} {event.start_mark}"
            raise yaml.YAMLError(message)


def read_yaml(path: Path) -> Any:  # noqa: ANN401
    """Return the plain Python value of a YAML file."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise UnreadableFileError(
                "the YAML file is too large",
                where=str(path),
                expected=f"at most {MAX_BYTES} bytes",
                got=f"{size} bytes",
            )
        text = path.read_text(encoding="utf-8")
        _check_structure(text)
        return yaml.load(text, Loader=_StrictLoader)
    except OSError as error:
        raise UnreadableFileError(
            "cannot read the YAML file", where=str(path), got=error.strerror or error
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date or number that is none
        raise UnreadableFileError(
            "not a plain YAML file",
            where=str(path),
            got=" ".join(str(error).split()),
            fix="use plain mappings, lists, numbers and strings, in UTF-8",
        ) from error
