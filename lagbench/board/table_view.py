"""The board's table as data: columns, and lines of cells with their text and notes.

`draw_table` draws it as HTML, and the page's script sorts and filters by the same data.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from lagbench.data.checksums import round_digits
from lagbench.figures.numbers import text
from lagbench.metrics.metric import Direction, Metric

from .columns import (
    AGAINST_CLASSICAL,
    HAS_GAPS,
    SKILL,
    SOLVER_COSTS_MORE,
    Column,
    TableRow,
    columns_of,
    format_value,
    is_beside_dearer_solver,
    loss_of,
    metric_value,
    presets_of,
    value_of,
)
from .entry import Entry, EntryFlag, Verification
from .folder import weights_path
from .model import BoardRow, ReferenceRow, Tab, Value

MOST_REASONS = 4
"""Reasons of a warning that are shown; those of other scenarios say the same with other
numbers.
"""

SHADES = 5
FEWEST_SHADED = 3  # values that a column needs for shades

LABELS: Mapping[str, tuple[str, str]] = {
    "copy_suspect": (
        "copy suspected",
        "The error moves from frame to frame as that of no rollout does.",
    ),
    "below_twin_floor": (
        "below the predictability limit",
        "Closer to the truth than the solver itself from positions off by 2⁻²⁰.",
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
"""Label and meaning of flags and warnings on the page."""

SLOW = (
    "slower than simulator",
    "A frame costs this solver more than the simulator that made the data. It shows "
    "which error a solver reaches, and saves no time.",
)
"""Label and meaning of the mark beside a classical solver of a high cost."""

UNDER_TRAINED = (
    "under-trained",
    "Its weights fail a gate of competence and take part in no claim.",
)
"""Label and meaning of the mark beside an entry whose weights fail a gate."""

DIVERGED = ("diverged", "Rollouts are frozen at their last finite frame.")
"""Label and meaning of the mark beside an entry with rollouts that ended early."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One cell."""

    value: float | str  # NaN or an empty text where there is none
    loss: float  # smaller is better; NaN where nothing is judged
    text: str
    note: str  # interval, spread and gaps in words
    interval: tuple[float, float] | None  # 95 %, where the column ranks
    sign: str  # behind the text: HAS_GAPS, SOLVER_COSTS_MORE or ""
    classes: tuple[str, ...]  # classes of its colours

    @property
    def is_known(self) -> bool:
        """Whether there is a value; a text that is empty counts as one."""
        return isinstance(self.value, str) or not math.isnan(self.value)


@dataclass(frozen=True, kw_only=True)
class Chip:
    """A small mark beside a name: status, data set version, flag or warning."""

    kind: str  # class: bad, warn or unknown
    label: str
    meaning: str


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of the table."""

    row: TableRow
    place: int  # in the order of the ranking metric
    cells: Mapping[str, Cell]  # by key of the column
    chips: Sequence[Chip]
    byline: str  # authors and affiliation
    links: Sequence[tuple[str, str]]  # labels and addresses

    @property
    def id(self) -> str:
        """Name in addresses: id of the method, or name of the reference predictor."""
        if isinstance(self.row, ReferenceRow):
            return self.row.name
        return self.row.id

    @property
    def name(self) -> str:
        """Name of the method or reference predictor."""
        if isinstance(self.row, ReferenceRow):
            return self.row.name
        return self.row.entry.name


@dataclass(frozen=True, kw_only=True)
class TableView:
    """The table of a tab."""

    tab: Tab
    columns: Mapping[str, Column]
    presets: Mapping[str, Sequence[str]]  # keys of columns
    lines: Sequence[Line]  # in the order of the ranking metric, inactive ones last

    @property
    def main(self) -> Sequence[str]:
        """Keys of the columns that are shown at first."""
        return self.presets["main"]

    def ranks(self, key: str) -> bool:
        """Tell whether a column ranks: it shows intervals."""
        return key in (self.tab.ranking, SKILL.key)


def make_table(tab: Tab, metrics: Mapping[str, Metric]) -> TableView:
    """Return the table of a tab."""
    columns = columns_of(tab, metrics)
    ranking = columns[tab.ranking]
    painters = {key: _Painter(tab, column) for key, column in columns.items()}

    methods = {row.id: row for row in tab.rows}

    def order(row: TableRow) -> tuple[bool, float, bool, float]:
        own_loss = loss_in_order(row)
        if isinstance(row, BoardRow) and row.active and row.variant_of in methods:
            # variants stand behind their method
            method = methods[row.variant_of]
            return False, loss_in_order(method), True, own_loss
        is_inactive = isinstance(row, BoardRow) and not row.active
        return is_inactive, own_loss, False, own_loss

    def loss_in_order(row: TableRow) -> float:
        loss = ranking.loss(float(value_of(row, ranking)))
        if math.isnan(loss):
            return math.inf
        return loss

    lines = []
    rows = sorted(tab.lines, key=order)
    for place, row in enumerate(rows):
        cells = {}
        for key, column in columns.items():
            classes = tuple(painters[key].classes_of(row))
            ranks = key in (tab.ranking, SKILL.key)
            cells[key] = _make_cell(row, column, classes=classes, ranks=ranks)
        line = _make_line(row, place, cells)
        lines.append(line)
    return TableView(
        tab=tab, columns=columns, presets=presets_of(tab, columns), lines=lines
    )


class _Painter:
    """Colours of a column: the nearer a cell is to the best, the deeper.

    Entries and reference predictors are judged alike. Costs of reference predictors are
    measured, and no merit: they are not judged.
    """

    def __init__(self, tab: Tab, column: Column) -> None:
        self._column = column
        losses = []
        for row in tab.lines:
            loss = loss_of(row, column)
            if self._is_judged(row) and math.isfinite(loss):
                losses.append(loss)
        self._losses = sorted(losses)

    def _is_judged(self, row: TableRow) -> bool:
        if isinstance(row, BoardRow):
            return row.active
        return not self._column.reported and not self._column.of_cost

    def classes_of(self, row: TableRow) -> Iterator[str]:
        """Yield the classes of a row's cell."""
        loss = loss_of(row, self._column)
        is_judged = self._is_judged(row) and math.isfinite(loss)
        if not is_judged or len(self._losses) < 2:
            return
        best = self._losses[0]
        worst = self._losses[-1]
        form = self._column.form
        if format_value(loss, form) == format_value(best, form):
            yield "best"  # equal in the digits shown
        if self._column is SKILL:
            # 0 is nothing learned: no entry looks better beside a worse one
            worst = min(worst, 0.0)
        if worst > best and len(self._losses) >= FEWEST_SHADED:
            yield f"heat{_shade_of(loss, best=best, worst=worst)}"


def _shade_of(loss: float, *, best: float, worst: float) -> int:
    """Return the number of a shade, 0 for the deepest; logarithmic for losses > 0."""
    if best > 0.0:
        share = math.log(loss / best) / math.log(worst / best)
    else:
        share = (loss - best) / (worst - best)
    return min(SHADES - 1, int(SHADES * share))


def _make_cell(
    row: TableRow, column: Column, *, classes: tuple[str, ...], ranks: bool
) -> Cell:
    value = value_of(row, column)
    if isinstance(value, float):
        value = round_digits(value)
    metric = metric_value(row, column.key)
    interval = None
    if ranks and metric is not None and not math.isnan(metric.low + metric.high):
        interval = (metric.low, metric.high)
    if column.form == "text":
        classes = ("words", *classes)
    return Cell(
        value=value,
        loss=loss_of(row, column),
        text=format_value(value, column.form),
        note=_note_on(row, column, metric),
        interval=interval,
        sign=_sign_of(row, column, metric),
        classes=classes,
    )


def _sign_of(row: TableRow, column: Column, metric: Value | None) -> str:
    """Return the sign behind a number, which the text below the table explains."""
    if metric is None or math.isnan(metric.mean):
        return ""
    if metric.undefined:
        return HAS_GAPS
    if column is AGAINST_CLASSICAL and is_beside_dearer_solver(row):
        return SOLVER_COSTS_MORE
    return ""


def _note_on(row: TableRow, column: Column, metric: Value | None) -> str:
    if column.key == "checked" and isinstance(row, BoardRow) and row.verified:
        return describe_verification(row.verified)
    if metric is None:
        return ""
    notes = []
    if _sign_of(row, column, metric) == SOLVER_COSTS_MORE:
        notes.append("the classical solver costs more than the model")
    if not math.isnan(metric.low + metric.high):
        notes.append(f"95 %: {text(metric.low)} … {text(metric.high)}")
    if not math.isnan(metric.std):
        notes.append(f"± {text(metric.std)} over seeds")
    if metric.undefined:
        notes.append(f"{metric.undefined} frames undefined")
    return "; ".join(notes)


def describe_verification(verified: Verification) -> str:
    """Return who followed the scores of an entry how far, in words."""
    parts = [f"{verified.level}, lagbench {verified.lagbench}, {verified.date}"]
    for reproduction in verified.reproduced:
        seed = "" if reproduction.seed is None else f"seed {reproduction.seed}: "
        parts.append(
            f"{seed}{text(reproduction.submitted)} submitted, "
            f"{text(reproduction.reproduced)} predicted anew on "
            f"{reproduction.scenarios} of {reproduction.of} scenarios"
        )
    return "; ".join(parts)


def _make_line(row: TableRow, place: int, cells: Mapping[str, Cell]) -> Line:
    if isinstance(row, ReferenceRow):
        return Line(
            row=row,
            place=place,
            cells=cells,
            chips=tuple(_chips_of_reference(row)),
            byline=row.definition,
            links=(),
        )
    entry = row.entry
    parts = [", ".join(entry.authors), entry.affiliation]
    return Line(
        row=row,
        place=place,
        cells=cells,
        chips=tuple(chips_of(row)),
        byline=" · ".join(part for part in parts if part),
        links=tuple(_links_of(entry)),
    )


def _links_of(entry: Entry) -> Iterator[tuple[str, str]]:
    """Yield labels and addresses of code, paper and weights."""
    for label in ("code", "paper", "weights"):
        address = getattr(entry, label)
        if address and address.startswith(("http://", "https://")):
            yield label, address
    if entry.weights:
        return
    models = []
    for prediction in entry.predictions:
        if prediction.weights:
            # the path follows from the place, the entry's own words are not believed
            place = prediction.weights.place_of(entry.place)
            path = weights_path(place, prediction.seed, prediction.weights.path)
            models.append((prediction.seed, path))
    for seed, path in models:
        label = f"weights {seed}"
        if len(models) == 1:
            label = "weights"
        yield label, path.as_posix()


def _chips_of_reference(row: ReferenceRow) -> Iterator[Chip]:
    """Yield the marks beside the name of a reference predictor."""
    yield Chip(kind="", label=str(row.kind), meaning="")
    if row.is_slow:
        label, meaning = SLOW
        yield Chip(kind="", label=label, meaning=meaning)


def chips_of(row: BoardRow) -> Iterator[Chip]:
    """Yield the marks beside a name."""
    entry = row.entry
    if str(entry.status) != "active":
        meaning = entry.reason or f"This entry is {entry.status}."
        if entry.superseded_by:
            meaning += f" Replaced by {entry.superseded_by}."
        yield Chip(kind="unknown", label=str(entry.status), meaning=meaning)
    if not row.current:
        yield Chip(
            kind="unknown",
            label=f"data {entry.dataset.version}",
            meaning="Scored on a data set version that is no longer current: not "
            "ranked.",
        )
    if row.failed_gates:
        label, meaning = UNDER_TRAINED
        gates = ", ".join(row.failed_gates)
        yield Chip(kind="warn", label=label, meaning=f"{meaning} Failed: {gates}.")
    for flag in row.flags:
        yield _chip_of(flag, kind="bad", most_reasons=len(flag.reasons))
    for warning in row.warnings:
        yield _chip_of(warning, kind="warn", most_reasons=MOST_REASONS)
    if row.diverged:
        label, meaning = DIVERGED
        yield Chip(
            kind="warn", label=label, meaning=f"{meaning} Rollouts: {row.diverged}."
        )


def _chip_of(flag: EntryFlag, *, kind: str, most_reasons: int) -> Chip:
    """Return the mark of a flag; a flag that is unknown here keeps its own name."""
    label, meaning = LABELS.get(flag.name, (flag.name.replace("_", " "), ""))
    if flag.share is not None:
        label = f"{label}: {text(100.0 * flag.share, 2)} %"
    reasons = list(flag.reasons[:most_reasons])
    hidden_count = len(flag.reasons) - len(reasons)
    if hidden_count:
        reasons.append(f"and {hidden_count} more such")
    sentences = [meaning]
    if reasons:
        sentences.append(f"{'; '.join(reasons)}.")
    return Chip(kind=kind, label=label, meaning=" ".join(filter(None, sentences)))


def target_loss(cell: Cell, column: Column) -> float | None:
    """Return the loss of a metric that aims at a value; None elsewhere."""
    if column.direction is Direction.TARGET and cell.is_known:
        return cell.loss
    return None
