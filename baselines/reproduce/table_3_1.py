"""Table 3.1 and Fig. 3.1: time of the solver over its quality factor; measured by a benchmark."""

from __future__ import annotations

from pathlib import Path

from .plan import Plan
from .sheet import Sheet

__all__ = ["pointed"]

FOLDER = Path("docs/figures")
COMMAND = "python benchmarks/table_3_1.py --rows 1-4 --device cpu --output docs/figures"


def pointed(plan: Plan, name: str) -> Sheet:
    """Return the command, and what it last wrote where that is here."""
    del plan, name
    found = [path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("table_3_1_*.md"))]
    note = f"From a clone of the repository: `{COMMAND}` (rows 1-9 with `--device cuda`)."
    return Sheet(notes=(note, *found))
