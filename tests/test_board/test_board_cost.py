"""Accuracy against cost: places of dots, the front, and what those who do not see it
are told.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from sample_boards import make_board
from typer.testing import CliRunner

from lagbench.board.cost import (
    CostPoint,
    draw,
    find_front,
    points_of,
    simulator_seconds,
)
from lagbench.board.entry import EntryCost, MeasuredCost, Verification
from lagbench.board.model import Tab
from lagbench.cli.program import app
from lagbench.data.registry import load
from lagbench.figures.chart import close_logarithmic
from lagbench.references import shipped, solver_seconds


@pytest.fixture(scope="module")
def tab() -> Tab:
    """A tab with eight entries, one of which says nothing about cost."""
    return make_board((("cavity", "mini"),)).tabs[0]


def drawn(points: list[CostPoint], solver: float | None) -> ElementTree.Element:
    """Return the picture of some points."""
    svg = draw(points, solver, "vorticity_nrmse", "title")
    return ElementTree.fromstring(svg)


def seconds_by_name(tab: Tab) -> dict[str, float]:
    """Return where points stand along the axis of cost."""
    return {point.name: point.seconds for point in points_of(tab)}


def point(seconds: float, error: float, kind: str = "learned") -> CostPoint:
    """Return a point named after its place."""
    return CostPoint(
        name=f"{seconds:g} {error:g}",
        seconds=seconds,
        error=error,
        kind=kind,
    )


def test_costs_are_those_of_the_solvers_machine(tab: Tab) -> None:
    """An entry twice as fast as the solver on its own machine costs half of the solver
    here.
    """
    raw = seconds_by_name(tab)
    here = seconds_by_name(replace(tab, solver_seconds=0.02))
    silent = set()
    for row in tab.rows:
        name = row.entry.name
        cost = row.entry.cost
        if cost is None:
            silent.add(name)
        elif row.active:
            assert raw[name] == cost.seconds_per_frame
            speed_up = cost.speed_up or math.nan
            assert here[name] == pytest.approx(0.02 / speed_up)
    assert silent
    assert silent.isdisjoint(raw)


def measured_in(run: int, seconds: float) -> Verification:
    """Return a cost that was measured in a run, in which the solver took 0.25 s."""
    cost = MeasuredCost(
        machine="a machine",
        date="2026-01-02",
        repeats=run,
        seconds_per_frame=seconds,
        solver=0.25,
        classical={"projection": 0.125},
    )
    return Verification.model_construct(cost=cost, reproduced=(), blind=None)


def test_all_times_are_those_of_the_run_that_measured_the_entries(tab: Tab) -> None:
    """As in the table of results: what the run lacks is converted by the solver."""
    first, second, *others = [row for row in tab.rows if row.active]
    rows = (
        replace(first, verified=measured_in(1, 0.5)),
        replace(second, verified=measured_in(1, 0.75)),
        *others,
    )
    elsewhere = EntryCost(
        seconds_per_frame=0.04, device="another", solver_seconds_per_frame=0.02
    )
    in_run, not_in_run = tab.references
    references = (
        replace(in_run, name="projection", cost=elsewhere),
        replace(not_in_run, name="analog", cost=elsewhere),
    )
    measured_tab = replace(tab, rows=rows, references=references, solver_seconds=0.02)
    assert simulator_seconds(measured_tab) == 0.25
    seconds = seconds_by_name(measured_tab)
    assert seconds[first.entry.name] == pytest.approx(0.5)
    assert seconds[second.entry.name] == pytest.approx(0.75)
    assert seconds["projection"] == 0.125
    assert seconds["analog"] == pytest.approx(0.5)


def test_times_of_two_runs_are_converted_by_the_solver(tab: Tab) -> None:
    """Twice the time of the solver in its own run is twice that of the solver here."""
    first, second, *others = [row for row in tab.rows if row.active]
    rows = (
        replace(first, verified=measured_in(1, 0.5)),
        replace(second, verified=measured_in(2, 0.75)),
        *others,
    )
    measured_tab = replace(tab, rows=rows, solver_seconds=0.02)
    assert simulator_seconds(measured_tab) == 0.02
    seconds = seconds_by_name(measured_tab)
    assert seconds[first.entry.name] == pytest.approx(0.04)
    assert seconds[second.entry.name] == pytest.approx(0.06)


def test_the_front_holds_what_no_other_beats() -> None:
    """By hand: (2, 5) is beaten by (1, 4); (3, 4) costs more than (1, 4) and is no
    better.
    """
    points = [
        point(2, 5),
        point(1, 4),
        point(3, 4),
        point(4, 1),
        point(5, 0.5),
    ]
    front = [(one.seconds, one.error) for one in find_front(points)]
    assert front == [(1, 4), (4, 1), (5, 0.5)]


def classes_of(element: ElementTree.Element) -> list[str]:
    """Return the classes of an element."""
    return element.attrib.get("class", "").split()


def place_of(circle: ElementTree.Element) -> tuple[float, float]:
    """Return the middle of a circle."""
    x = float(circle.attrib["cx"])
    y = float(circle.attrib["cy"])
    return x, y


def test_dots_stand_where_their_numbers_say(tab: Tab) -> None:
    """Ten times the cost is the same step to the right; every dot has words and the
    keyboard reaches it.
    """
    points = [
        point(0.001, 1.0),
        point(0.01, 0.5),
        point(0.1, 0.25, "classical"),
        point(0.05, 0.9, "naive"),
    ]
    svg = drawn(points, 0.02)
    dots = [element for element in svg.iter() if "tabindex" in element.attrib]
    first, second, third, _ = [place_of(dot[1]) for dot in dots]
    first_step = np.subtract(second, first)
    second_step = np.subtract(third, second)
    assert first_step == pytest.approx(second_step, abs=0.2)
    assert first_step[1] > 0  # less error stands lower

    for one, dot in zip(points, dots, strict=True):
        assert dot[0].tag.endswith("title")
        assert dot[0].text.startswith(one.name)
        assert dot.attrib["tabindex"] == "0"
    assert svg.attrib["role"] == "group"
    assert svg.find(".//script") is None


class Box(NamedTuple):
    """A rectangle on the picture; y grows downwards."""

    left: float
    top: float
    right: float
    bottom: float

    def overlaps(self, other: Box) -> bool:
        """Tell whether two rectangles share an area."""
        is_beside = self.right <= other.left or other.right <= self.left
        is_above = self.bottom <= other.top or other.bottom <= self.top
        return not is_beside and not is_above


def text_boxes(
    svg: ElementTree.Element, kind: str, letter_width: float = 6.0
) -> list[Box]:
    """Return the boxes of the texts of a kind."""
    boxes = []
    for text in svg.iter("text"):
        classes = classes_of(text)
        if classes[0] != kind:
            continue
        width = letter_width * len(text.text or "")
        shares = {"end": 1.0, "middle": 0.5}
        share = shares.get(classes[-1], 0.0)
        left = float(text.attrib["x"]) - share * width
        base = float(text.attrib["y"])
        boxes.append(Box(left, base - 9, left + width, base + 2))
    return boxes


def dot_boxes(svg: ElementTree.Element) -> list[Box]:
    """Return the boxes of all circles."""
    boxes = []
    for circle in svg.iter("circle"):
        x, y = place_of(circle)
        boxes.append(Box(x - 3, y - 3, x + 3, y + 3))
    return boxes


def test_names_do_not_meet_names_or_dots() -> None:
    """Twenty dots in one place and five near it: no name covers another or a dot."""
    points = []
    for number in range(20):
        seconds = 0.01 * (1 + number / 1000)
        points.append(point(seconds, 0.5))
    for number in range(5):
        seconds = 0.01 * (1.2 + number / 5)
        error = 0.45 + 0.04 * number
        points.append(point(seconds, error))
    svg = drawn(points, 0.02)
    texts = text_boxes(svg, "name") + text_boxes(svg, "note")
    assert len(texts) > 3
    dots = dot_boxes(svg)
    for number, text in enumerate(texts):
        for other in (*texts[:number], *dots):
            assert not text.overlaps(other)


def test_a_crowd_at_the_edge_keeps_its_names() -> None:
    """Six dots, five of them close together near the right edge: each has its name."""
    places = {
        "VAR(1)": (0.052, 50.0),
        "SuperGAT": (0.075, 1.2),
        "GNS": (0.045, 0.89),
        "GNS, noise 1e-3": (0.036, 0.59),
        "analog": (0.0245, 1.5),
        "persistence": (4e-6, 1.0),
    }
    points = []
    for name, (seconds, error) in places.items():
        cost = CostPoint(name=name, seconds=seconds, error=error, kind="learned")
        points.append(cost)
    svg = drawn(points, None)
    words = []
    for line in svg.iter("text"):  # a long name has two lines
        if classes_of(line)[0] == "name":
            words += line.text.split()
    assert sorted(words) == sorted(" ".join(places).split())


def test_axes_end_past_their_values() -> None:
    """All ticks within the axis; values a step off its ends."""
    scale = close_logarithmic(0.3, 1.4)
    assert scale.low < 0.3
    assert scale.high > 1.4
    for tick in scale.ticks:
        assert scale.low <= tick.value <= scale.high
    decades = close_logarithmic(1e-6, 1e-2)
    first_tick = decades.ticks[0]
    assert first_tick.label in ("10⁻⁶", "10⁻⁷")


def test_a_picture_of_what_has_no_entry(tmp_path: Path) -> None:
    """Without any entry the chart shows reference predictors and the simulator."""
    board = tmp_path / "board"
    (board / "submissions").mkdir(parents=True)
    target = tmp_path / "cost.svg"
    words = ["leaderboard", "picture", "cavity", "--size", "mini"]
    options = ["--board", str(board), "-o", str(target)]
    result = CliRunner().invoke(app, [*words, *options])
    assert result.exit_code == 0, result.output
    refused = CliRunner().invoke(app, [*words, *options])
    assert refused.exit_code == 2
    assert "--overwrite" in refused.output
    replaced = CliRunner().invoke(app, [*words, *options, "--overwrite"])
    assert replaced.exit_code == 0, replaced.output
    svg = target.read_text()
    ElementTree.fromstring(svg)
    size = load().size("cavity", "mini")
    for name in shipped(size) or {}:
        assert name in svg
    assert "the simulator" in svg
    assert (solver_seconds(size) or 0.0) > 0.0
    assert not re.search("<script|href=", svg)
