"""The report in a real browser: silent, and nothing cut off."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from board_bench import page_of
from browser import CHROMIUM, Browser
from PIL import Image

NO_CHROMIUM = "no Chromium here: apt-get install chromium"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM),
]

TEXT_BOXES = """
[...document.querySelectorAll('.chart text')].map(text => {
  const box = text.getBoundingClientRect();
  const size = parseFloat(getComputedStyle(text).fontSize) * text.getCTM().a;
  return [box.left, box.right, size];
})
"""
"""Left, right and size of the texts of charts [pixel]."""

BROKEN_HEADS = """
[...document.querySelectorAll('thead th, tbody th')]
  .flatMap(th => [...th.querySelectorAll('span')])
  .filter(span => !span.matches('.metric, .metric *, .sub'))
  .filter(span => span.getClientRects().length > 1)
  .filter(span => (span.matches('.muted') && !span.closest('.scores'))
    || !/[ -]/.test(span.textContent))
  .map(span => span.textContent)
"""
"""Names in heads of tables that are broken inside a word, and kinds and units that are
broken at all outside the table of scores.
"""

IMAGES_ARE_LOADED = "[...document.images].every(i => i.complete && i.naturalWidth > 0)"


@pytest.fixture(scope="module", params=["cavity", "multimaterial"])
def report(request: pytest.FixtureRequest, home: Path) -> Path:
    """A report on two methods, one of them hostile."""
    return page_of(home, request.param)


@pytest.mark.parametrize(
    ("width", "dark"), [(1280, False), (1280, True), (390, False), (320, True)]
)
def test_page_opens_in_silence(
    running: Browser,
    report: Path,
    width: int,
    dark: bool,
) -> None:
    """No message, no request, no sideways scrolling; scheme and focus show."""
    page = running.open(report, width=width, dark=dark)
    assert page.value("document.documentElement.scrollWidth") <= width
    assert page.value("document.images.length") > 5
    assert page.value(IMAGES_ARE_LOADED)
    assert page.value("document.scripts.length") == 0
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        grey = np.asarray(picture.convert("L"))
        colours = picture.convert("RGB").getcolors(maxcolors=2**24)
    is_dark = float(np.median(grey)) / 255.0 < 0.3
    assert is_dark == dark
    assert colours is not None
    assert len(colours) > 50
    page.press("Tab")
    assert page.focus_shows("a[href^='#part-']")
    assert page.messages == []
    assert page.requests == [report.absolute().as_uri()]


@pytest.mark.parametrize("width", [1280, 390])
def test_texts_of_charts_lie_within_the_window(
    running: Browser, report: Path, width: int
) -> None:
    """No label is cut off at the edge, none is smaller than 7 pixels."""
    page = running.open(report, width=width)
    boxes = page.value(TEXT_BOXES)
    assert len(boxes) > 50
    left, right, size = np.array(boxes).T
    assert left.min() >= 0
    assert right.max() <= width
    assert size.min() >= 7.0


def test_heads_break_at_no_letter(running: Browser, report: Path) -> None:
    """A name without a space or hyphen stays on one line."""
    page = running.open(report, width=1280)
    assert page.value(BROKEN_HEADS) == []


def test_the_table_of_scores_is_not_cut(running: Browser, report: Path) -> None:
    """A laptop shows the submission beside all references without scrolling."""
    page = running.open(report, width=1280)
    box = "document.querySelector('.scores').parentElement"
    assert page.value(f"{box}.scrollWidth") <= page.value(f"{box}.clientWidth")


def test_the_page_prints(running: Browser, report: Path) -> None:
    """A PDF has a sensible number of pages."""
    pdf = running.open(report, width=1280).pdf()
    assert pdf.startswith(b"%PDF")
    assert 3 <= pdf.count(b"/Type /Page\n") <= 40
