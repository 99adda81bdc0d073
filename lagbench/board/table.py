"""The board's table as HTML: every row, and the columns that are shown at first.

It stands there without any script. The page's script sorts rows, filters them, and adds
headings and cells of the other columns from the page data; it reads no number from the
table.
"""

from __future__ import annotations

from dataclasses import dataclass

from lagbench.figures.html import Markup, interval, join, tag
from lagbench.figures.numbers import MISSING, text
from lagbench.metrics.metric import Direction

from .columns import Column, format_ranks
from .model import BoardRow, ReferenceRow, Tab
from .table_view import Cell, Chip, Line, TableView

ARROWS = {
    Direction.LOWER: "↓",
    Direction.HIGHER: "↑",
    Direction.TARGET: "◎",
    Direction.NONE: "",
}
REPORTED = "Self-reported: stated by the submitter, computed again by nobody."
REFERENCE_MEANING = "A reference predictor: ranks count entries only."
REPORTED_MARK = "self\u2011reported"


@dataclass(frozen=True, kw_only=True)
class Heading:
    """What the heading of a column says."""

    label: str
    marks: tuple[str, ...]  # unit and direction, and who states the values
    meaning: str


def draw_table(view: TableView) -> Markup:
    """Return the table of a tab."""
    size = view.tab.size
    caption = f"{size.split} {size.name}: methods and scores"
    headings = [
        _heading(
            "rank",
            tag("span", "#", class_="metric"),
            "Best to worst rank among entries, in 95 % of the resamples",
            class_="rank",
        ),
        _heading(
            "name",
            tag("span", "method", class_="metric"),
            "Name of the method",
            class_="method",
        ),
    ]
    for key, column in view.columns.items():
        if key in view.main:
            headings.append(_column_heading(column))
    lines = []
    for line in view.lines:
        lines.append(_draw_line(view, line))
    return tag(
        "table",
        tag("caption", caption, class_="unseen"),
        tag("thead", tag("tr", *headings)),
        tag("tbody", *lines),
        class_="board",
    )


def heading_of(column: Column) -> Heading:
    """Return what the heading of a column says."""
    marks = []
    unit = f"{column.unit} {ARROWS[column.direction]}".strip()
    if unit:
        marks.append(unit)
    meaning = column.meaning
    if column.reported:
        marks.append(REPORTED_MARK)
        meaning = f"{meaning} {REPORTED}"
    return Heading(label=column.label, marks=tuple(marks), meaning=meaning)


def _heading(key: str, label: object, meaning: str, **attributes: object) -> Markup:
    sorter = tag(
        "button", label, type="button", class_="sorter", data_sort=key, title=meaning
    )
    return tag("th", sorter, scope="col", **attributes)


def _column_heading(column: Column) -> Markup:
    """Return a heading; headingCell in page/table.js makes the same."""
    heading = heading_of(column)
    label = [tag("span", heading.label, class_="metric")]
    for mark in heading.marks:
        label.append(tag("span", mark, class_="unit"))
    class_ = None
    if column.form == "text":
        class_ = "words"
    return _heading(column.key, join(label), heading.meaning, class_=class_)


def _draw_line(view: TableView, line: Line) -> Markup:
    cells = []
    for key, cell in line.cells.items():
        if key in view.main:
            cells.append(_draw_cell(cell))
    row = line.row
    if isinstance(row, ReferenceRow):
        return tag(
            "tr",
            tag("td", "ref.", class_="rank", title=REFERENCE_MEANING),
            _reference_heading(line, row),
            *cells,
            class_="reference",
            data_reference=line.id,
        )
    return tag(
        "tr",
        tag("td", _draw_rank(row), class_="rank"),
        _entry_heading(view.tab, line, row),
        *cells,
        class_=_class_of(row),
        hidden=not row.active,
        data_entry=line.id,
        data_variant_of=row.variant_of,
    )


def _class_of(row: BoardRow) -> str | None:
    if not row.active:
        return "inactive"
    if row.variant_of is not None:
        return "variant folded"
    return None


def fold_button(method: str, count: int) -> Markup:
    """Return the button that shows the variants of a method."""
    label = f"{count} variants"
    if count == 1:
        label = "1 variant"
    return tag(
        "button",
        label,
        type="button",
        class_="fold scripted",
        data_fold=method,
        aria_expanded="false",
    )


def _draw_cell(cell: Cell) -> Markup:
    parts: list[object] = [cell.text]
    if cell.sign:
        parts.append(tag("sup", cell.sign))
    if cell.interval is not None:
        parts.append(interval(cell.interval))
    return tag(
        "td",
        *parts,
        class_=" ".join(cell.classes) or None,
        title=cell.note or None,
    )


def _draw_rank(row: BoardRow) -> Markup:
    rank = MISSING
    if row.variant_of is not None:
        rank = ""
    elif row.rank is not None:
        rank = format_ranks(row.rank, row.rank_range)
    if not row.tied:
        return join([rank])
    meaning = f"not different from the leader at 5 % (p = {text(row.p, 2)}, corrected)"
    return join([rank, tag("span", "≈", class_="tied", title=meaning)])


def _reference_heading(line: Line, row: ReferenceRow) -> Markup:
    parts = [tag("span", row.name, class_="name")]
    parts += [_draw_chip(chip) for chip in line.chips]
    if row.definition:
        parts.append(tag("span", row.definition, class_="sub"))
    return tag("th", *parts, scope="row", class_="method")


def _entry_heading(tab: Tab, line: Line, row: BoardRow) -> Markup:
    address = f"#tab={tab.id}&entry={line.id}"
    parts = [tag("a", line.name, href=address, class_="name")]
    parts += [_draw_chip(chip) for chip in line.chips]
    variants = tab.variants_of(row)
    if variants:
        parts.append(fold_button(line.id, len(variants)))
    parts.append(tag("span", line.byline, class_="sub"))
    if line.links:
        links = []
        for label, target in line.links:
            links.append(_draw_link(label, target))
        parts.append(tag("span", *links, class_="links"))
    return tag("th", *parts, scope="row", class_="method")


def _draw_chip(chip: Chip) -> Markup:
    class_ = f"flag {chip.kind}".strip()
    return tag("span", chip.label, class_=class_, title=chip.meaning or None)


def _draw_link(label: str, address: str) -> Markup:
    """Return a link; only links that leave the folder open a new tab."""
    if not address.startswith(("http://", "https://")):
        return tag("a", label, href=address)
    return tag(
        "a",
        label,
        href=address,
        rel="noopener noreferrer nofollow",
        target="_blank",
    )
