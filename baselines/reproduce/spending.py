"""What a training spent, from what it recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["budget", "hardware"]


def budget(record: Mapping[str, Any]) -> str:
    """Return steps and windows of a step, as in "5,000 x 2"; a dash where unknown."""
    if "windows" not in record:
        return "closed form" if record else "-"
    return f"{record['step']:,} x {record['recipe']['training']['batch']}"


def hardware(record: Mapping[str, Any]) -> str:
    """Return the machine of a training: its GPU, or its processor and threads."""
    said = record.get("hardware")
    if not said:
        return "-"
    if said["device"] != "cpu":
        return str(said["device"])
    threads = "1 thread" if said["threads"] == 1 else f"{said['threads']} threads"
    return f"{said['processor']}, {threads}"
