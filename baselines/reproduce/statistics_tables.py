"""Tables 5.1 and 5.3: statistics of train per frame, the thesis's beside ours; nothing is trained."""

from __future__ import annotations

from lagbench.data.manifest import read_manifest
from lagbench.errors import DataError
from lagbench.scoring.tables import Table

from .plan import Plan
from .sheet import Sheet
from .thesis import STATISTICS
from .wording import number

__all__ = ["SPLITS", "table"]

SPLITS = {"table_5_1": "curl-noise", "table_5_3": "cavity"}
"""Split by table."""


def table(plan: Plan, name: str) -> Sheet:
    """Return the statistics of one split."""
    split = SPLITS[name]
    tier = plan.tier(split)
    manifest = read_manifest(plan.root, split, plan.size, tier.major)
    found = tier.measured.statistics if tier.measured else (manifest.statistics if manifest else {})
    if not found:
        raise DataError(
            "the statistics of train are recorded nowhere", fix=f"lagbench generate --split {split}"
        )
    rows = [
        (quantity, *(number(value, 4) for pair in (printed, found[quantity]) for value in pair))
        for quantity, printed in STATISTICS[split].items()
    ]
    heads = ("per frame", "thesis x", "thesis y", "ours x", "ours y")
    note = (
        "The scale of the velocities is set so that at size full their deviation is the thesis's, within 5 %;"
        " means are 0 in a full box, and accelerations are reported, not tuned."
    )
    return Sheet(notes=(note,), tables=(Table(f"{split} {plan.size}, train", heads, tuple(rows)),))
