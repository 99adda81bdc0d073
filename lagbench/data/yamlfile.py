"""Read YAML that strangers may have written: safe types only, bounded size, no aliases.

Aliases are refused because a few hundred bytes of them can expand to gigabytes;
duplicate keys because the second would silently replace the first. Numbers are those of
YAML 1.2: YAML 1.1, which PyYAML speaks, also has base 60 (``59:59:1.5``) and reads
``010`` as eight.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from lagbench.errors import UnreadableFileError

MAX_BYTES = 4 * 2**20
"""Largest YAML file that is read [bytes]."""

MAX_DEPTH = 32
"""Deepest nesting of mappings and lists that is read."""


INTEGER = "tag:yaml.org,2002:int"
FLOAT = "tag:yaml.org,2002:float"
NUMBERS = {
    INTEGER: re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$"),
    FLOAT: re.compile(
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
}
"""Numbers of YAML 1.2's core schema, by tag; integers are asked first."""


class _StrictLoader(yaml.CSafeLoader):
    """Safe loader that refuses duplicate keys and knows the numbers of YAML 1.2
    only.
    """

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable) or key in seen:
                message = f"key {key!r} is given twice or cannot be a key"
                raise yaml.constructor.ConstructorError(
                    None, None, message, key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


_StrictLoader.yaml_implicit_resolvers = {
    first: [(tag, known) for tag, known in held if tag not in NUMBERS]
    for first, held in yaml.CSafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _pattern in NUMBERS.items():
    _StrictLoader.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))
_StrictLoader.add_constructor(
    INTEGER,
    lambda _, node: int(node.value, 0 if node.value[:2] in ("0o", "0x") else 10),
)
_StrictLoader.add_constructor(
    FLOAT,
    lambda _, node: float(
        node.value.replace(".", "", 1) if node.value[-1:].isalpha() else node.value
    ),
)


def _check_structure(text: str) -> None:
    """Raise on the first alias or tag and on deep nesting, before anything is built."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(
            event, yaml.CollectionEndEvent
        )
        what = None
        if depth > MAX_DEPTH:
            what = f"nested deeper than {MAX_DEPTH}"
        elif isinstance(event, yaml.AliasEvent):
            what = "aliases are not allowed"
        elif getattr(event, "tag", None) is not None:
            what = "tags are not allowed"
        if what is not None:
            raise yaml.YAMLError(f"{what} {event.start_mark}")


def read_yaml(path: Path) -> Any:  # noqa: ANN401
    """Return the plain Python value of a YAML file."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            what = "the YAML file is too large"
            expected = f"at most {MAX_BYTES} bytes"
            raise UnreadableFileError(
                what, where=str(path), expected=expected, got=f"{size} bytes"
            )
        text = path.read_text(encoding="utf-8")
        _check_structure(text)
        return yaml.load(text, Loader=_StrictLoader)
    except OSError as error:
        got = error.strerror or error
        raise UnreadableFileError(
            "cannot read the YAML file", where=str(path), got=got
        ) from error
    except (
        yaml.YAMLError,
        ValueError,
        ArithmeticError,
        RecursionError,
    ) as error:  # as dates
        got = " ".join(str(error).split())
        fix = "use plain mappings, lists, numbers and strings, in UTF-8"
        raise UnreadableFileError(
            "not a plain YAML file", where=str(path), got=got, fix=fix
        ) from error


class _Dumper(yaml.SafeDumper):
    """Quotes what our reader takes for a number, and writes no aliases, which it
    refuses.
    """

    def ignore_aliases(self, data: object) -> bool:
        return True


for _tag, _pattern in NUMBERS.items():
    _Dumper.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))


def spell_yaml(value: object, *, default_flow_style: bool | None = False) -> str:
    """Return plain values as the text of a YAML file, which :func:`read_yaml` reads as
    the same values.
    """
    return str(
        yaml.dump(
            value,
            Dumper=_Dumper,
            sort_keys=False,
            allow_unicode=True,
            width=110,
            default_flow_style=default_flow_style,
        )
    )
