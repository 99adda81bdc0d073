"""The report in a real browser: nothing asked for, nothing complained of, nothing cut
off.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from made_up import page_of
from PIL import Image

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: apt-get install chromium"
)


@pytest.fixture(scope="module", params=["cavity", "multimaterial"])
def report(request: pytest.FixtureRequest, home: Path) -> Path:
    """A report on two methods, one of them hostile."""
    return page_of(home, request.param)


@pytest.mark.parametrize("width", [1280, 390, 320])
@pytest.mark.parametrize("dark", [False, True])
def test_page_opens_in_silence(
    running: Browser, report: Path, width: int, dark: bool
) -> None:
    """Focus shows; no message, no request but the page itself, no sideways scrolling,
    its scheme as asked.
    """
    page = running.open(report, width=width, dark=dark)
    assert page.value("document.documentElement.scrollWidth") <= width
    assert page.value("document.images.length") > 5
    assert page.value(
        "[...document.images].every(i => i.complete && i.naturalWidth > 0)"
    )
    assert page.value("document.scripts.length") == 0
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        brightness = float(np.median(np.asarray(picture.convert("L")))) / 255.0
        colours = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
    assert ((brightness < 0.3), len(colours) > 50) == (dark, True)
    page.press("Tab")
    assert page.focus_shows("a[href^='#part-']")
    assert page.messages == []
    assert page.requests == [report.absolute().as_uri()]


@pytest.mark.parametrize("width", [1280, 390])
def test_texts_of_charts_lie_within_them(
    running: Browser, report: Path, width: int
) -> None:
    """No label is cut off at the edge of the window, none is smaller than 7 pixels."""
    page = running.open(report, width=width)
    boxes = page.value(
        "[...document.querySelectorAll('.chart text')].map(t => { const b = "
        "t.getBoundingClientRect();"
        " return [b.left, b.right, parseFloat(getComputedStyle(t).fontSize) * "
        "t.getCTM().a]; })"
    )
    assert len(boxes) > 50
    left, right, size = np.array(boxes).T
    assert left.min() >= 0
    assert right.max() <= width
    assert size.min() >= 7.0


def test_heads_break_at_no_letter_and_the_page_prints(
    running: Browser, report: Path
) -> None:
    """A name without a space or hyphen is on one line of its head, as every floor's is;
    a PDF has pages.
    """
    page = running.open(report, width=1280)
    heads = "[...document.querySelectorAll('thead th, tbody th')].flatMap(th => [...th.querySelectorAll('span')])"
    broken = page.value(
        f"{heads}.filter(s => !s.matches('.metric, .metric *, .sub') && "
        f"s.getClientRects().length > 1)"
        ".filter(s => s.matches('.muted') || !/[ -]/.test(s.textContent)).map(s => "
        "s.textContent)"
    )
    assert broken == []
    pdf = page.pdf()
    assert pdf.startswith(b"%PDF")
    assert 3 <= pdf.count(b"/Type /Page\n") <= 40
