"""The documentation site: built without a warning, whole, and without a request to the
network.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import browser
import pytest

import lagbench

CLONE = Path(__file__).parents[2]
LOADED = {
    "script": "src",
    "img": "src",
    "link": "href",
    "iframe": "src",
    "source": "src",
}
"""What a browser fetches by itself, and the attribute that says where from."""

pytestmark = pytest.mark.slow


class Fetched(HTMLParser):
    """Collect what a page makes a browser fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the address of an element that loads; `canonical` and the like are only
        names.
        """
        held = dict(attrs)
        names_only = tag == "link" and held.get("rel") not in {
            "stylesheet",
            "icon",
            "preload",
        }
        if tag in LOADED and not names_only and (address := held.get(LOADED[tag])):
            self.addresses.append(address)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as CI does: warnings are errors."""
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        str(folder),
    ]
    where = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=CLONE, env=where, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_nothing_comes_from_the_network(site: Path) -> None:
    """All that pages and style sheets load is a file of the site."""
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        reader = Fetched()
        reader.feed(page.read_text())
        assert reader.addresses
        for address in reader.addresses:
            assert not re.match(r"(\w+:)?//", address), f"{page.name}: {address}"
            base = site if address.startswith("/") else page.parent
            assert (base / address.lstrip("/").partition("?")[0]).is_file(), (
                f"{page.name}: {address}"
            )
    sheets = "".join(sheet.read_text() for sheet in site.rglob("*.css"))
    assert not re.search(r"url\([\"']?(https?:)?//|@import", sheets)


def test_the_public_names_are_described(site: Path) -> None:
    """Every name of `lagbench.__all__` and of `lagbench.torch` that pages use has an
    entry with its text.
    """
    text = (site / "api.html").read_text()
    functions = set(lagbench.__all__) - {"__version__", "errors", "submission"}
    names = {f"lagbench.{name}" for name in functions} | {"lagbench.submission.write"}
    names |= {"lagbench.errors.LagbenchError", "lagbench.errors.DataError"}
    classes = (
        "WindowDataset",
        "WindowSampler",
        "collate",
        "Batch",
        "roll_out",
        "predict",
    )
    names |= {f"lagbench.torch.{name}" for name in classes}
    names |= {"lagbench.baselines.particle_grid.ParticleGrid"}
    for name in names:
        assert f'id="{name}"' in text, name


def test_the_search_works_in_a_page_of_a_folder(site: Path) -> None:
    """Words that a reader types give the page that is about them."""
    if browser.CHROMIUM is None:
        pytest.skip("needs Chromium")
    with browser.browser() as running:
        page = running.open(site / "index.html", width=1280)
        field = "document.querySelector('[data-md-component=search-query]')"
        browser.run(page, f"{field}.focus()")
        browser.run(page, f"{field}.value = 'lagrangebench-h5'")
        browser.run(page, f"{field}.dispatchEvent(new KeyboardEvent('keyup'))")
        found = "[data-md-component=search-result] a[href*='exchange.html']"
        browser.until(page, f"document.querySelector({json.dumps(found)}) !== null")
