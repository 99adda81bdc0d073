"""Accuracy against cost: places of dots, the front, and what those who do not see it
are told.
"""

from __future__ import annotations

import datetime
import math
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from command_line import CliRunner
from sample_boards import make_board

from lagbench.board.build import Scope, collect
from lagbench.board.cost import CostPoint, draw, find_front, points_of
from lagbench.board.entry import MeasuredCost, Verification
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


def test_measured_costs_count_before_stated_ones(tab: Tab) -> None:
    """The figure has the costs of the table."""
    first_row, *others = tab.rows
    measured = MeasuredCost.model_construct(
        seconds_per_frame=0.5, machine="a machine", solver=0.25, classical={}
    )
    verified = Verification.model_construct(cost=measured, reproduced=())
    row = replace(first_row, verified=verified)
    with_measured = replace(tab, rows=(row, *others), solver_seconds=0.02)
    assert seconds_by_name(with_measured)[row.entry.name] == pytest.approx(0.04)


BOARD = Path(__file__).parents[2] / "leaderboard"
MINI = "submissions/poiseuille/mini"


@pytest.fixture
def committed(tmp_path: Path) -> Path:
    """A copy of poiseuille of the committed leaderboard, measured in one run."""
    for folder in ("submissions", "scores"):
        shutil.copytree(BOARD / folder / "poiseuille", tmp_path / folder / "poiseuille")
    lines = yaml.safe_load((BOARD / "verified.yaml").read_text())
    of_mini = {path: line for path, line in lines.items() if path.startswith(MINI)}
    (tmp_path / "verified.yaml").write_text(yaml.safe_dump(of_mini))
    return tmp_path


def read_tab(board: Path) -> Tab:
    """Return the tab of poiseuille mini, without pictures."""
    scope = Scope(metrics=(), intervals=(), has_pictures=False)
    (only_tab,) = collect(board, only=[("poiseuille", "mini")], scope=scope).tabs
    return only_tab


def costs_of_references(tab: Tab) -> dict[str, float]:
    """Return the times of the reference predictors in the table."""
    seconds = {}
    for row in tab.references:
        assert row.cost is not None
        seconds[row.name] = row.cost.seconds_per_frame
    return seconds


def test_all_times_are_those_of_the_run_that_measured_the_entries(
    committed: Path,
) -> None:
    """In the table and in the figure; what a run lacks is converted by the solver."""
    lines = yaml.safe_load((committed / "verified.yaml").read_text())
    run = lines[f"{MINI}/neuralmpm.yaml"]["cost"]
    size = load().size("poiseuille", "mini")
    elsewhere = shipped(size)
    solver_elsewhere = solver_seconds(size)
    assert elsewhere is not None
    assert solver_elsewhere is not None

    tab = read_tab(committed)
    assert tab.run is not None
    assert tab.solver_seconds == run["solver"]
    costs = costs_of_references(tab)
    times = {**run["classical"], **run["naive"]}
    assert times
    assert costs.keys() > times.keys()
    for name, seconds in costs.items():
        converted = elsewhere[name].seconds_per_frame / solver_elsewhere * run["solver"]
        assert seconds == pytest.approx(times.get(name, converted))
    in_figure = seconds_by_name(tab)
    for row in tab.rows:
        line = lines[f"{MINI}/{row.entry.method}.yaml"]
        seconds = line["cost"]["seconds_per_frame"]
        assert in_figure[row.entry.name] == pytest.approx(seconds)
    for name, seconds in costs.items():
        assert in_figure[name] == pytest.approx(seconds)


def other_run(cost: dict[str, Any]) -> None:
    """Make the cost one of another run."""
    cost["date"] = datetime.date(2026, 1, 2)


def no_solver(cost: dict[str, Any]) -> None:
    """Leave out the time of the solver."""
    del cost["solver"]


@pytest.mark.parametrize("change", [other_run, no_solver])
def test_without_one_run_the_times_of_the_references_stay(
    committed: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    """Two runs, or a run without a time of the solver."""
    verified = committed / "verified.yaml"
    lines = yaml.safe_load(verified.read_text())
    changed = list(lines.values())
    if change is other_run:
        changed = changed[:1]
    for line in changed:
        change(line["cost"])
    verified.write_text(yaml.safe_dump(lines))

    size = load().size("poiseuille", "mini")
    elsewhere = shipped(size)
    assert elsewhere is not None
    tab = read_tab(committed)
    assert tab.run is None
    assert tab.solver_seconds == solver_seconds(size)
    for name, seconds in costs_of_references(tab).items():
        assert seconds == elsewhere[name].seconds_per_frame


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
