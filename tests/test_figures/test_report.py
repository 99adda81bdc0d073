"""The report: whole, harmless, the same every time, and right in what it shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from board_bench import (
    METHODS,
    Method,
    ReportBench,
    damped,
    make_report_bench,
    noisy,
    runaway,
    still,
)
from html_check import Reading, read_html

from lagbench.errors import UsageError
from lagbench.figures.report.report import POLICY, check_folder, write_report
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.tables import card_tables

HOSTILE = (
    "<script>alert(1)</script>",
    '" onmouseover="alert(1)" x=\'',
    "'><img src=x onerror=alert(1)>",
    "</style></title><svg onload=alert(1)>",
    "{{ 7 * 7 }}",
)

ACTIVE_ELEMENTS = {"script", "iframe", "object", "embed", "form", "base"}
HARMLESS_ADDRESSES = ("#", "data:image/png;base64,", "data:,")


def report_on(
    bench: ReportBench, folder: Path, *methods: tuple[str, Method]
) -> tuple[list[ScoreCard], str]:
    """Score methods by name; return their cards and the text of their report."""
    cards = []
    paths = []
    for number, (name, method) in enumerate(methods):
        path = bench.submit(folder / f"{number}.nc", method, name, training=name)
        paths.append(path)
        cards.append(bench.card(path))
    page = write_report(
        folder / "report", cards, paths, root=bench.root, registry=bench.registry
    )
    return cards, page.read_text("utf-8")


def assert_harmless(reading: Reading) -> None:
    """Nothing runs, and nothing is fetched from outside the page."""
    assert not reading.faults
    for element in reading.elements:
        assert element.name not in ACTIVE_ELEMENTS
        for name, value in element.attributes.items():
            assert not name.startswith("on"), (element.name, name)
            if name in {"src", "href"}:
                assert value.startswith(HARMLESS_ADDRESSES), value
    for style in reading.named("style"):
        assert not re.search(r"url\(|@import|https?:", style.text)


@pytest.mark.slow
@pytest.mark.parametrize("split", ["cavity", "multimaterial"])
def test_the_page_is_whole_harmless_and_the_same_every_time(
    home: Path, tmp_path: Path, split: str
) -> None:
    """Links lead somewhere, 3 MB hold it, and undefined or huge values are drawn
    around.
    """
    bench = make_report_bench(home, split)
    methods = (*METHODS.items(), ("rest", still), ("odd", runaway))
    _, html = report_on(bench, tmp_path / "a", *methods)
    reading = read_html(html)
    assert_harmless(reading)
    assert len(html.encode()) < 3_000_000
    targets = {link.attributes["href"].removeprefix("#") for link in reading.named("a")}
    assert targets
    assert targets <= set(reading.ids)
    for image in reading.named("img"):
        assert image.attributes.get("alt")
    _, again = report_on(bench, tmp_path / "b", *methods)
    assert again == html
    assert str(tmp_path) not in html


@pytest.mark.slow
def test_text_of_strangers_is_shown_not_run(home: Path, tmp_path: Path) -> None:
    bench = make_report_bench(home, "curl-noise")
    methods = [(name, noisy) for name in HOSTILE]
    _, html = report_on(bench, tmp_path, *methods)
    reading = read_html(html)
    assert_harmless(reading)
    (title,) = reading.named("h1")
    for name in HOSTILE:
        assert name in title.text


def test_scores_on_the_page_are_those_of_the_scorer(home: Path, tmp_path: Path) -> None:
    bench = make_report_bench(home, "cavity")
    (card,), html = report_on(bench, tmp_path, ("damped", damped))
    reading = read_html(html)
    cells = [cell.text for name in ("th", "td") for cell in reading.named(name)]
    for table in card_tables(card):
        for row in table.rows:
            assert set(row) <= set(cells)
    for words in (card.predictions_sha256, card.header.dataset_sha256):
        assert words in html


def test_score_reports_must_belong_together(home: Path, tmp_path: Path) -> None:
    """No card, one without its file, and two data sets are refused."""
    cards = []
    paths = []
    for split in ("curl-noise", "cavity"):
        bench = make_report_bench(home, split)
        path = bench.submit(tmp_path / f"{split}.nc", still, "a")
        paths.append(path)
        cards.append(bench.card(path))
    for some_cards, some_paths in (([], []), (cards[:1], []), (cards, paths)):
        with pytest.raises(UsageError):
            write_report(tmp_path, some_cards, some_paths, root=bench.root)
    assert not (tmp_path / "index.html").exists()


def test_pages_of_others_stay(tmp_path: Path) -> None:
    """A report replaces a report, and no other page."""
    page = tmp_path / "index.html"
    page.write_text(POLICY)
    check_folder(tmp_path)
    page.write_text("<!doctype html><title>My thesis</title>")
    with pytest.raises(UsageError):
        check_folder(tmp_path)
