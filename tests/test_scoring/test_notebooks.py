"""What notebooks show as HTML: the text of strangers makes no element in it.

lagbench reads no notebooks. A notebook shows the HTML of scores, windows and data sets;
names and units in them come from files and packages of others.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from html_check import Reading, read_html
from score_bench import ScoreBench, half_right

from lagbench.scoring.card import ScoreCard
from lagbench.scoring.task import SUBMISSION

TEXT = '"><script>alert(1)</script></td></table><!-- &lt;b&gt;<b>'


NAMES = ("method", "split", "size", "subset")


@pytest.fixture
def card(bench: ScoreBench, tmp_path: Path) -> ScoreCard:
    path = bench.submit(tmp_path / "predictions.nc", half_right)
    return bench.evaluate(path)


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


def test_a_card_shows_hostile_names_as_text(card: ScoreCard) -> None:
    """Of the method, the split, a metric, its unit and a reference."""
    assert card.skill is not None
    rows = dict(card.scores)
    score = card.submission[card.ranking]
    hostile_metric = replace(score.metric, unit=TEXT)
    rows[SUBMISSION] = {**rows[SUBMISSION], TEXT: replace(score, metric=hostile_metric)}
    hostile = replace(
        card,
        header=card.header.model_copy(update=dict.fromkeys(NAMES, TEXT)),
        ranking=TEXT,
        scores=rows,
        skill=replace(card.skill, reference=TEXT),
    )
    reading = assert_plain_table(hostile._repr_html_())
    (table,) = reading.named("table")
    assert table.text.count(TEXT) == 7
