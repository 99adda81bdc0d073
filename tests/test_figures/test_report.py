"""The report: whole, harmless, the same every time, and right in what it shows."""

from __future__ import annotations

import base64
import io
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from board_bench import (
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
from exchange_readers import straight_runs
from html_check import Reading, read_html
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from PIL import Image

import lagbench.figures
from lagbench.data.grid import Grid, fields
from lagbench.data.registry import load
from lagbench.errors import UsageError
from lagbench.exchange import adopt
from lagbench.figures.html import Markup, tag, text
from lagbench.figures.report.maps import crop_to_walls
from lagbench.figures.report.report import write_report
from lagbench.figures.report.subject import Subject, limit_of
from lagbench.figures.report.summary import describe_stability
from lagbench.metrics import METRICS, Tally, TaskConfig, aggregate
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.task import ScoredTask
from lagbench.submission import write
from lagbench.submission.truth import Truth

ROOT = Path(__file__).parents[2]

HOSTILE = (
    "<script>alert(1)</script>",
    '" onmouseover="alert(1)" x=\'',
    "'><img src=x onerror=alert(1)>",
    "</style></title><svg onload=alert(1)>",
    "a\u202egnp.exe\u0000\u0007",
    "javascript:alert(1)//${alert(1)}{{alert(1)}}",
)

ACTIVE_ELEMENTS = {"script", "iframe", "object", "embed", "form", "base"}
ADDRESS_ATTRIBUTES = {"src", "href", "xlink:href", "action", "data", "srcset"}
HARMLESS_ADDRESSES = ("#", "data:image/png;base64,", "data:,")
NUMERIC_ATTRIBUTES = ("d", "x", "y", "width", "height", "viewbox", "transform")

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
    "arrows-0": "Figs. 5.22–5.24",
    "vorticity": "Figs. 5.25–5.27",
    "every-scenario": "Figs. 5.26, 5.27",
}

FREE_SURFACE = {
    "scenarios-attribute-mse-0": "Fig. 5.10",
    "methods-attribute-mse": "Fig. 5.11",
}

PARTICLES = {
    "fluid": {
        "particles-3": "Fig. 4.11",
        "particles-4": "Fig. 4.11",
    },
    "multimaterial": {
        "particles-7": "Figs. 4.12, 4.13",
        "particles-8": "Figs. 4.12, 4.13",
        "particles-9": "Figs. 4.12, 4.13",
        "particles-10": "Figs. 4.12, 4.13",
        "particles-11": "Fig. 4.11",
        "particles-12": "Figs. 4.12, 4.13",
        "bodies-shape-error": "section 4.8.2",
        "bodies-connectivity": "section 4.8.2",
    },
}


# Two pages hold all kinds of figures; the browser opens these two as well.
EVERY_PAGE = pytest.mark.parametrize(
    "split",
    [
        "cavity",
        "multimaterial",
        pytest.param("curl-noise", marks=pytest.mark.slow),
        pytest.param("fluid", marks=pytest.mark.slow),
    ],
)


def expected_figures(split: str) -> dict[str, str]:
    """Return the figures that a report on a split must have."""
    if split in PARTICLES:
        return EVERYWHERE | FREE_SURFACE | PARTICLES[split]
    return EVERYWHERE | FULL_BOX


@dataclass(frozen=True)
class ScoredFiles:
    """Scored submissions to one data set."""

    bench: ReportBench
    cards: list[ScoreCard]
    paths: list[Path]

    def report(self, folder: Path) -> Path:
        """Write their report."""
        root = self.bench.root
        registry = self.bench.registry
        return write_report(
            folder,
            self.cards,
            self.paths,
            root=root,
            registry=registry,
        )


def score_methods(
    bench: ReportBench,
    folder: Path,
    *methods: tuple[str, Method],
    **labels: Any,
) -> ScoredFiles:
    """Submit and score methods by name."""
    cards = []
    paths = []
    for number, (name, method) in enumerate(methods):
        file = folder / f"{number}.nc"
        path = bench.submit(file, method, name, **labels)
        paths.append(path)
        cards.append(bench.card(path))
    return ScoredFiles(bench, cards, paths)


Page = Callable[[str], str]


@pytest.fixture(scope="module")
def page(home: Path) -> Page:
    """A function that returns the page of two methods on a split."""
    return lambda split: page_of(home, split).read_text("utf-8")


def reported(bench: ReportBench, folder: Path, methods: Mapping[str, Method]) -> str:
    """Return the page of a report on some methods."""
    path = bench.report(folder, methods)
    return path.read_text("utf-8")


def title_of(reading: Reading) -> str:
    """Return the first heading of a page."""
    first, *_ = reading.named("h1")
    return first.text


def assert_harmless(reading: Reading) -> None:
    """Nothing runs, and nothing is fetched from outside the page."""
    names = {element.name for element in reading.elements}
    assert not names & ACTIVE_ELEMENTS
    for element in reading.elements:
        for name, value in element.attributes.items():
            assert not name.startswith("on"), (element.name, name)
            if name in ADDRESS_ATTRIBUTES:
                assert value.startswith(HARMLESS_ADDRESSES), value
            assert "url(" not in value
    for style in reading.named("style"):
        assert not re.search(r"url\(|@import|@font-face|https?:", style.text)
        assert style.text.count("{") == style.text.count("}")


@pytest.mark.slow
@EVERY_PAGE
def test_page_is_whole_and_harmless(page: Page, split: str) -> None:
    """Elements close in order, links lead somewhere, nothing runs; 3 MB hold it."""
    html = page(split)
    reading = read_html(html)
    assert not reading.faults
    assert html.startswith("<!DOCTYPE html>")
    assert len(html.encode()) < 3_000_000
    targets = set()
    for link in reading.named("a"):
        targets.add(link.attributes["href"].removeprefix("#"))
    assert targets
    assert targets <= set(reading.ids)
    assert_harmless(reading)
    policies = []
    for meta in reading.named("meta"):
        if "http-equiv" in meta.attributes:
            policies.append(meta.attributes["content"])
    (policy,) = policies
    assert policy.startswith("default-src 'none'")
    assert "script-src" not in policy


@EVERY_PAGE
def test_the_page_opens_folded(page: Page, split: str) -> None:
    """All sections fold; two at most are open, and no table of numbers."""
    reading = read_html(page(split))
    sections = []
    tables = []
    for element in reading.named("details"):
        is_section = element.attributes.get("class") == "part"
        (sections if is_section else tables).append(element)
    titles = reading.named("h2")
    assert len(sections) == len(titles) > 2
    open_sections = [one for one in sections if "open" in one.attributes]
    assert 1 <= len(open_sections) <= 2
    assert not any("open" in one.attributes for one in tables)


@EVERY_PAGE
def test_every_figure_of_the_thesis_has_its_counterpart(page: Page, split: str) -> None:
    """Captions name the figure of the thesis, and figures are numbered in order."""
    reading = read_html(page(split))
    figures = {}
    for figure in reading.named("figure"):
        figures[figure.attributes["id"]] = figure
    for name, thesis in expected_figures(split).items():
        assert name in figures, name
        assert f"thesis {thesis}" in figures[name].text, name
    numbers = [element.text for element in reading.of_class("number")]
    count = len(figures)
    expected = [f"Figure {number}" for number in range(1, count + 1)]
    assert numbers == expected
    assert len(reading.named("figcaption")) == count


@EVERY_PAGE
def test_every_figure_can_be_read_aloud(page: Page, split: str) -> None:
    """Pictures have a text, drawings a title, charts a description too."""
    html = page(split)
    reading = read_html(html)
    for image in reading.named("img"):
        assert image.attributes.get("alt")
    chart_count = len(reading.of_class("chart"))
    assert chart_count > 0
    assert html.count("<desc>") == chart_count
    for drawing in reading.named("svg"):
        is_hidden = drawing.attributes.get("aria-hidden") == "true"
        assert is_hidden or drawing.text or "role" not in drawing.attributes


@pytest.mark.slow
def test_text_of_strangers_is_shown_not_run(home: Path, tmp_path: Path) -> None:
    """Hostile names of methods, files and trainings stand on the page as text."""
    bench = make_report_bench(home, "curl-noise")
    cards = []
    paths = []
    for number, name in enumerate(HOSTILE):
        if "\0" in name:
            continue
        file = tmp_path / f"{number} '\"<b>&.nc"
        labels = {"training": name, "device": name}
        path = bench.submit(file, noisy, name, **labels)
        paths.append(path)
        cards.append(bench.card(path))
    scored = ScoredFiles(bench, cards, paths)
    page = scored.report(tmp_path / "out")
    reading = read_html(page.read_text("utf-8"))
    assert not reading.faults
    assert_harmless(reading)
    title = title_of(reading)
    for card in cards:
        assert card.header.method in title
    command, *_ = reading.named("pre")
    assert "0 '" in command.text


PLAIN = "Größe µ ≤ 3 × 10⁻⁴,\n\t'x' & \"y\" <z> 中文 🙂"
"""Letters, signs and line breaks, none of which is replaced."""


@given(st.text())
@example(PLAIN)
def test_any_text_survives_escaping(words: str) -> None:
    """Text in an element and in an attribute stays, but for what cannot be shown."""
    html = tag("p", words, title=words)
    reading = read_html(html)
    assert not reading.faults
    (element,) = reading.elements
    assert element.attributes["title"] == element.text
    for shown, meant in zip(element.text, words, strict=True):
        is_replaced = shown in "\ufffd?" and words != PLAIN
        assert shown == meant or is_replaced


def test_markup_is_not_escaped_again() -> None:
    """An element may hold elements."""
    assert tag("p", Markup("<b>x</b>")) == "<p><b>x</b></p>"


@pytest.mark.slow
def test_same_bytes_every_time(
    home: Path,
    page: Page,
    tmp_path: Path,
) -> None:
    """The same predictions give the same page; no folder stands in it."""
    bench = make_report_bench(home, "multimaterial")
    first = reported(bench, tmp_path / "there", METHODS)
    assert first == page("multimaterial")
    assert "the bands are" in first
    assert str(tmp_path) not in first
    assert str(bench.root) not in first


@pytest.mark.slow
@pytest.mark.parametrize("split", ["cavity", "multimaterial"])
def test_undefined_and_huge_numbers_are_drawn_around(
    home: Path, tmp_path: Path, split: str
) -> None:
    """A prediction at rest has no correlation, a runaway leaves every axis."""
    bench = make_report_bench(home, split)
    methods = {"rest": still, "odd": runaway}
    reading = read_html(reported(bench, tmp_path, methods))
    assert not reading.faults
    for element in reading.elements:
        for name in NUMERIC_ATTRIBUTES:
            value = element.attributes.get(name, "")
            place = (element.name, name, value[:80])
            assert not re.search(r"nan|inf|e\+?\d", value), place
            for number in re.findall(r"\d+", value):
                assert len(number) < 8, place
    assert set(expected_figures(split)) <= set(reading.ids)


Reported = tuple[ScoreCard, Path]


@pytest.fixture(scope="module")
def damped_cavity(home: Path, tmp_path_factory: pytest.TempPathFactory) -> Reported:
    """One method on cavity with its report."""
    bench = make_report_bench(home, "cavity")
    folder = tmp_path_factory.mktemp("damped")
    labels = {
        "parameters": 1_600_000,
        "seconds_per_frame": 0.25,
    }
    scored = score_methods(bench, folder, ("damped", damped), **labels)
    return scored.cards[0], scored.report(folder)


def test_scores_on_the_page_are_those_of_the_scorer(damped_cavity: Reported) -> None:
    """The ranking metric opens the table; there is no interval of two scenarios."""
    card, path = damped_cavity
    html = path.read_text("utf-8")
    reading = read_html(html)
    means = [element.text for element in reading.of_class("n")]
    expected = []
    for scores in card.scores.values():
        score = scores[card.ranking]
        expected.append(text(score.mean))
        assert np.isnan(score.interval).all()
    assert means[: len(expected)] == expected
    for element in reading.of_class("ci"):
        assert "…" not in element.text
    assert "the bands are" not in html


def test_the_page_identifies_what_was_scored(damped_cavity: Reported) -> None:
    """Hashes, the number of parameters, flags and the command stand on it."""
    card, path = damped_cavity
    reading = read_html(path.read_text("utf-8"))
    (main,) = reading.named("main")
    expected = [
        card.predictions_sha256,
        card.header.dataset_sha256,
        "lagbench score 0.nc --report report",
        "1\u202f600\u202f000",
    ]
    expected += [flag.name.replace("_", " ") for flag in card.flags]
    assert [words for words in expected if words not in main.text] == []


def test_reference_predictors_have_no_rank(home: Path, tmp_path: Path) -> None:
    """Two submissions, both worse than persistence, are ranked 1 and 2."""
    bench = make_report_bench(home, "curl-noise")
    page = reported(bench, tmp_path, {"m0": noisy, "m1": noisy})
    (table,) = re.findall(r'aria-label="Comparison".*?</table>', page, re.DOTALL)
    _, *rows = re.findall(r"<tr>(.*?)</tr>", table)
    ranks = []
    for row in rows:
        cells = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)
        ranks.append(cells[1])
    assert ranks[:2] == ["1", "2"]
    assert len(ranks) > 4
    assert set(ranks[2:]) == {""}


def test_no_submission_is_called_a_leader_below_a_better_reference(
    home: Path, tmp_path: Path
) -> None:
    """A sentence above the table says that only submissions have a rank."""
    bench = make_report_bench(home, "curl-noise")
    page = reported(bench, tmp_path, {"m0": noisy})
    above, _, below = page.partition('aria-label="Comparison"')
    table, _, _ = below.partition("</table>")
    assert "m0" in table
    assert "leader" not in table
    _, _, lead = above.rpartition("<h4>")
    assert "only submissions have a rank" in lead.lower()


def test_methods_of_one_name_are_numbered(home: Path, tmp_path: Path) -> None:
    """Two files of one method get numbers, and so does a reference predictor's name."""
    bench = make_report_bench(home, "curl-noise")
    methods = (
        ("gns", damped),
        ("gns", noisy),
        ("persistence", still),
    )
    scored = score_methods(bench, tmp_path, *methods)
    page = scored.report(tmp_path)
    reading = read_html(page.read_text("utf-8"))
    assert title_of(reading) == "gns (1) · gns (2) · persistence (1)"


def test_a_method_may_have_the_name_of_a_row(home: Path, tmp_path: Path) -> None:
    """Panels of the truth, of the method and of their difference stand in rows."""
    bench = make_report_bench(home, "curl-noise")
    methods = (("truth", damped), ("difference", noisy), ("speed", still))
    page = score_methods(bench, tmp_path, *methods).report(tmp_path)
    reading = read_html(page.read_text("utf-8"))
    assert title_of(reading) == "truth · difference · speed"


def test_files_of_another_minor_version_of_the_data_are_reported_together(
    home: Path, tmp_path: Path
) -> None:
    """The hash identifies the data set, and only MAJOR versions change it."""
    bench = make_report_bench(home, "curl-noise")
    scored = score_methods(bench, tmp_path, ("a", damped), ("b", noisy))
    _, second = scored.paths
    major, _, _ = bench.size.version.partition(".")
    with h5py.File(second, "r+") as file:
        file.attrs["dataset_version"] = f"{major}.99.0"
    scored.cards[1] = bench.card(second)
    page = scored.report(tmp_path)
    assert title_of(read_html(page.read_text("utf-8"))) == "a · b"


def test_score_reports_must_belong_together(home: Path, tmp_path: Path) -> None:
    """No score report, one without its file, and two data sets are refused."""
    noise_bench = make_report_bench(home, "curl-noise")
    cavity_bench = make_report_bench(home, "cavity")
    noise = score_methods(noise_bench, tmp_path / "noise", ("a", still))
    cavity = score_methods(cavity_bench, tmp_path / "cavity", ("a", still))
    both_cards = noise.cards + cavity.cards
    both_paths = noise.paths + cavity.paths
    mixtures = [
        ScoredFiles(cavity_bench, [], []),
        ScoredFiles(noise_bench, noise.cards, []),
        ScoredFiles(cavity_bench, both_cards, both_paths),
    ]
    for scored in mixtures:
        with pytest.raises(UsageError):
            scored.report(tmp_path)
    assert not (tmp_path / "index.html").exists()


def test_pages_of_others_stay(home: Path, tmp_path: Path) -> None:
    """A report replaces a report, and no other page."""
    bench = make_report_bench(home, "cavity")
    scored = score_methods(bench, tmp_path, ("a", still))
    scored.report(tmp_path / "report")
    page = scored.report(tmp_path / "report")
    page.write_text("<!doctype html><title>My thesis</title>")
    with pytest.raises(UsageError) as caught:
        scored.report(tmp_path / "report")
    assert caught.value.where == "--report"
    assert caught.value.got == str(page)
    assert "My thesis" in page.read_text()


def subject_on(split: str, size_name: str) -> Subject:
    """Return a subject without entries: enough to ask which frames are shown."""
    size = load().size(split, size_name)
    config = TaskConfig(
        grid=Grid(size.task.score_grid.cells),
        attribute_std=(1.0,) * 4,
        input_frames=size.task.input_frames,
        horizon=size.task.horizon,
        frames_of_interest=size.task.frames_of_interest,
        radius=size.task.radius,
    )
    truth = Truth(size, Path())
    task = ScoredTask(truth=truth, config=config, density=1.0)
    return Subject(task=task, title=split, entries=())


@pytest.mark.parametrize("size", ["full", "mini"])
@pytest.mark.parametrize(
    ("split", "frame"),
    [
        ("cavity", 54),
        ("curl-noise", 40),
        ("fluid", 60),
        ("multimaterial", 60),
    ],
)
def test_models_are_compared_at_the_frame_of_the_thesis(
    split: str, frame: int, size: str
) -> None:
    """That is frame 54, 35 after the last given one (5), and 60."""
    assert subject_on(split, size).key_frame == frame


@pytest.mark.parametrize("size", ["full", "mini", "tiny"])
@pytest.mark.parametrize("split", SPLITS)
def test_pictures_over_time_show_six_predicted_frames(split: str, size: str) -> None:
    """They ascend; the first and the last predicted frame are among them."""
    subject = subject_on(split, size)
    predicted = subject.task.config.predicted_frames
    assert len(subject.times) == 6
    assert subject.times[0] == predicted[0]
    assert subject.times[-1] == predicted[-1]
    assert list(subject.times) == sorted(subject.times)


def test_histograms_of_cavity_are_at_the_frames_of_the_thesis() -> None:
    """Fig. 5.18 shows frames 6, 9, 18, 21, 48 and 51."""
    subject = subject_on("cavity", "full")
    assert subject.histogram_frames == (6, 9, 18, 21, 48, 51)


def read_values(address: str) -> NDArray[np.float64]:
    """Return a signed picture's values from -1 to 1, shape [x node, y node]."""
    png = base64.b64decode(address.removeprefix("data:image/png;base64,"))
    image = Image.open(io.BytesIO(png)).convert("RGBA")
    pixels = np.asarray(image).astype(np.float64)
    red, green, blue, opacity = np.moveaxis(pixels, -1, 0)
    sign = np.where(red > blue, 1.0, -1.0)
    is_grey = (red == 128) & (green == 128)
    values = np.where(is_grey, np.nan, sign * opacity / 255.0)
    return values[::-1].T


def test_maps_show_their_frames(home: Path, tmp_path: Path) -> None:
    """Each panel of true vorticity holds the field of x(f) - x(f-1) at its frame f."""
    bench = make_report_bench(home, "curl-noise")
    page = reported(bench, tmp_path, {"damped": damped})
    size = bench.size
    first_scenario = size.subsets["test"][0]
    stored_truth = motion(size, first_scenario).astype(np.float32)
    truth = stored_truth.astype(np.float64)
    grid = Grid(size.task.score_grid.cells)
    (low, high), _ = size.bounds
    full = grid.full_weight(size.particles, (high - low) ** 2)

    shown = {}
    expected = {}
    for image in read_html(page).named("img"):
        description = image.attributes["alt"]
        match = re.fullmatch(r"true vorticity, frame (\d+)", description)
        if match is None:
            continue
        frame = int(match[1])
        shown[frame] = read_values(image.attributes["src"])
        position = truth[frame]
        displacement = position - truth[frame - 1]
        flow = fields(position, displacement, grid, full=full)
        expected[frame] = flow.vorticity
    assert len(shown) == 6

    limit = limit_of(list(expected.values()))
    for frame, values in shown.items():
        field = crop_to_walls(bench.task, expected[frame])
        share = np.clip(field / limit, -1.0, 1.0)
        assert_allclose(values, share, atol=0.0101, equal_nan=True)


def test_scenarios_that_are_not_drawn_are_counted(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two rows of panels have room for one of the two scenarios."""
    monkeypatch.setattr("lagbench.figures.report.particles.MOST_ROWS", 2)
    bench = make_report_bench(home, "fluid")
    page = reported(bench, tmp_path, {"damped": damped})
    figures = [name for name in expected_figures("fluid") if f'id="{name}"' in page]
    assert "particles-3" in figures
    assert "particles-4" not in figures
    assert "Not drawn for want of room: 1 scenario." in page


def test_style_sheet_is_packaged() -> None:
    """Files in the folder that are no modules are named in pyproject.toml."""
    project_text = (ROOT / "pyproject.toml").read_text()
    setuptools = tomllib.loads(project_text)["tool"]["setuptools"]
    patterns = setuptools["package-data"]["lagbench.figures"]
    folder = Path(str(lagbench.figures.__file__)).parent
    names = []
    for path in folder.iterdir():
        if path.is_file() and path.suffix != ".py":
            names.append(path.name)
    assert "style.css" in names
    for name in names:
        is_packaged = [fnmatch(name, pattern) for pattern in patterns]
        assert any(is_packaged), name


def report_on_adopted(folder: Path, *, counts: Sequence[int], interval: float) -> str:
    """Return a report on a local split with so many particles in each scenario.

    The last two scenarios are its test.
    """
    runs = []
    for scenario, count in enumerate(counts):
        runs += straight_runs(1, frames=8, particles=count, seed=scenario)
    return report_on_runs(folder, runs, interval=interval)


def report_on_runs(
    folder: Path, runs: Sequence[NDArray[np.float32]], *, interval: float
) -> str:
    """Return a report on a local split of trajectories, predicted without error."""
    paths = []
    predictions = {}
    for scenario, run in enumerate(runs):
        path = folder / f"run{scenario}.npz"
        np.savez(path, position=run)
        paths.append(path)
        if scenario >= len(runs) - 2:
            predictions[scenario] = run[2:]
    adopted = adopt(
        paths,
        output=folder / "mine",
        valid=1,
        test=2,
        radius=0.1,
        frame_interval=interval,
        input_frames=2,
    )
    file = write(
        folder / "predictions.nc", predictions, split=adopted.folder, method="straight"
    )
    card = score(file, root=folder, workers=1, write=False)
    page = write_report(folder / "report", [card], [file], root=folder)
    return page.read_text("utf-8")


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ((90, 60, 40, 40), "40 particles"),
        ((90, 60, 50, 40), "40 to 50 particles"),
        ((40, 40, 40, 40), "40 particles"),
    ],
)
def test_the_head_counts_the_particles_of_the_scenarios_that_are_scored(
    tmp_path: Path, counts: Sequence[int], words: str
) -> None:
    """A scenario of train may have more."""
    page = report_on_adopted(tmp_path, counts=counts, interval=0.1)
    assert f", {words}, data set version" in page
    assert "90 particles" not in page


def test_each_picture_over_time_states_another_time(tmp_path: Path) -> None:
    """Frames may be less than a hundredth of a second apart."""
    page = report_on_adopted(tmp_path, counts=(40, 40, 40, 40), interval=0.002)
    times = set(re.findall(r"frame (\d+)\u2002([0-9.]+) s", page))
    assert ("3", "0.006") in times
    assert len({seconds for _, seconds in times}) == len(times) >= 2


@pytest.mark.slow
def test_histograms_of_three_dimensions_count_components(tmp_path: Path) -> None:
    """Each node has three; in two dimensions it has one vorticity."""
    side = np.linspace(-0.2, 0.2, 12)
    grid = np.meshgrid(side, side, side, indexing="ij")
    x, y, z = np.stack(grid).reshape(3, -1)
    spin = np.stack([-y, x, 0.5 * x], axis=-1)
    place = np.stack([x, y, z], axis=-1) + 0.4
    runs = []
    for scenario in range(4):
        pace = 0.02 + 0.002 * scenario
        frames = [place + pace * frame * spin for frame in range(8)]
        runs.append(np.array(frames, np.float32))
    solid = report_on_runs(tmp_path, runs, interval=0.1)
    assert "share of nodes" not in solid
    assert "share of components" in solid
    flat_folder = tmp_path / "flat"
    flat_folder.mkdir()
    flat = report_on_adopted(flat_folder, counts=(40, 40, 40, 40), interval=0.1)
    assert "share of nodes" in flat
    assert "share of components" not in flat


def test_the_stable_tile_says_how_many_frames_do_not_count() -> None:
    """Two scenarios of 3 frames have 2 frames without a correlation."""
    name = "vorticity_pearson"
    correlations = [
        (0.96, math.nan, math.nan),
        (0.96, 0.96, 0.9),
    ]
    tallies = {}
    for scenario, values in enumerate(correlations):
        by_frame = {}
        for frame, value in enumerate(values, start=2):
            by_frame[frame] = {name: value}
        tallies[scenario] = Tally.of([name], range(2, 5), by_frame)
    metric = METRICS["stable_frames"]
    stable = aggregate([metric], tallies)["stable_frames"]
    assert stable.values.tolist() == [1.0, 2.0]
    note = describe_stability(stable)
    assert "of 3" in note
    assert "0.95" in note
    assert "2 of 6" in note
