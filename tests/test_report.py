"""The report: whole, harmless, the same every time, and right in what it shows."""

from __future__ import annotations

import base64
import io
import math
import re
import tomllib
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_check import Reading, read_html
from hypothesis import example, given
from hypothesis import strategies as st
from made_up import (
    METHODS,
    SPLITS,
    Method,
    ReportBench,
    damped,
    make_report_bench,
    motion,
    noisy,
    page_of,
    runaway,
    still,
)
from numpy.typing import NDArray
from PIL import Image

import lagbench.figures.report
from lagbench.data.grid import Grid, fields
from lagbench.data.registry import load
from lagbench.errors import UsageError
from lagbench.figures.html import Markup, tag, text
from lagbench.figures.report.maps import inside
from lagbench.figures.report.report import write_report
from lagbench.figures.report.subject import Subject, limit_of
from lagbench.figures.report.tables import stable_of
from lagbench.metrics import METRICS, Setting, Tally, aggregate
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.task import ScoredTask
from lagbench.submission.truth import Truth

HOSTILE = (
    "<script>alert(1)</script>",
    '" onmouseover="alert(1)" x=\'',
    "'><img src=x onerror=alert(1)>",
    "</style></title><svg onload=alert(1)>",
    "a\u202egnp.exe\u0000\u0007",
    "javascript:alert(1)//${alert(1)}{{alert(1)}}",
)

EVERYWHERE = {
    "histogram": "Fig. 5.12",
    "bars-vorticity-pearson": "Fig. 5.13",
    "residuals-truth": "Fig. 5.14",
    "residuals-node": "Fig. 5.15",
    "bars-vorticity-kl": "Fig. 5.16",
    "fields": "Fig. 5.17",
    "histograms": "Fig. 5.18",
    "energy-kept": "Fig. 5.19",
    "energy-raw": "Fig. 5.28",
    "methods-position-rmse": "Fig. 5.11",
    "scenarios-position-rmse-0": "Fig. 5.10",
}
"""Figures of every split, and those of the thesis that they correspond to."""

FULL_BOX = {
    "scenarios-vorticity-mse-0": "Fig. 5.10",
    "methods-vorticity-mse": "Fig. 5.11",
    "arrows-0": "Fig. 5.22",
    "streamlines-0": "Figs. 5.23, 5.24",
    "vorticity": "Figs. 5.25–5.27",
    "every-scenario": "Figs. 5.26, 5.27",
}

FREE_SURFACE = {
    "scenarios-attribute-mse-0": "Fig. 5.10",
    "methods-attribute-mse": "Fig. 5.11",
}

PARTICLES = {
    "fluid": {"particles-3": "Fig. 4.11", "particles-4": "Fig. 4.11"},
    "multimaterial": {
        **{f"particles-{i}": "Figs. 4.12, 4.13" for i in (7, 8, 9, 10, 12)},
        "particles-11": "Fig. 4.11",
        "bodies-shape-error": "section 4.8.2",
        "bodies-connectivity": "section 4.8.2",
    },
}


def scored(
    bench: ReportBench, folder: Path, *methods: tuple[str, Method], **labels: Any
) -> tuple[list[ScoreCard], list[Path], dict[str, Any]]:
    """Submit and score methods by name, and return what a report is written from."""
    paths = [
        bench.submit(folder / f"{i}.nc", method, name, **labels)
        for i, (name, method) in enumerate(methods)
    ]
    return (
        [bench.card(path) for path in paths],
        paths,
        {"root": bench.root, "registry": bench.registry},
    )


@pytest.fixture(scope="module")
def page(home: Path) -> Callable[[str], str]:
    """A function that returns the page of two methods on a split."""
    return lambda split: page_of(home, split).read_text("utf-8")


def expected_figures(split: str) -> dict[str, str]:
    """Return the figures that a report on a split must have."""
    if split in PARTICLES:
        return EVERYWHERE | FREE_SURFACE | PARTICLES[split]
    return EVERYWHERE | FULL_BOX


def assert_harmless(reading: Reading) -> None:
    """Nothing runs, and nothing is fetched from outside the page."""
    assert not {e.name for e in reading.elements} & {
        "script",
        "iframe",
        "object",
        "embed",
        "form",
        "base",
    }
    for element in reading.elements:
        for name, value in element.attributes.items():
            assert not name.startswith("on"), (element.name, name)
            if name in ("src", "href", "xlink:href", "action", "data", "srcset"):
                assert value.startswith(("#", "data:image/png;base64,", "data:,")), (
                    value
                )
            assert "url(" not in value
    for style in reading.named("style"):
        assert not re.search(r"url\(|@import|@font-face|https?:", style.text)
        assert style.text.count("{") == style.text.count("}")


@pytest.mark.parametrize("split", SPLITS)
def test_page_is_whole_and_harmless(page: Callable[[str], str], split: str) -> None:
    """Elements close in order, ids are unique, links lead somewhere, nothing runs; 3 MB
    hold it.
    """
    held = page(split)
    reading = read_html(held)
    assert not reading.faults
    assert held.startswith("<!DOCTYPE html>")
    assert len(held.encode()) < 3_000_000
    targets = [a.attributes["href"] for a in reading.named("a")]
    assert targets
    assert {target.removeprefix("#") for target in targets} <= set(reading.ids)
    assert_harmless(reading)
    (policy,) = [
        m.attributes["content"]
        for m in reading.named("meta")
        if "http-equiv" in m.attributes
    ]
    assert policy.startswith("default-src 'none'")
    assert "script-src" not in policy


@pytest.mark.parametrize("split", SPLITS)
def test_every_figure_is_there_and_can_be_read_aloud(
    page: Callable[[str], str], split: str
) -> None:
    """Each figure of the thesis has its counterpart, with a caption that names it.

    Pictures have a text, drawings a title, charts a description too.
    """
    reading = read_html(page(split))
    figures = {e.attributes["id"]: e for e in reading.named("figure")}
    for name, thesis in expected_figures(split).items():
        assert name in figures, name
        assert f"thesis {thesis}" in figures[name].text, name
    numbers = [e.text for e in reading.of_class("number")]
    assert numbers == [f"Figure {k}" for k in range(1, len(figures) + 1)]
    assert len(reading.named("figcaption")) == len(figures)
    assert all(image.attributes.get("alt") for image in reading.named("img"))
    assert page(split).count("<desc>") == len(reading.of_class("chart")) > 0
    for drawing in reading.named("svg"):
        spoken = drawing.attributes.get("aria-hidden") == "true" or drawing.text
        assert spoken or "role" not in drawing.attributes


def test_strangers_text_is_shown_not_run(home: Path, tmp_path: Path) -> None:
    """Hostile names of methods, files and trainings stand on the page as text."""
    bench = make_report_bench(home, "curl-noise")
    paths = [
        bench.submit(
            tmp_path / f"{i} '\"<b>&.nc", noisy, name, training=name, device=name
        )
        for i, name in enumerate(HOSTILE)
        if "\0" not in name
    ]
    cards = [bench.card(path) for path in paths]
    page = write_report(
        tmp_path / "out", cards, paths, root=bench.root, registry=bench.registry
    )
    reading = read_html(page.read_text("utf-8"))
    assert not reading.faults
    assert_harmless(reading)
    heading = reading.named("h1")[0].text
    assert all(card.header.method in heading for card in cards)
    assert "0 '" in reading.named("pre")[0].text


PLAIN = "Größe µ ≤ 3 × 10⁻⁴,\n\t'x' & \"y\" <z> 中文 🙂"
"""Letters, signs and line breaks, none of which is replaced."""


@given(st.text())
@example(PLAIN)
def test_any_text_survives_escaping(words: str) -> None:
    """What stands in an element and an attribute is the text itself, but for what
    cannot be shown.
    """
    reading = read_html(tag("p", words, title=words))
    assert not reading.faults
    (element,) = reading.elements
    assert element.attributes["title"] == element.text
    for shown, meant in zip(element.text, words, strict=True):
        assert shown == meant or (shown in "\ufffd?" and words != PLAIN)
    assert tag("p", Markup("<b>x</b>")) == "<p><b>x</b></p>"


def test_same_bytes_every_time(
    home: Path, page: Callable[[str], str], tmp_path: Path
) -> None:
    """The same predictions give the same page wherever they lie; no folder stands in
    it.
    """
    bench = make_report_bench(home, "multimaterial")
    first = bench.report(tmp_path / "there", METHODS).read_text("utf-8")
    assert first == page("multimaterial")
    assert "the bands are" in first
    assert str(tmp_path) not in first
    assert str(bench.root) not in first


@pytest.mark.parametrize("split", SPLITS)
def test_undefined_and_huge_numbers_are_drawn_around(
    home: Path, tmp_path: Path, split: str
) -> None:
    """A prediction at rest has no correlation, a runaway leaves every axis: the page
    holds both.
    """
    page = (
        make_report_bench(home, split)
        .report(tmp_path, {"rest": still, "odd": runaway})
        .read_text("utf-8")
    )
    reading = read_html(page)
    assert not reading.faults
    for element in reading.elements:
        for name in ("d", "x", "y", "width", "height", "viewbox", "transform"):
            drawn = element.attributes.get(name, "")
            assert not re.search(r"nan|inf|e\+?\d", drawn), (
                element.name,
                name,
                drawn[:80],
            )
            assert all(len(number) < 8 for number in re.findall(r"\d+", drawn))
    assert set(expected_figures(split)) <= set(reading.ids)


def test_scores_on_the_page_are_those_of_the_card(home: Path, tmp_path: Path) -> None:
    """The mean of the ranking metric stands in the table, and no interval of two
    scenarios.
    """
    labels = {"parameters": 1_600_000, "seconds_per_frame": 0.25}
    (card,), paths, where = scored(
        make_report_bench(home, "cavity"), tmp_path, ("damped", damped), **labels
    )
    page = write_report(tmp_path, [card], paths, **where)
    reading = read_html(page.read_text("utf-8"))
    ranked = [scores[card.ranking] for scores in card.scores.values()]
    means = [element.text for element in reading.of_class("n")]
    assert means[: len(ranked)] == [text(score.mean) for score in ranked]
    assert np.isnan([score.interval for score in ranked]).all()
    assert not any("…" in element.text for element in reading.of_class("ci"))
    assert "the bands are" not in page.read_text("utf-8")
    everything = " ".join(e.text for e in reading.named("main"))
    said = (
        card.predictions_sha256,
        card.header.dataset_sha256,
        "lagbench score 0.nc --report report",
    )
    flags = (flag.name.replace("_", " ") for flag in card.flags)
    assert [
        words
        for words in (*said, "1\u202f600\u202f000", *flags)
        if words not in everything
    ] == []


def test_floors_have_no_rank(home: Path, tmp_path: Path) -> None:
    """Two submissions, both worse than the floors, are ranked 1 and 2, and floors stand
    below without.
    """
    bench = make_report_bench(home, "curl-noise")
    page = bench.report(tmp_path, {"m0": noisy, "m1": noisy}).read_text("utf-8")
    (part,) = re.findall(r'aria-label="Comparison".*?</table>', page, re.DOTALL)
    rows = [
        re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)
        for row in re.findall(r"<tr>(.*?)</tr>", part)
    ]
    ranks = [row[1] for row in rows[1:]]
    assert (ranks[:2], set(ranks[2:]), len(ranks) > 4) == (["1", "2"], {""}, True)


def test_methods_of_one_name_are_told_apart(home: Path, tmp_path: Path) -> None:
    """Two files of one method get numbers, so does one with a floor's name."""
    methods = (("gns", damped), ("gns", noisy), ("persistence", still))
    cards, paths, where = scored(
        make_report_bench(home, "curl-noise"), tmp_path, *methods
    )
    page = write_report(tmp_path, cards, paths, **where)
    heading = read_html(page.read_text("utf-8")).named("h1")[0].text
    assert heading == "gns (1) · gns (2) · persistence (1)"


def test_cards_must_belong_together(home: Path, tmp_path: Path) -> None:
    """No card, a card without its file, and two data sets are refused."""
    benches = [make_report_bench(home, split) for split in ("curl-noise", "cavity")]
    one, two = (
        scored(bench, tmp_path / bench.size.split, ("a", still)) for bench in benches
    )
    for cards, files in (([], []), (one[0], []), (one[0] + two[0], one[1] + two[1])):
        with pytest.raises(UsageError):
            write_report(tmp_path, cards, files, **one[2])
    assert not (tmp_path / "index.html").exists()


def test_pages_of_others_stay(home: Path, tmp_path: Path) -> None:
    """A report replaces a report, and no other page."""
    cards, paths, where = scored(
        make_report_bench(home, "cavity"), tmp_path, ("a", still)
    )
    for _ in range(2):
        page = write_report(tmp_path / "report", cards, paths, **where)
    page.write_text("<!doctype html><title>My thesis</title>")
    with pytest.raises(UsageError) as caught:
        write_report(tmp_path / "report", cards, paths, **where)
    assert (caught.value.where, caught.value.got) == ("--report", str(page))
    assert "My thesis" in page.read_text()


def subject_on(split: str, size_name: str) -> Subject:
    """Return a subject without entries: enough to ask which frames are shown."""
    size = load().size(split, size_name)
    told = {
        name: getattr(size.task, name)
        for name in ("input_frames", "horizon", "frames_of_interest", "radius")
    }
    setting = Setting(
        grid=Grid(size.task.score_grid.cells), attribute_std=(1.0,) * 4, **told
    )
    scored = ScoredTask(truth=Truth(size, Path()), setting=setting, density=1.0)
    return Subject(task=scored, title=split, entries=())


@pytest.mark.parametrize("size", ["full", "mini", "tiny"])
@pytest.mark.parametrize(
    ("split", "frame"),
    [("cavity", 54), ("curl-noise", 40), ("fluid", 60), ("multimaterial", 60)],
)
def test_frames_are_those_of_the_thesis(split: str, frame: int, size: str) -> None:
    """Models are compared at frame 54, at 35 after the last given one (5), and at 60.

    Pictures over time are at six ascending predicted frames, the first and the last
    among them; Fig. 5.18 shows frames 6, 9, 18, 21, 48 and 51.
    """
    subject = subject_on(split, size)
    predicted = subject.task.setting.predicted_frames
    assert size == "tiny" or subject.key_frame == frame
    first, *between, last = subject.times
    assert (first, len(between), last) == (predicted[0], 4, predicted[-1])
    assert list(subject.times) == sorted(subject.times)
    if (split, size) == ("cavity", "full"):
        assert subject.histogram_frames == (6, 9, 18, 21, 48, 51)


def opacity(address: str) -> NDArray[np.float64]:
    """Return a signed picture's values from -1 to 1, shape [x node, y node], as Pillow
    reads it.
    """
    png = base64.b64decode(address.removeprefix("data:image/png;base64,"))
    shown = np.asarray(Image.open(io.BytesIO(png)).convert("RGBA")).astype(np.float64)
    sign = np.where(shown[..., 0] > shown[..., 2], 1.0, -1.0)
    grey = (shown[..., 0] == 128) & (shown[..., 1] == 128)
    return np.where(grey, np.nan, sign * shown[..., 3] / 255.0)[::-1].T


def test_maps_show_their_frames(home: Path, tmp_path: Path) -> None:
    """Each panel of true vorticity holds the field of x(f) - x(f-1) at its frame f,
    none other.
    """
    bench = make_report_bench(home, "curl-noise")
    page = bench.report(tmp_path, {"damped": damped}).read_text("utf-8")
    truth = (
        motion(bench.size, bench.size.subsets["test"][0])
        .astype(np.float32)
        .astype(np.float64)
    )
    grid = Grid(bench.size.task.score_grid.cells)
    (low, high), _ = bench.size.bounds
    full = grid.full_weight(bench.size.particles, (high - low) ** 2)

    def vorticity(frame: int) -> NDArray[np.float64]:
        return fields(
            truth[frame], truth[frame] - truth[frame - 1], grid, full=full
        ).vorticity

    panels = {
        int(found[1]): opacity(image.attributes["src"])
        for image in read_html(page).named("img")
        if (
            found := re.fullmatch(
                r"true vorticity, frame (\d+)", image.attributes["alt"]
            )
        )
    }
    assert len(panels) == 6
    limit = limit_of([vorticity(frame) for frame in panels])
    for frame, shown in panels.items():
        meant = np.clip(inside(bench.task, vorticity(frame)) / limit, -1.0, 1.0)
        np.testing.assert_array_equal(np.isnan(shown), np.isnan(meant))
        np.testing.assert_allclose(
            np.nan_to_num(shown), np.nan_to_num(meant), atol=0.0101
        )


def test_style_sheet_is_packaged() -> None:
    """Whatever lies in the package and is no module is named in pyproject.toml, so that
    wheels hold it.
    """
    root = Path(__file__).parents[1]
    data = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    folder = Path(str(lagbench.figures.report.__file__)).parent
    others = [p.name for p in folder.iterdir() if p.is_file() and p.suffix != ".py"]
    assert "style.css" in others
    assert all(
        any(fnmatch(name, pattern) for pattern in data["lagbench.figures.report"])
        for name in others
    )


def test_the_stable_tile_says_how_many_frames_do_not_count() -> None:
    """Two scenarios of 3 frames, 2 of them without a correlation: both numbers stand on
    the tile.
    """
    name = "vorticity_pearson"
    rows = [(0.96, math.nan, math.nan), (0.96, 0.96, 0.9)]
    tallies = {
        i: Tally.of([name], range(2, 5), {f: {name: v} for f, v in enumerate(row, 2)})
        for i, row in enumerate(rows)
    }
    stable = aggregate([METRICS["stable_frames"]], tallies)["stable_frames"]
    assert stable.values.tolist() == [1.0, 2.0]
    assert stable_of(stable) == "of 3, correlation above 0.95; 2 of 6 frames undefined"
