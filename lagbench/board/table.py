"""The board's table, drawn once: every row and column, those hidden at first too.

Each cell has its value as ``data-value``; the page's script sorts rows, filters them
and hides cells, and writes no text of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from lagbench.data.checksums import round_digits
from lagbench.figures.html import MISSING, Markup, interval, join, tag, text
from lagbench.metrics.metric import Direction, Metric

from .columns import Column, columns_of, held, loss_of, presets_of, value_of, written
from .folder import weights_path
from .model import ReferenceRow, Row, Tab

MOST_REASONS = 4
"""Reasons of a warning that are told; those of other scenarios say the same with other
numbers.
"""

SHADES = 5
FEWEST_SHADED = 3

ARROWS = {
    Direction.LOWER: "↓",
    Direction.HIGHER: "↑",
    Direction.TARGET: "◎",
    Direction.NONE: "",
}
REPORTED = "Self-reported: said by the submitter, computed again by nobody."
REPORTED_MARK = "self\u2011reported"

EXPLAINED: Mapping[str, tuple[str, str]] = {
    "copy_suspect": (
        "copy suspected",
        "The error moves from frame to frame as that of no rollout does.",
    ),
    "below_twin_floor": (
        "closer than a twin",
        "Closer to the truth than the solver itself after a nudge of 2⁻²⁰.",
    ),
    "physics": (
        "unphysical",
        "Kinetic energy or filled area are far from the truth's.",
    ),
    "in_domain": (
        "leaves the box",
        "Predicted particles lie outside the box; there they carry no weight on "
        "the grid.",
    ),
    "max_displacement": (
        "jumps",
        "Predicted particles move farther in a frame than any of the truth.",
    ),
    "discontinuous_start": (
        "jumps at the start",
        "The first frame is far from the last given.",
    ),
}
"""What flags and warnings are called on the page, which shows what is wrong, and what
they mean.
"""


def draw_table(tab: Tab, metrics: Mapping[str, Metric]) -> Markup:
    """Return the table of a tab: entries and floors in the order of the ranking
    metric.
    """
    columns = columns_of(tab, metrics)
    main = presets_of(tab, columns)["main"]
    ranking = columns[tab.ranking]
    shades = {key: _Shades(tab, column) for key, column in columns.items()}

    def order(row: Row | ReferenceRow) -> tuple[bool, float]:
        loss = ranking.loss(float(value_of(row, ranking)))
        return isinstance(row, Row) and not row.active, math.inf if math.isnan(
            loss
        ) else loss

    lines = []
    for number, row in enumerate(sorted(tab.lines, key=order)):
        cells = [
            _cell(
                row,
                column,
                shades[key],
                main=key in main,
                ranks=key in (tab.ranking, "skill"),
            )
            for key, column in columns.items()
        ]
        lines.append(_line(tab, row, number, cells))
    head = [
        _heading(
            "rank",
            tag("span", "#", class_="metric"),
            "Rank by the ranking metric",
            class_="rank",
        ),
        _heading(
            "name",
            tag("span", "method", class_="metric"),
            "Name of the method",
            class_="method",
        ),
    ]
    for key, column in columns.items():
        unit = f"{column.unit} {ARROWS[column.direction]}".strip()
        said = [
            tag("span", s, class_="unit")
            for s in (unit, REPORTED_MARK * column.reported)
            if s
        ]
        head.append(
            _heading(
                key,
                join([tag("span", column.label, class_="metric"), *said]),
                f"{column.meaning} {REPORTED if column.reported else ''}".strip(),
                class_="words" if column.form == "text" else None,
                hidden=key not in main,
                data_unit=column.unit or None,
                data_direction=str(column.direction),
                data_form=None if column.form == "number" else column.form,
            )
        )
    return tag(
        "table",
        tag(
            "caption",
            f"{tab.size.split} {tab.size.name}: methods and scores",
            class_="unseen",
        ),
        tag("thead", tag("tr", *head)),
        tag("tbody", *lines),
        class_="board",
    )


def _heading(key: str, label: object, meaning: str, **attributes: object) -> Markup:
    sorter = tag(
        "button", label, type="button", class_="sorter", data_sort=key, title=meaning
    )
    return tag("th", sorter, scope="col", **attributes)


class _Shades:
    """Colours of a column: the nearer a cell is to the best of entries and floors, the
    deeper.
    """

    def __init__(self, tab: Tab, column: Column) -> None:
        # the floors' costs are measured, and no merit
        judged = [
            row
            for row in tab.lines
            if (row.active if isinstance(row, Row) else not column.reported)
        ]
        self._column = column
        self._known = sorted(
            loss for row in judged if math.isfinite(loss := loss_of(row, column))
        )

    def classes(self, row: Row | ReferenceRow) -> Iterator[str]:
        """Yield the classes of a row's cell."""
        if isinstance(row, Row):
            aside = not row.active
        else:
            aside = self._column.reported
        loss = loss_of(row, self._column)
        if aside or not math.isfinite(loss) or len(self._known) < 2:
            return
        low = self._known[0]
        high = self._known[-1]
        if written(loss, self._column.form) == written(low, self._column.form):
            yield "best"  # what reads the same is no worse
        if (
            self._column.key == "skill"
        ):  # 0 is nothing learned: no entry looks better for a worse one
            high = min(high, 0.0)
        if high > low and len(self._known) >= FEWEST_SHADED:
            bend = math.log if low > 0.0 else float
            yield f"heat{min(SHADES - 1, int(SHADES * (bend(loss) - bend(low)) / (bend(high) - bend(low))))}"


def _cell(
    row: Row | ReferenceRow, column: Column, shades: _Shades, *, main: bool, ranks: bool
) -> Markup:
    value = value_of(row, column)
    found = held(row, column.key)
    plain = round_digits(value) if isinstance(value, float) else value
    if found:
        ends = (found.low, found.high)
    else:
        ends = (math.nan, math.nan)
    bounds = interval(ends)
    if bounds:
        title = [f"95 %: {text(ends[0])} … {text(ends[1])}"]
    else:
        title = []
    if found is not None and not math.isnan(found.std):
        title.append(f"± {text(found.std)} over seeds")
    if found:
        undefined = found.undefined
    else:
        undefined = 0
    title += [f"{undefined} frames undefined"] if undefined else []
    if column.key == "checked" and isinstance(row, Row) and row.verified:
        title = [
            f"scored again by the maintainers, lagbench {row.verified.lagbench}, "
            f"{row.verified.date}"
        ]
    known = isinstance(plain, str) or not math.isnan(plain)
    if column.form == "text":
        kind = ["words"]
    else:
        kind = []
    return tag(
        "td",
        written(plain, column.form),
        tag("sup", "†") if undefined and known else "",
        bounds if ranks else "",
        class_=" ".join([*kind, *shades.classes(row)]) or None,
        title="; ".join(title) or None,
        data_value=(plain if isinstance(plain, str) else f"{plain:.9g}")
        if known
        else None,
        data_loss=f"{loss_of(row, column):.6g}"
        if known and column.direction is Direction.TARGET
        else None,
        data_low=f"{ends[0]:.6g}" if ranks and bounds else None,
        data_high=f"{ends[1]:.6g}" if ranks and bounds else None,
        hidden=not main,
    )


def _line(
    tab: Tab, row: Row | ReferenceRow, number: int, cells: Sequence[Markup]
) -> Markup:
    """Return a row of the table, the floors shaded and never ranked."""
    if isinstance(row, ReferenceRow):
        parts = [
            tag("span", row.name, class_="name"),
            tag("span", "floor", class_="flag"),
            tag("span", row.definition, class_="sub", title=row.definition)
            if row.definition
            else "",
        ]
        method = tag(
            "th", *parts, scope="row", class_="method", data_value=row.name.lower()
        )
        rank = tag("td", "", class_="rank", data_value=number)
        return tag("tr", rank, method, *cells, class_="floor", data_floor=row.name)
    entry = row.entry
    told = f"cannot be told from the leader at 5 % (p = {text(row.p, 2)}, corrected)"
    tied = tag("span", "≈", class_="tied", title=told) if row.tied else ""
    by = " · ".join(filter(None, (", ".join(entry.authors), entry.affiliation)))
    links = [
        tag(
            "a", name, href=address, rel="noopener noreferrer nofollow", target="_blank"
        )
        for name in ("code", "paper", "weights")
        if (address := getattr(entry, name))
        and address.startswith(("http://", "https://"))
    ]
    kept = [
        made.seed for made in entry.predictions if made.weights and not entry.weights
    ]
    for seed in kept:
        if len(kept) == 1:
            label = "weights"
        else:
            label = f"weights {seed}"
        links.append(tag("a", label, href=weights_path(entry.place, seed).as_posix()))
    method = tag(
        "th",
        tag("a", entry.name, href=f"#tab={tab.id}&entry={row.id}", class_="name"),
        *_chips(row),
        tag("span", by, class_="sub", title=by),
        tag("span", *links, class_="links") if links else "",
        scope="row",
        class_="method",
        data_value=entry.name.lower(),
    )
    shown = join([MISSING if row.rank is None else str(row.rank), tied])
    return tag(
        "tr",
        tag("td", shown, class_="rank", data_value=number),
        method,
        *cells,
        class_=None if row.active else "inactive",
        hidden=not row.active,
        data_entry=row.id,
        data_more=f"{entry.training} {entry.hardware}",
    )


def _chips(row: Row) -> Iterator[Markup]:
    """Yield small marks beside a name: status, data set version, flags."""
    entry = row.entry
    if str(entry.status) != "active":
        if entry.superseded_by:
            by = f" Replaced by {entry.superseded_by}."
        else:
            by = ""
        yield _chip(
            "unknown",
            str(entry.status),
            f"{entry.reason or f'This entry is {entry.status}.'}{by}",
        )
    if not row.current:
        said = "Scored on a data set version that is no longer current: not ranked."
        yield _chip("unknown", f"data {entry.dataset.version}", said)
    for kind, flags in (("bad", row.flags), ("warn", row.warnings)):
        for flag in flags:
            # an unknown one is called as the scorer does
            label, meaning = EXPLAINED.get(flag.name, (flag.name.replace("_", " "), ""))
            if flag.share is not None:
                label = f"{label}: {text(100.0 * flag.share, 2)} %"
            if kind == "warn":
                most = MOST_REASONS
            else:
                most = len(flag.reasons)
            more = len(flag.reasons) - most
            said = "; ".join(
                [*flag.reasons[:most], *([f"and {more} more such"] if more > 0 else [])]
            )
            yield _chip(
                kind,
                label,
                " ".join(filter(None, (meaning, f"{said}." if said else ""))),
            )
    if row.diverged:
        yield _chip(
            "warn",
            "diverged",
            f"{row.diverged} rollouts are frozen at their last finite frame.",
        )


def _chip(kind: str, label: str, meaning: str) -> Markup:
    return tag("span", label, class_=f"flag {kind}", title=meaning)
