"""The JSON schema of an entry, for editors and for checks in other languages.

It follows from :class:`~lagbench.board.entry.Entry`; leaderboard/schema.json is a copy that
``lagbench leaderboard check`` compares.
"""

from __future__ import annotations

import json

from .entry import Entry

__all__ = ["SCHEMA_NAME", "schema_bytes"]

SCHEMA_NAME = "schema.json"


def schema_bytes() -> bytes:
    """Return the schema as the bytes of leaderboard/schema.json."""
    schema = Entry.model_json_schema()
    schema |= {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Entry of the lagbench leaderboard",
    }
    return f"{json.dumps(schema, indent=1, ensure_ascii=False)}\n".encode()
