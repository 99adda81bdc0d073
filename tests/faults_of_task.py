"""Faults of what was asked: split, data set, dimensions, scenarios, frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from fault_registry import (
    DIMS,
    FAULTS,
    Fault,
    attribute,
    fault,
    positions,
    replace,
    rows,
    simple,
    store,
)
from numpy.typing import NDArray
from submission_data import FRAMES, GIVEN, PARTICLES, Bench

attribute("unknown_split", "split", "cavty", check="split", says="cavity")
attribute("unknown_size", "size", "huge", check="split", says="full")
attribute("unknown_subset", "subset", "shift", check="split", says="'subset'")
attribute("endless_subset", "subset", "x" * 60000, check="split")
attribute("path_as_split", "split", "../../etc", check="split")
attribute("wrong_split", "split", "curl-noise", check="particles", says="506")
attribute(
    "stale_hash", "dataset_sha256", "ab" * 32, check="dataset", says="another data set"
)
attribute("shortened_hash", "dataset_sha256", "abcdef", check="dataset")
attribute(
    "another_major_version", "dataset_version", "3.0.0", check="dataset", says="version"
)
attribute(
    "version_in_words", "dataset_version", "latest", check="dataset", says="version"
)

# --- dimensions -----------------------------------------------------------------------


def _transposed(name: str, order: tuple[int, ...], says: str) -> None:
    dims = tuple(DIMS[axis] for axis in order)

    def change(file: h5py.File) -> None:
        replace(file, "position", dims, positions(file).transpose(order))

    simple("dims", name, change, says=says)


_transposed("space_before_particle", (0, 1, 3, 2), "transpose")
_transposed("frame_before_scenario", (1, 0, 2, 3), "transpose")
simple(
    "dims",
    "axes_swapped_names_kept",
    lambda f: _unchecked(f, positions(f).swapaxes(2, 3)),
    says="swapped",
)
simple(
    "dims",
    "one_scenario_only",
    lambda f: replace(f, "position", DIMS[1:], positions(f)[0]),
    says="leading",
)
simple(
    "dims",
    "one_frame_only",
    lambda f: replace(
        f, "position", ("scenario", "particle", "space"), positions(f)[:, 0]
    ),
    says="'frame'",
)
simple(
    "dims",
    "one_component_only",
    lambda f: replace(f, "position", DIMS[:3], positions(f)[..., 0]),
    says="'space'",
)
simple(
    "dims",
    "one_scenario_without_names",
    lambda f: _bare(f, positions(f)[0]),
    says="scales",
)
simple(
    "dims", "dimensions_without_names", lambda f: _bare(f, positions(f)), says="scales"
)
simple("dims", "flattened", lambda f: _bare(f, positions(f).reshape(3, -1)))
simple(
    "dims",
    "three_components",
    lambda f: _unchecked(f, np.zeros((3, 8, PARTICLES, 3), "f4")),
)
simple(
    "dims", "fewer_frames_than_numbers", lambda f: _unchecked(f, positions(f)[:, :5])
)
simple("format", "scalar_position", lambda f: replace(f, "position", (), np.float32(1)))


def _bare(file: h5py.File, values: NDArray[np.float32]) -> None:
    del file["position"]
    file["position"] = values


def _unchecked(file: h5py.File, values: NDArray[np.float32]) -> None:
    """Attach scales whatever their lengths."""
    store(file, values)


@fault("dims", says="'odd_name'")
def dimension_misnamed(bench: Bench) -> Path:
    """Particles under another name."""
    path = bench.folder / "dimension_misnamed.nc"
    with h5py.File(bench.copy(path.name), "r+") as file:
        values = positions(file)
        file.move("particle", "odd_name")
        replace(file, "position", ("scenario", "frame", "odd_name", "space"), values)
    return path


@fault("particles", says="2147483648")
def two_billion_particles(bench: Bench) -> Path:
    """2^31 particles that take no room in the file: 412 GB of zeros."""
    path = bench.copy("two_billion_particles.nc")
    with h5py.File(path, "r+") as file:
        shape = (3, 8, 1 << 31, 2)
        chunks = (1, 1, 1 << 22, 2)
        replace(
            file,
            "position",
            DIMS,
            shape=shape,
            chunks=chunks,
            dtype="f4",
            compression=1,
        )
    return path


@fault("format", says="coordinate")
def two_billion_frames(bench: Bench) -> Path:
    """2^31 frame numbers and as many frames, all of them zero."""
    path = bench.copy("two_billion_frames.nc")
    count = 1 << 31
    with h5py.File(path, "r+") as file:
        replace(
            file,
            "frame",
            (),
            shape=(count,),
            chunks=(1 << 16,),
            dtype="i4",
            compression=1,
        )
        file["frame"].make_scale("frame")
        shape = (3, count, PARTICLES, 2)
        chunks = (1, 1 << 16, PARTICLES, 2)
        replace(
            file,
            "position",
            DIMS,
            shape=shape,
            chunks=chunks,
            dtype="f4",
            compression=1,
        )
    return path


@fault("frames", says="3-19999 (19997)")
def twenty_thousand_frames(bench: Bench) -> Path:
    """Readable coordinates, positions of 23 GB that take no room."""
    path = bench.copy("twenty_thousand_frames.nc")
    with h5py.File(path, "r+") as file:
        replace(file, "frame", (), np.arange(GIVEN, 20_000)).make_scale("frame")
        shape = (3, 20_000 - GIVEN, PARTICLES, 2)
        chunks = (1, 100, PARTICLES, 2)
        replace(
            file,
            "position",
            DIMS,
            shape=shape,
            chunks=chunks,
            dtype="f4",
            compression=1,
        )
    return path


# --- scenarios and frames -------------------------------------------------------------

ALL = list(range(GIVEN, FRAMES))


def _rows(
    name: str,
    check: str,
    scenarios: list[int],
    frames: list[int],
    pick: Any = slice(None),
    *,
    says: str,
) -> None:
    FAULTS[name] = Fault(
        lambda bench: rows(bench, name, scenarios, frames, pick), check, 1, says=says
    )


_rows("scenario_missing", "scenarios", [3, 5], ALL, [0, 2], says="missing: 4")
_rows(
    "scenario_unknown",
    "scenarios",
    [3, 4, 5, 77],
    ALL,
    [0, 1, 2, 0],
    says="unknown: 77",
)
_rows(
    "scenario_twice", "scenarios", [3, 4, 5, 4], ALL, [0, 1, 2, 1], says="duplicate: 4"
)
_rows("scenarios_counted", "scenarios", [0, 1, 2], ALL, says="unknown: 0-2")
_rows("scenarios_of_train", "scenarios", [0, 1], ALL, [0, 1], says="unknown: 0-1")
_rows("scenario_negative", "scenarios", [-3, 4, 5], ALL, says="-3")
_rows("scenario_enormous", "scenarios", [3, 4, 1 << 62], ALL, says="unknown")
_rows("no_scenarios", "scenarios", [], ALL, slice(0), says="missing")


def _frames(name: str, frames: list[int], pick: Any = slice(None)) -> None:
    """Register a fault whose frame numbers are others than those to predict."""
    _rows(name, "frames", [3, 4, 5], frames, pick, says="3-10 (absolute numbers")


_frames("every_second_frame", ALL[::2], np.s_[:, ::2])
_frames(
    "input_frames_included",
    [0, 1, 2, *ALL],
    np.s_[:, [0] * 3 + [*range(8)]],
)
_frames("frames_counted_from_0", list(range(8)))
_frames("frames_shifted", [number + 2 for number in ALL])
_frames("frames_stop_early", ALL[:5], np.s_[:, :5])
_frames("frames_reversed", ALL[::-1], np.s_[:, ::-1])
_frames("frame_twice", [3, 4, 5, 5, 6, 7, 8, 9, 10], np.s_[:, [*range(8), 0]])
_frames("frame_left_out", [3, 4, 6, 7, 8, 9, 10], np.s_[:, :7])
_frames("no_frames", [], np.s_[:, :0])
_frames("frames_enormous", [3, 1 << 61], np.s_[:, :2])
