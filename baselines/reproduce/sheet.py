"""What a script says of one table or figure: text, tables, pictures; as Markdown, CSV and PNG."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.draw.markdown import table
from lagbench.scoring.tables import Table

__all__ = ["Sheet", "write_sheet"]


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One table or figure of the thesis, ours beside it."""

    notes: tuple[str, ...] = ()  # sentences; one paragraph each
    tables: tuple[Table, ...] = ()  # numbers as text, one table each
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # PNG files by what is added to their name


def write_sheet(sheet: Sheet, folder: Path, name: str, head: str) -> str:
    """Write ``<name>.md``, ``<name>[-n].csv`` and pictures; return the Markdown."""
    parts = [head, *sheet.notes]
    for number, held in enumerate(sheet.tables):
        parts += [f"**{held.title}**", table(held.columns, held.rows)] if held.title else [_plain(held)]
        ending = f"-{number + 1}" if len(sheet.tables) > 1 else ""
        write_atomically(folder / f"{name}{ending}.csv", _comma_separated(held), option="--output")
    for what, picture in sheet.pictures.items():
        path = folder / (f"{name}-{what}.png" if what else f"{name}.png")
        write_atomically(path, picture, option="--output")
        parts.append(f"![{name} {what}]({path.name})")
    text = "\n\n".join(parts) + "\n"
    write_atomically(folder / f"{name}.md", text.encode(), option="--output")
    return text


def _plain(held: Table) -> str:
    return table(held.columns, held.rows)


def _comma_separated(held: Table) -> bytes:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(held.columns)
    writer.writerows(held.rows)
    return buffer.getvalue().encode()
