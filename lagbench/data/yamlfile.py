"""Read YAML of strangers: safe types only, bounded size, no aliases.

Aliases are refused because a few hundred bytes of them can expand to gigabytes;
duplicate keys because the second would silently replace the first. Floats are those of
YAML 1.2.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from lagbench.errors import UnreadableFileError, check_regular

MAX_BYTES = 4 * 2**20
"""Largest YAML file that is read [bytes]."""

MOST_LETTERS = 80
"""Letters of a key in a message."""

MAX_DEPTH = 32
"""Deepest nesting of mappings and lists that is read."""


FLOAT = "tag:yaml.org,2002:float"
FLOATS = re.compile(
    r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
"""Floats of YAML 1.2: PyYAML takes 1e-3 for a text, and 59:59 for a number."""


class _StrictLoader(yaml.CSafeLoader):
    """Safe loader with the numbers of YAML 1.2; it refuses duplicate keys."""

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, Any]:
        mapping: dict[Hashable, Any] = {}
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            mistake = None
            if not isinstance(key, Hashable):
                mistake = "cannot be a key"
            elif key in mapping:
                mistake = "is given twice"
            if mistake is not None:
                message = f"key {ascii(key)[:MOST_LETTERS]} {mistake}"
                raise yaml.constructor.ConstructorError(
                    None, None, message, key_node.start_mark
                )
            mapping[key] = self.construct_object(value_node, deep=deep)
        return mapping


def _use_floats(kind: type[yaml.CSafeLoader | yaml.SafeDumper]) -> None:
    """Replace the floats of YAML 1.1 by those of YAML 1.2."""
    resolvers = {}
    for first_character, pairs in kind.yaml_implicit_resolvers.items():
        resolvers[first_character] = [pair for pair in pairs if pair[0] != FLOAT]
    kind.yaml_implicit_resolvers = resolvers
    kind.add_implicit_resolver(FLOAT, FLOATS, list("-+.0123456789"))


_use_floats(_StrictLoader)


def _check_structure(text: str) -> None:
    """Raise on the first alias or tag and on deep nesting, before anything is built."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        issue = None
        if depth > MAX_DEPTH:
            issue = f"nested deeper than {MAX_DEPTH}"
        elif isinstance(event, yaml.AliasEvent):
            issue = "aliases are not allowed"
        elif getattr(event, "tag", None) is not None:
            issue = "tags are not allowed"
        if issue is not None:
            raise yaml.YAMLError(f"{issue} {event.start_mark}")


def read_yaml(path: Path) -> Any:  # noqa: ANN401
    """Return the plain Python value of a YAML file.

    Raises:
        UnreadableFileError: the file is missing, too large, no regular file, or not
            plain YAML.
    """
    check_regular(path, longest=MAX_BYTES, fix="name a YAML file")
    try:
        text = path.read_text(encoding="utf-8")
        _check_structure(text)
        return yaml.load(text, Loader=_StrictLoader)
    except OSError as error:
        raise UnreadableFileError(
            f"cannot read the YAML file: {error.strerror or error}; check the path "
            "and that you may read the file",
            where=str(path),
        ) from error
    # PyYAML raises other types too, as for impossible dates.
    except (yaml.YAMLError, ValueError, ArithmeticError, RecursionError) as error:
        raise UnreadableFileError(
            f"not a plain YAML file: {' '.join(str(error).split())}; use plain "
            "mappings, lists, numbers and strings, in UTF-8",
            where=str(path),
        ) from error


class _Dumper(yaml.SafeDumper):
    """Dumper for our reader; it writes no aliases."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _represent_text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    # Readers fold line breaks of Unicode into blanks, unless they are escaped.
    style = '"' if set("\x85\u2028\u2029\ufeff").intersection(text) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _represent_text)
_use_floats(_Dumper)


def format_yaml(value: object, *, default_flow_style: bool | None = False) -> str:
    """Return plain values as YAML that :func:`read_yaml` reads as the same values."""
    text = yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        width=110,
        default_flow_style=default_flow_style,
    )
    return str(text)
