"""Scenarios whose frames are large: chunks of particles, and memory that does not grow
with frames.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
from independent_hash import content_hash
from scenario_factory import make_key, write_scenario

from lagbench.data import writer as files
from lagbench.data.scenario import check_scenario, read_scenario
from lagbench.work.pool import Report
from lagbench.work.run import read_many


def chunks(path: Path) -> Any:
    """Return the chunk shape of the positions, as netCDF4 tells it."""
    with netCDF4.Dataset(path) as file:
        return file["position"].chunking()


def test_a_large_frame_has_chunks_of_particles(tmp_path: Path) -> None:
    """At most 131,072 particles a chunk; the content hash, by h5py and hashlib too,
    knows nothing of it.
    """
    path, stored = write_scenario(
        tmp_path, make_key(), frames=2, particles=(1 << 17) + 1000
    )
    assert chunks(path) == [1, 131072, 2]
    assert stored == content_hash(path) == check_scenario(path)
    with read_scenario(path) as file:
        last = file.read("position", 1)
    with netCDF4.Dataset(path) as file:
        np.testing.assert_array_equal(last[-3:], file["position"][1, -3:])


def test_chunks_do_not_enter_the_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same values in other chunks: another file of the same content hash."""
    key = make_key()
    whole, first = write_scenario(tmp_path / "whole", key, particles=100)
    monkeypatch.setattr(files, "PARTICLES_PER_CHUNK", 32)
    parted, second = write_scenario(tmp_path / "parted", key, particles=100)
    assert chunks(whole) == [1, 100, 2]
    assert chunks(parted) == [1, 32, 2]
    assert whole.read_bytes() != parted.read_bytes()
    assert first == second == check_scenario(parted)


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


def test_memory_does_not_grow_with_frames(tmp_path: Path) -> None:
    """Writing, hashing and the statistics of 30 frames take what 6 take, to less than
    two frames.
    """
    peaks = []
    for frames in (6, 30):
        words = [
            "-c",
            PEAK,
            str(Path(__file__).parents[1]),
            str(tmp_path / str(frames)),
            str(frames),
        ]
        done = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, check=True
        )
        peaks.append(1024 * int(done.stdout))
    frame = 100_000 * 4 * 4  # position and velocity, two float32 each
    assert abs(peaks[1] - peaks[0]) < 2 * frame


def test_many_particles_are_drawn_by_some(tmp_path: Path) -> None:
    """150,000 particles make 50,000 dots of three times the area; a few make one
    each.
    """
    from lagbench.figures.canvas import figure
    from lagbench.figures.panels import Panel, draw
    from lagbench.figures.recording import open_recording

    drawn = {}
    for particles in (1500, 150_000):
        path, _ = write_scenario(
            tmp_path / str(particles), make_key(), frames=2, particles=particles
        )
        with open_recording(path) as recording, figure(2.0, 2.0) as page:
            axes = page.add_axes((0, 0, 1, 1))
            draw(axes, Panel.SPEED, recording.scene(1), limit=1.0, detail=0.0)
            dots = axes.collections[0]
            drawn[particles] = len(dots.get_offsets()), float(dots.get_sizes()[0])
    assert [count for count, _ in drawn.values()] == [1500, 50_000]
    # an area is that of a particle: a hundredth for a hundred times as many, times
    # three
    assert drawn[150_000][1] == pytest.approx(drawn[1500][1] * 3 / 100)


def note(path: Path, report: Report) -> tuple[str, bool]:
    """Return a file's name and whether this is the test's own process."""
    report(1)
    return path.name, "pytest" in sys.modules


def test_reading_much_is_shared_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of more than a gigabyte are read by worker processes, few bytes here; the
    order stays.
    """
    paths = {f"scenario {k}": tmp_path / f"{k}.nc" for k in range(3)}
    for path in paths.values():
        path.write_bytes(bytes(8))
    monkeypatch.syspath_prepend(Path(__file__).parent)
    units: list[int] = []
    here = read_many(note, paths, paths.values(), units.append, workers=2)
    with (tmp_path / "0.nc").open("r+b") as stream:
        stream.truncate(1 << 30)  # sparse
    there = read_many(note, paths, paths.values(), units.append, workers=2)
    assert here == [("0.nc", True), ("1.nc", True), ("2.nc", True)]
    assert [name for name, _ in there] == ["0.nc", "1.nc", "2.nc"]
    assert sum(units) == 6
