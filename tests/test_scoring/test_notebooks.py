"""What notebooks show as HTML: the text of strangers makes no element in it.

lagbench reads no notebooks. A notebook shows the HTML of scores, windows and data sets;
names and units in them come from files and packages of others.
"""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from html_check import Reading, read_html
from scenario_factory import make_key, write_scenario
from score_bench import ScoreBench, half_right

import lagbench
from lagbench.data import registry
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import SUBMISSION

PACKAGE = Path(lagbench.__file__).parent

HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "'><svg onload='alert(1)'>",
    "</td></table><iframe src=javascript:alert(1)>",
    "<!-- comment",
    "]]><style>*{display:none}</style>",
    "&lt;b&gt;<b>",
)

REPRESENTATIONS = {"scoring/card.py": 1, "store/windows.py": 1}
"""Methods by which a notebook shows an object other than as text, by module."""

NAMES = {
    "_repr_html_",
    "_repr_javascript_",
    "_repr_latex_",
    "_repr_markdown_",
    "_repr_mimebundle_",
    "_repr_svg_",
}

TEST_IDS = registry.load().size("cavity", "tiny").subsets["test"]


@pytest.fixture
def card(bench: ScoreBench, tmp_path: Path) -> ScoreCard:
    path = bench.submit(tmp_path / "predictions.nc", half_right)
    return bench.evaluate(path)


def outline(reading: Reading) -> list[tuple[str, list[str]]]:
    """Return the elements of a page, each with the names of its attributes."""
    elements = []
    for element in reading.elements:
        elements.append((element.name, sorted(element.attributes)))
    return elements


def assert_plain_table(text: str) -> Reading:
    """Assert that HTML is a table without attributes; return its elements."""
    reading = read_html(text)
    assert reading.faults == []
    elements = {element.name for element in reading.elements}
    assert elements <= {"table", "caption", "tr", "th", "td"}
    for element in reading.elements:
        assert element.attributes == {}
    assert "<!--" not in text
    return reading


def test_all_representations_are_listed() -> None:
    """A new one needs a test in this file."""
    counts: dict[str, int] = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and node.name in NAMES:
                name = path.relative_to(PACKAGE).as_posix()
                counts[name] = counts.get(name, 0) + 1
    assert counts == REPRESENTATIONS


@pytest.mark.parametrize("text", HOSTILE)
def test_a_card_shows_hostile_names_as_text(card: ScoreCard, text: str) -> None:
    """Of the method, the split, a metric, its unit and a reference."""
    assert card.skill is not None
    rows = dict(card.scores)
    score = card.submission[card.ranking]
    hostile_metric = replace(score.metric, unit=text)
    rows[SUBMISSION] = {**rows[SUBMISSION], text: replace(score, metric=hostile_metric)}
    hostile = replace(
        card,
        header=replace(card.header, method=text, split=text, size=text, subset=text),
        ranking=text,
        scores=rows,
        skill=replace(card.skill, reference=text),
    )
    reading = assert_plain_table(hostile._repr_html_())
    (table,) = reading.named("table")
    assert table.text.count(text) == 7
    # a table of pandas, which a notebook shows as HTML too
    pandas_page = read_html(hostile.to_dataframe()._repr_html_())
    harmless_page = read_html(card.to_dataframe()._repr_html_())
    elements = {name for name, _ in outline(pandas_page)}
    assert elements == {name for name, _ in outline(harmless_page)}


@pytest.mark.parametrize("text", HOSTILE)
def test_windows_show_hostile_names_as_text(bench: ScoreBench, text: str) -> None:
    windows = lagbench.windows(
        bench.size.split,
        bench.size.name,
        subset="test",
        root=bench.root,
        registry=bench.registry,
    )
    windows.subsets = (text,)
    windows.size = windows.size.model_copy(update={"split": text})
    reading = assert_plain_table(windows._repr_html_())
    (table,) = reading.named("table")
    assert table.text.count(text) == 2


def write_data(root: Path, text: str) -> None:
    """Write test scenarios of cavity tiny whose attributes hold a text."""
    for scenario in TEST_IDS:
        path, _ = write_scenario(root, make_key(scenario), frames=3, particles=4)
        with netCDF4.Dataset(path, "a") as file:
            file.title = text
            file.setncattr(f"note {text.translate({47: None})}", text)
            for name in ("position", "material"):
                file[name].long_name = text
                file[name].units = text


@pytest.mark.parametrize("text", HOSTILE)
def test_data_show_hostile_attributes_as_text(text: str, tmp_path: Path) -> None:
    """The HTML is that of xarray; a text of letters gives the same elements."""
    pages = []
    for place, words in (("hostile", text), ("harmless", "a text")):
        write_data(tmp_path / place, words)
        with lagbench.open_split("cavity", "tiny", root=tmp_path / place) as data:
            assert np.isfinite(data.position.max())
            pages.append(read_html(data._repr_html_()))
    hostile, harmless = pages
    assert outline(hostile) == outline(harmless)
