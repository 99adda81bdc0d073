"""Scenarios whose frames are large: their chunks, and bounded memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import netCDF4
import pytest
from independent_hash import content_hash
from numpy.testing import assert_array_equal
from scenario_factory import make_key, write_scenario

from lagbench.data import writer as files
from lagbench.data.scenario import check_scenario, read_scenario
from lagbench.work.executor import Report
from lagbench.work.run import read_many


def chunk_shape(path: Path) -> Any:
    """Return the chunk shape of the positions by netCDF4."""
    with netCDF4.Dataset(path) as file:
        return file["position"].chunking()


def test_a_large_frame_has_chunks_of_particles(tmp_path: Path) -> None:
    """A chunk has at most 131,072 particles, which the content hash does not see."""
    particles = (1 << 17) + 1000
    path, content = write_scenario(tmp_path, make_key(), frames=2, particles=particles)
    assert chunk_shape(path) == [1, 131072, 2]
    assert content_hash(path) == content
    assert check_scenario(path) == content
    with read_scenario(path) as file:
        last_frame = file.read("position", 1)
    with netCDF4.Dataset(path) as file:
        expected = file["position"][1, -3:]
    assert_array_equal(last_frame[-3:], expected)


def test_chunks_do_not_enter_the_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same values in other chunks: another file of the same content hash."""
    key = make_key()
    whole, content = write_scenario(tmp_path / "whole", key, particles=100)
    monkeypatch.setattr(files, "PARTICLES_PER_CHUNK", 32)
    parted, parted_content = write_scenario(tmp_path / "parted", key, particles=100)
    assert chunk_shape(whole) == [1, 100, 2]
    assert chunk_shape(parted) == [1, 32, 2]
    assert whole.read_bytes() != parted.read_bytes()
    assert parted_content == content
    assert check_scenario(parted) == content


PEAK = """
import re, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from scenario_factory import make_key, write_scenario
from lagbench.data.scenario import check_scenario
from lagbench.data.statistics import file_moments
import scenario_factory, numpy
particles = 100_000
frames = int(sys.argv[3])
frame = numpy.random.default_rng(0).random((particles, 2), dtype=numpy.float32)
shifts = [numpy.float32(k / 1000) for k in range(frames)]
scenario_factory.frames_of = lambda *_: (frame + shift for shift in shifts)
root = Path(sys.argv[2])
path, _ = write_scenario(root, make_key(), frames=frames, particles=particles)
check_scenario(path)
file_moments(path)
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


def peak_memory(folder: Path, frames: int) -> int:
    """Return the peak memory of a process that writes and reads a scenario [bytes]."""
    arguments = [str(Path(__file__).parents[1]), str(folder), str(frames)]
    result = subprocess.run(
        [sys.executable, "-c", PEAK, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    return 1024 * int(result.stdout)


@pytest.mark.slow
def test_memory_does_not_grow_with_frames(tmp_path: Path) -> None:
    """Writing, hashing and the statistics of 30 frames take what 6 take."""
    short = peak_memory(tmp_path / "short", 6)
    long = peak_memory(tmp_path / "long", 30)
    frame_bytes = 100_000 * 4 * 4  # position and velocity, two float32 each
    assert abs(long - short) < 2 * frame_bytes


def draw_particles(folder: Path, particles: int) -> tuple[int, float]:
    """Return the number of dots in a picture of a scenario, and their area."""
    from lagbench.figures.canvas import figure
    from lagbench.figures.panels import Panel, draw
    from lagbench.figures.recording import open_recording

    path, _ = write_scenario(folder, make_key(), frames=2, particles=particles)
    with open_recording(path) as recording, figure(2.0, 2.0) as page:
        axes = page.add_axes((0, 0, 1, 1))
        draw(axes, Panel.SPEED, recording.scene(1), limit=1.0, detail=0.0)
        dots = axes.collections[0]
        return len(dots.get_offsets()), float(dots.get_sizes()[0])


def test_many_particles_are_drawn_by_some(tmp_path: Path) -> None:
    """Of 150,000 particles every third makes a dot of three times the area."""
    few_count, few_area = draw_particles(tmp_path / "few", 1500)
    many_count, many_area = draw_particles(tmp_path / "many", 150_000)
    assert few_count == 1500
    assert many_count == 50_000
    # A particle has a hundredth of the area where there are a hundred times as many.
    assert many_area == pytest.approx(few_area * 3 / 100)


def identify_process(path: Path, report: Report) -> tuple[str, bool]:
    """Return a file's name and whether this is the test's own process."""
    report(1)
    return path.name, "pytest" in sys.modules


@pytest.mark.parametrize(
    ("first_bytes", "is_here"),
    [
        (8, True),
        (1 << 30, False),
    ],
)
def test_worker_processes_read_more_than_a_gigabyte(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    first_bytes: int,
    is_here: bool,
) -> None:
    """The order of the files stays."""
    paths = {}
    for number in range(3):
        path = tmp_path / f"{number}.nc"
        path.write_bytes(bytes(8))
        paths[f"scenario {number}"] = path
    with (tmp_path / "0.nc").open("r+b") as stream:
        stream.truncate(first_bytes)  # sparse
    monkeypatch.syspath_prepend(Path(__file__).parent)
    units: list[int] = []
    results = read_many(
        identify_process, paths, paths.values(), units.append, workers=2
    )
    assert [name for name, _ in results] == ["0.nc", "1.nc", "2.nc"]
    if is_here:
        assert all(is_own for _, is_own in results)
    assert sum(units) == 3
