"""Accuracy against cost: places of dots, the front, and what those who do not see it
are told.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest
from board_worlds import make_board
from typer.testing import CliRunner

from lagbench.__main__ import app
from lagbench.board.cost import Mark, draw, front, marks_of
from lagbench.board.model import Tab
from lagbench.data.registry import load
from lagbench.figures.chart import close_logarithmic
from lagbench.references import shipped, solver_seconds


@pytest.fixture(scope="module")
def tab() -> Tab:
    """A tab with eight entries, one of which says nothing about cost."""
    return make_board((("cavity", "mini"),)).tabs[0]


def mark(seconds: float, error: float, kind: str = "entry") -> Mark:
    """Return a mark named after its place."""
    return Mark(name=f"{seconds:g} {error:g}", seconds=seconds, error=error, kind=kind)


def test_costs_are_those_of_the_solvers_machine(tab: Tab) -> None:
    """An entry twice as fast as the solver on its own machine costs half of the solver
    here.
    """
    raw = {one.name: one.seconds for one in marks_of(tab)}
    here = {
        one.name: one.seconds for one in marks_of(replace(tab, solver_seconds=0.02))
    }
    for row in tab.rows:
        if row.active and row.entry.cost is not None:
            assert raw[row.entry.name] == row.entry.cost.seconds_per_frame
            assert here[row.entry.name] == pytest.approx(
                0.02 / (row.entry.cost.speed_up or math.nan)
            )
    silent = {row.entry.name for row in tab.rows if row.entry.cost is None}
    assert silent
    assert silent.isdisjoint(raw)


def test_the_front_holds_what_no_other_beats() -> None:
    """By hand: (2, 5) is beaten by (1, 4); (3, 4) costs more than (1, 4) and is no
    better.
    """
    marks = [mark(2, 5), mark(1, 4), mark(3, 4), mark(4, 1), mark(5, 0.5)]
    assert [(one.seconds, one.error) for one in front(marks)] == [
        (1, 4),
        (4, 1),
        (5, 0.5),
    ]


def test_dots_stand_where_their_numbers_say(tab: Tab) -> None:
    """Ten times the cost is the same step to the right; every dot has words and the
    keyboard reaches it.
    """
    marks = [
        mark(0.001, 1.0),
        mark(0.01, 0.5),
        mark(0.1, 0.25, "coarse"),
        mark(0.05, 0.9, "floor"),
    ]
    svg = ElementTree.fromstring(draw(marks, 0.02, "vorticity_nrmse", "title"))
    dots = [e for e in svg.iter() if "dot" in e.attrib.get("class", "").split()]
    places = [(float(e[1].attrib["cx"]), float(e[1].attrib["cy"])) for e in dots]
    (x0, y0), (x1, y1), (x2, y2), _ = places
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2)
    assert y1 - y0 == pytest.approx(y2 - y1, abs=0.2)
    assert y1 > y0  # less error stands lower
    for one, dot in zip(marks, dots, strict=True):
        assert dot.attrib["aria-label"].startswith(one.name)
        assert dot.attrib["tabindex"] == "0"
    assert svg.attrib["role"] == "group"
    assert "script" not in {e.tag for e in svg.iter()}


def boxes(
    svg: ElementTree.Element, kind: str, letter: float
) -> list[tuple[float, float, float, float]]:
    """Return left, top, right and bottom of every name, with so many pixels to a
    letter.
    """
    found = []
    for text in svg.iter("text"):
        classes = text.attrib["class"].split()
        width = letter * len(text.text or "")
        if classes[0] == kind:
            share = {"end": 1.0, "middle": 0.5}.get(classes[-1], 0.0)
            left = float(text.attrib["x"]) - share * width
            base = float(text.attrib["y"])
            found.append((left, base - 9, left + width, base + 2))
    return found


def apart(
    one: tuple[float, float, float, float], other: tuple[float, float, float, float]
) -> bool:
    """Tell whether two boxes do not overlap."""
    return (
        one[2] <= other[0]
        or other[2] <= one[0]
        or one[3] <= other[1]
        or other[3] <= one[1]
    )


def test_names_do_not_meet_names_or_dots() -> None:
    """Twenty dots in one place and five near it: whatever is named, no name covers
    another or a dot.
    """
    marks = [mark(0.01 * (1 + i / 1000), 0.5) for i in range(20)]
    marks += [mark(0.01 * (1.2 + i / 5), 0.45 + 0.04 * i) for i in range(5)]
    svg = ElementTree.fromstring(draw(marks, 0.02, "vorticity_nrmse", "title"))
    texts = boxes(svg, "name", 6.0) + boxes(svg, "note", 6.0)
    dots = [(float(e.attrib["cx"]), float(e.attrib["cy"])) for e in svg.iter("circle")]
    assert len(texts) > 3
    for number, one in enumerate(texts):
        circles = [(x - 3, y - 3, x + 3, y + 3) for x, y in dots]
        assert all(apart(one, other) for other in (*texts[:number], *circles))


def test_a_crowd_at_the_edge_keeps_its_names() -> None:
    """Five dots close together near the right edge: each has its name."""
    crowd = {"VAR(1)": (0.052, 50.0), "SuperGAT": (0.075, 1.2), "GNS": (0.045, 0.89)}
    crowd |= {
        "GNS, noise 1e-3": (0.036, 0.59),
        "analog": (0.0245, 1.5),
        "persistence": (4e-6, 1.0),
    }
    marks = [
        Mark(name=name, seconds=s, error=e, kind="entry")
        for name, (s, e) in crowd.items()
    ]
    svg = ElementTree.fromstring(draw(marks, None, "vorticity_nrmse", "title"))
    assert {
        e.text for e in svg.iter("text") if e.attrib["class"].startswith("name")
    } == set(crowd)


def test_axes_end_past_their_values() -> None:
    """All ticks within the axis; values a step off its ends."""
    scale = close_logarithmic(0.3, 1.4)
    assert scale.low < 0.3 < 1.4 < scale.high
    assert all(scale.low <= tick.value <= scale.high for tick in scale.ticks)
    assert next(tick.label for tick in close_logarithmic(1e-6, 1e-2).ticks) in (
        "10⁻⁶",
        "10⁻⁷",
    )


def test_a_picture_of_what_has_no_entry(tmp_path: Path) -> None:
    """Without any entry the floors stand there, and what the solver itself takes."""
    (tmp_path / "board" / "submissions").mkdir(parents=True)
    target = tmp_path / "cost.svg"
    words = [
        "leaderboard",
        "picture",
        "cavity",
        "--size",
        "mini",
        "--board",
        str(tmp_path / "board"),
    ]
    done = CliRunner().invoke(app, [*words, "-o", str(target)])
    assert done.exit_code == 0, done.output
    said = target.read_text()
    ElementTree.fromstring(said)
    size = load().size("cavity", "mini")
    assert all(name in said for name in shipped(size) or {})
    assert "the solver itself" in said
    assert (solver_seconds(size) or 0.0) > 0.0
    assert not re.search("<script|href=", said)
