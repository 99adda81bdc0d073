"""One item of the thesis, a table, section or figure, and the sheet that shows it."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.figures.tables import Table, markdown

from .plan import Plan


@dataclass(frozen=True, kw_only=True)
class ThesisItem:
    """A figure, table or section of the thesis: one row of the catalogue."""

    name: str = ""  # its key in the catalogue: fig_5_10 or table_5_4
    title: str  # what it shows
    draw: Callable[[Plan, ThesisItem], Sheet]
    # models whose scored runs it shows, by split
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    studies: str = ""  # table of MLPs whose trainings it shows
    # scenarios of the thesis: T0, T1, ...; ids on the free surface
    cases: tuple[int, ...] = (0,)
    # absolute; empty for the frame at which the thesis compares models
    frames: tuple[int, ...] = ()
    # show the whole rollout: pictures spread over it, errors over the horizon
    whole: bool = False
    panels: tuple[str, ...] = ()  # kinds of picture, one each
    # of its table; of curves: the models', the truth's own, then means over the horizon
    metrics: tuple[str, ...] = ()
    remark: str = ""  # what the thesis concludes from it, or how to read it

    @property
    def split(self) -> str:
        """The split that it is about, the first of several."""
        return next(iter(self.needs))

    @property
    def models(self) -> tuple[str, ...]:
        """The models that it shows on that split."""
        return self.needs[self.split]


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A table or figure of the thesis with our results beside it."""

    notes: tuple[str, ...] = ()  # one paragraph each
    tables: tuple[Table, ...] = ()
    # PNG files by the ending of their name
    pictures: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Notes and tables as Markdown."""
        tables = [table_markdown(table) for table in self.tables]
        return "\n\n".join([*self.notes, *tables])


def table_markdown(table: Table) -> str:
    """Return a table as Markdown, without its title."""
    return markdown(table.columns, table.rows)


def write_sheet(sheet: Sheet, folder: Path, *, name: str, head: str) -> str:
    """Write ``<name>.md``, ``<name>[-n].csv`` and pictures; return the Markdown.

    The Markdown begins with the head.
    """
    parts = [head, *sheet.notes]
    for count, table in enumerate(sheet.tables, start=1):
        if table.title:
            parts.append(f"**{table.title}**")
        parts.append(table_markdown(table))
        ending = f"-{count}" if len(sheet.tables) > 1 else ""
        _write_csv(table, folder / f"{name}{ending}.csv")

    for ending, picture in sheet.pictures.items():
        file_name = f"{name}-{ending}.png" if ending else f"{name}.png"
        write_atomically(folder / file_name, picture, option="--output")
        parts.append(f"![{name} {ending}]({file_name})")

    text = "\n\n".join(parts) + "\n"
    write_atomically(folder / f"{name}.md", text.encode(), option="--output")
    return text


def _write_csv(table: Table, path: Path) -> None:
    with io.StringIO() as buffer:
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(table.columns)
        writer.writerows(table.rows)
        content = buffer.getvalue().encode()
    write_atomically(path, content, option="--output")
