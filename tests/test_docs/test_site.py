"""The documentation site: built without a warning, whole, and without a request to the
network.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

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


def test_the_search_has_an_index_that_needs_no_server(site: Path) -> None:
    """A page opened as a file may load scripts, but fetch nothing."""
    index = (site / "search" / "search_index.js").read_text("utf-8")
    assert "lagrangebench-h5" in index
