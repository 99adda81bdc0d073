"""What the thesis shows (a figure) and what stands beside it (a sheet); sheets as Markdown, CSV and PNG."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import write_atomically
from lagbench.draw.markdown import table
from lagbench.metrics.aggregate import Score
from lagbench.scoring.tables import Table

if TYPE_CHECKING:
    from .runs import Plan

__all__ = ["Figure", "Sheet", "interval", "number", "write_sheet"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure, table or section of the thesis: one row of the catalogue."""

    name: str  # as in fig_5_10 or table_5_4
    title: str  # what it shows
    draw: Callable[[Plan, Figure], Sheet]
    needs: Mapping[str, tuple[str, ...]] = field(
        default_factory=dict
    )  # models whose scored runs it shows, by split
    studies: str = ""  # table of MLPs whose trainings it shows
    cases: tuple[int, ...] = (0,)  # scenarios of the thesis: T0, T1, ...; ids on the free surface
    frames: tuple[int, ...] = ()  # absolute; empty for the frame at which the thesis compares models
    whole: bool = False  # show the whole rollout: pictures spread over it, errors over the horizon
    panels: tuple[str, ...] = ()  # kinds of picture, one each
    metrics: tuple[
        str, ...
    ] = ()  # of its table; of curves: the models', the truth's own, then means over the horizon
    said: str = ""  # what the thesis says of it

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
    """One table or figure of the thesis, ours beside it."""

    notes: tuple[str, ...] = ()  # sentences; one paragraph each
    tables: tuple[Table, ...] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # PNG files by what is added to their name


def write_sheet(sheet: Sheet, folder: Path, name: str, head: str) -> str:
    """Write ``<name>.md``, ``<name>[-n].csv`` and pictures; return the Markdown, which the head opens."""
    parts = [head, *sheet.notes]
    for count, held in enumerate(sheet.tables, start=1):
        parts += [f"**{held.title}**"] if held.title else []
        parts.append(table(held.columns, held.rows))
        ending = f"-{count}" if len(sheet.tables) > 1 else ""
        with io.StringIO() as buffer:
            csv.writer(buffer, lineterminator="\n").writerows([held.columns, *held.rows])
            write_atomically(folder / f"{name}{ending}.csv", buffer.getvalue().encode(), option="--output")
    for what, picture in sheet.pictures.items():
        path = folder / (f"{name}-{what}.png" if what else f"{name}.png")
        write_atomically(path, picture, option="--output")
        parts.append(f"![{name} {what}]({path.name})")
    text = "\n\n".join(parts) + "\n"
    write_atomically(folder / f"{name}.md", text.encode(), option="--output")
    return text


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many digits, a dash where there is none.

    >>> number(0.00012345), number(None), number(12345678.0)
    ('0.000123', '-', '1.23e+07')
    """
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}g}"


def interval(score: Score) -> str:
    """Return mean and 95 % interval over scenarios, as in "0.12 (0.1 to 0.15)"."""
    low, high = score.interval
    bounds = "" if math.isnan(low) else f" ({number(low)} to {number(high)})"
    return f"{number(score.mean)}{bounds}"
