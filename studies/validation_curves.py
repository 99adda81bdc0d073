"""Draw the validation curve of every committed training.

    python -m studies.validation_curves -o docs/figures/validation_curves.svg
        [--board leaderboard]

One chart per data set; a line per training: the validation error over the windows that
the training had seen. Windows of earlier trainings, from whose weights it started,
count too. The values stand in the budgets of the entries, or in the record beside the
weights. A training that was validated once is a dot. Fits in one step, and trainings
that were validated by another metric than the ranking one, are left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lagbench.atomic import write_atomically
from lagbench.board.entry import Entry, Prediction, Status
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder, weights_path
from lagbench.errors import LagbenchError, UsageError, format_count
from lagbench.figures.chart import Plot, Spot, close_logarithmic
from lagbench.figures.html import Markup
from lagbench.figures.numbers import words
from lagbench.figures.tables import markdown

from .panels import join_charts

HEIGHT = 300
NAME_ROOM = 12.0  # the axis of windows reaches so many times the longest training

FAMILIES = (
    ("neuralmpm", "s0"),
    ("gns", "s1"),
    ("supergat", "s2"),
    ("hybrid", "s4"),
    ("mlp", "s5"),
    ("lstm", "s5"),
)
"""Colours by the beginning of a method's id; other graph networks share one."""

OTHER_COLOUR = "s3"


@dataclass(frozen=True, kw_only=True)
class ValidationCurve:
    """The validations of one training."""

    name: str  # of the method
    seed: int | None
    colour: str
    metric: str
    windows: tuple[float, ...]  # seen at each validation
    errors: tuple[float, ...]

    @property
    def gain(self) -> float | None:
        """Share by which the best error fell over the second half of the windows."""
        early = []
        for windows, error in zip(self.windows, self.errors, strict=True):
            if windows <= 0.5 * self.windows[-1] * (1.0 + 1e-9):
                early.append(error)
        if not early:
            return None
        return 1.0 - min(self.errors) / min(early)


def curves_of(folder: Folder) -> dict[tuple[str, str], list[ValidationCurve]]:
    """Return the curves of active entries by data set; averaged rows have none."""
    curves: dict[tuple[str, str], list[ValidationCurve]] = {}
    for path in folder.entries():
        entry = read_entry(folder.path / path)
        if entry.status is not Status.ACTIVE or entry.method.endswith("-averaged"):
            continue
        for curve in _curves_of_entry(folder, entry):
            curves.setdefault((entry.split, entry.size), []).append(curve)
    return curves


def _curves_of_entry(folder: Folder, entry: Entry) -> Iterator[ValidationCurve]:
    colour = OTHER_COLOUR
    for beginning, family_colour in FAMILIES:
        if entry.method.startswith(beginning):
            colour = family_colour
    for prediction in entry.predictions:
        metric, validations = _validations_of(folder, entry, prediction)
        windows_per_step = _windows_per_step(folder, entry, prediction)
        # a fit in one step has no curve; early trainings were validated otherwise
        if windows_per_step is None or metric != entry.score.ranking_metric:
            continue
        windows = []
        errors = []
        start_steps = 0
        if prediction.budget is not None:
            start_steps = prediction.budget.start_steps or 0
        for step, error in validations:
            all_steps = start_steps + step
            if all_steps > 0 and error > 0.0:
                windows.append(all_steps * windows_per_step)
                errors.append(error)
        if windows:
            yield ValidationCurve(
                name=entry.name,
                seed=prediction.seed,
                colour=colour,
                metric=metric,
                windows=tuple(windows),
                errors=tuple(errors),
            )


def _windows_per_step(
    folder: Folder, entry: Entry, prediction: Prediction
) -> float | None:
    """Return the windows of a training step; None where nothing says it."""
    budget = prediction.budget
    if budget is not None:
        if not budget.windows or not budget.steps:
            return None
        return budget.windows / budget.steps
    recipe = _read_log(folder, entry, prediction).get("recipe", {})
    batch = recipe.get("training", {}).get("batch")
    return None if batch is None else float(batch)


def _read_log(folder: Folder, entry: Entry, prediction: Prediction) -> dict[str, Any]:
    """Return the record beside the weights; empty without one."""
    path = folder.path / weights_path(entry.place, prediction.seed).with_suffix(".json")
    if not path.is_file():
        return {}
    log: dict[str, Any] = json.loads(path.read_bytes())
    return log


def _validations_of(
    folder: Folder, entry: Entry, prediction: Prediction
) -> tuple[str | None, list[tuple[int, float]]]:
    """Return metric, and step and error of each validation."""
    budget = prediction.budget
    if budget is not None and budget.validations:
        return budget.metric, list(budget.validations)
    log = _read_log(folder, entry, prediction)
    metric = None
    validations = []
    for record in log.get("validation", ()):
        for name, value in record.items():
            if name != "step":
                metric = name
                validations.append((int(record["step"]), float(value)))
    return metric, validations


def draw(data_set: tuple[str, str], curves: Sequence[ValidationCurve]) -> Markup:
    """Return the chart of a data set."""
    where = " ".join(data_set)
    all_windows: list[float] = []
    all_errors: list[float] = []
    for curve in curves:
        all_windows += curve.windows
        all_errors += curve.errors
    plot = Plot(
        close_logarithmic(min(all_windows), NAME_ROOM * max(all_windows)),
        close_logarithmic(min(all_errors), max(all_errors)),
        x_label="windows seen",
        y_label=f"{where}: {words(curves[0].metric)} on valid",
        height=HEIGHT,
    )
    spots = []
    names = set()
    for curve in curves:
        title = curve.name
        if curve.seed is not None:
            title += f", seed {curve.seed}"
        plot.line(curve.windows, curve.errors, curve.colour, title)
        name = ""
        if curve.name not in names:
            name = curve.name
        names.add(curve.name)
        spot = Spot(
            x=curve.windows[-1],
            y=curve.errors[-1],
            name=name,
            description=f"{title}: {curve.errors[-1]:.3g} in the end",
            kind=curve.colour,
        )
        spots.append(spot)
    plot.spots(spots)
    trainings = format_count(len(curves), "training")
    return plot.svg(where, f"{where}: validation errors of {trainings}.")


def table(curves: dict[tuple[str, str], list[ValidationCurve]]) -> str:
    """Return trainings with four validations or more, as Markdown."""
    heads = (
        "data set",
        "training",
        "validations",
        "first",
        "best",
        "gain of the second half",
    )
    rows = []
    for data_set, of_set in curves.items():
        for curve in of_set:
            gain = curve.gain
            if len(curve.errors) < 4 or gain is None:
                continue
            seed = "" if curve.seed is None else f", seed {curve.seed}"
            rows.append(
                (
                    " ".join(data_set),
                    f"{curve.name}{seed}",
                    len(curve.errors),
                    f"{curve.errors[0]:.3g}",
                    f"{min(curve.errors):.3g}",
                    f"{100.0 * gain:.0f} %",
                )
            )
    return markdown(heads, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the figure and print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.validation_curves",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--board", type=Path, default=Path("leaderboard"))
    parser.add_argument(
        "--output", "-o", type=Path, default=Path("docs/figures/validation_curves.svg")
    )
    options = parser.parse_args(arguments)
    try:
        curves = curves_of(Folder(options.board))
        if not curves:
            raise UsageError(
                "no training on this board has a curve of validations",
                where="--board",
                expected="a folder with weights and the records of their trainings",
                got=str(options.board),
                fix="run it from the root of the clone, or name it: --board FOLDER",
            )
        charts = []
        for data_set, of_set in curves.items():
            charts.append(draw(data_set, of_set))
        svg = join_charts(charts, height=HEIGHT)
        write_atomically(options.output, svg.encode(), option="--output")
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{table(curves)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
