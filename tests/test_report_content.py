"""The report shows the right frames of the right scenarios."""

from __future__ import annotations

import base64
import io
import math
import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
from html_check import read_html
from numpy.typing import NDArray
from PIL import Image
from report_bench import damped, make_report_bench, motion

import lagbench.report
from lagbench.data.grid import Grid, fields
from lagbench.data.registry import load
from lagbench.metrics import METRICS, Setting, Tally, aggregate
from lagbench.report.maps import inside, limit_of
from lagbench.report.subject import Subject
from lagbench.report.tables import stable_of
from lagbench.scoring.task import ScoredTask
from lagbench.submission.truth import Truth


def subject_on(split: str, size_name: str) -> Subject:
    """Return a subject without entries: enough to ask which frames are shown."""
    size = load().size(split, size_name)
    task = size.task
    setting = Setting(
        grid=Grid(task.score_grid.cells),
        input_frames=task.input_frames,
        horizon=task.horizon,
        frames_of_interest=task.frames_of_interest,
        attribute_std=(1.0, 1.0, 1.0, 1.0),
        radius=task.radius,
    )
    scored = ScoredTask(truth=Truth(size, Path()), setting=setting, density=1.0)
    return Subject(task=scored, title=split, entries=())


@pytest.mark.parametrize(
    ("split", "frame"), [("cavity", 54), ("curl-noise", 40), ("fluid", 60), ("multimaterial", 60)]
)
def test_key_frame_is_that_of_the_thesis(split: str, frame: int) -> None:
    """Models are compared at frame 54, at 35 after the last given one (5), and at 60."""
    for size in ("full", "mini"):
        assert subject_on(split, size).key_frame == frame


def test_histograms_are_at_the_frames_of_the_thesis() -> None:
    """Fig. 5.18 shows frames 6, 9, 18, 21, 48 and 51."""
    assert subject_on("cavity", "full").histogram_frames == (6, 9, 18, 21, 48, 51)


@pytest.mark.parametrize("split", ["cavity", "curl-noise", "fluid", "multimaterial"])
@pytest.mark.parametrize("size", ["full", "mini", "tiny"])
def test_pictures_over_time_are_six(split: str, size: str) -> None:
    """Six ascending predicted frames, the first and the last among them."""
    subject = subject_on(split, size)
    predicted = subject.task.setting.predicted_frames
    assert len(subject.times) == 6
    assert list(subject.times) == sorted(subject.times)
    assert (subject.times[0], subject.times[-1]) == (predicted[0], predicted[-1])


def opacity(address: str) -> NDArray[np.float64]:
    """Return a signed picture's values from -1 to 1, shape [x node, y node], as Pillow reads it."""
    png = base64.b64decode(address.removeprefix("data:image/png;base64,"))
    shown = np.asarray(Image.open(io.BytesIO(png)).convert("RGBA")).astype(np.float64)
    sign = np.where(shown[..., 0] > shown[..., 2], 1.0, -1.0)
    grey = (shown[..., 0] == 128) & (shown[..., 1] == 128)
    return np.where(grey, np.nan, sign * shown[..., 3] / 255.0)[::-1].T


def test_maps_show_their_frames(home: Path, tmp_path: Path) -> None:
    """Each panel of true vorticity holds the field of x(f) - x(f-1) at its frame f, none other."""
    bench = make_report_bench(home, "curl-noise")
    page = bench.report(tmp_path, {"damped": damped}).read_text("utf-8")
    truth = motion(bench.size, bench.size.subsets["test"][0]).astype(np.float32).astype(np.float64)
    grid = Grid(bench.size.task.score_grid.cells)
    (low, high), _ = bench.size.bounds
    full = grid.full_weight(bench.size.particles, (high - low) ** 2)

    def vorticity(frame: int) -> NDArray[np.float64]:
        return fields(truth[frame], truth[frame] - truth[frame - 1], grid, full=full).vorticity

    panels = {
        int(found[1]): opacity(image.attributes["src"])
        for image in read_html(page).named("img")
        if (found := re.fullmatch(r"true vorticity, frame (\d+)", image.attributes["alt"]))
    }
    assert len(panels) == 6
    limit = limit_of([vorticity(frame) for frame in panels])
    for frame, shown in panels.items():
        meant = np.clip(inside(bench.task, vorticity(frame)) / limit, -1.0, 1.0)
        np.testing.assert_array_equal(np.isnan(shown), np.isnan(meant))
        np.testing.assert_allclose(np.nan_to_num(shown), np.nan_to_num(meant), atol=0.0101)


def test_style_sheet_is_packaged() -> None:
    """Whatever lies in the package and is no module is named in pyproject.toml, so that wheels hold it."""
    root = Path(__file__).parents[1]
    data = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    folder = Path(str(lagbench.report.__file__)).parent
    others = [p.name for p in folder.iterdir() if p.is_file() and p.suffix != ".py"]
    assert "style.css" in others
    assert all(any(fnmatch(name, pattern) for pattern in data["lagbench.report"]) for name in others)


def test_the_stable_tile_says_how_many_frames_do_not_count() -> None:
    """Two scenarios of 3 frames, 2 of them without a correlation: both numbers stand on the tile."""
    names, frames, nan = ("vorticity_pearson",), (2, 3, 4), math.nan
    rows = {0: (0.96, nan, nan), 1: (0.96, 0.96, 0.9)}
    tallies = {
        i: Tally.of(names, frames, {f: {names[0]: v} for f, v in zip(frames, row, strict=True)})
        for i, row in rows.items()
    }
    stable = aggregate([METRICS["stable_frames"]], tallies)["stable_frames"]
    assert stable.values.tolist() == [1.0, 2.0]
    assert stable_of(stable) == "of 3, correlation above 0.95; 2 of 6 frames undefined"
