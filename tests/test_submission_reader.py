"""Reading predictions: by id, in any packing and byte order, in bounded memory."""

from __future__ import annotations

import hashlib
import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from bad_submissions import FAULTS
from faulty import positions, rows, store
from submission_data import FRAMES, GIVEN, HORIZON, PARTICLES, TESTS, Bench, frozen, make_bench, truth

from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError
from lagbench.submission import open_predictions, write

ALL = list(range(GIVEN, FRAMES))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A small data set and a valid submission."""
    return make_bench(tmp_path_factory.mktemp("bench"))


def test_frames_are_found_by_id_and_absolute_number(bench: Bench) -> None:
    """Scenario 4, three frames from frame 5 on."""
    with open_predictions(bench.valid) as predictions:
        got = predictions.frames(4, 5, 3)
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, truth(4)[5 - GIVEN : 8 - GIVEN])


def test_the_header_says_what_was_written(bench: Bench) -> None:
    """Names, ids, frames, optional attributes."""
    with open_predictions(bench.valid) as predictions:
        header = predictions.header
    assert (header.split, header.size, header.method) == ("cavity", "tiny", "truth")
    assert (header.scenarios, header.frames, header.particles) == (TESTS, tuple(ALL), PARTICLES)
    assert (header.seconds_per_frame, header.seed, header.device) == (0.25, 7, None)


def test_scenarios_in_another_order_are_matched_by_id(bench: Bench) -> None:
    """A reordered file is valid, reads the same and has the same content hash."""
    path = rows(bench, "reordered", [5, 3, 4], ALL, [2, 0, 1])
    assert bench.validate(path).passed == bench.validate(bench.valid).passed
    with open_predictions(path) as shuffled, open_predictions(bench.valid) as plain:
        assert shuffled.header.scenarios == (5, 3, 4)
        for scenario in TESTS:
            np.testing.assert_array_equal(
                shuffled.frames(scenario, GIVEN, HORIZON), plain.frames(scenario, GIVEN, HORIZON)
            )
        assert shuffled.content_sha256() == plain.content_sha256()


PACKINGS: dict[str, dict[str, Any]] = {
    "contiguous": {},
    "big_endian": {"dtype": ">f4"},
    "one_chunk": {"chunks": (3, 8, PARTICLES, 2), "compression": 9},
    "chunks_over_scenarios": {"chunks": (2, 3, 7, 1), "compression": 1, "shuffle": True},
    "checksummed": {"chunks": (1, 1, PARTICLES, 2), "fletcher32": True},
    "unlimited": {"chunks": (1, 1, PARTICLES, 2), "maxshape": (None, None, PARTICLES, 2)},
}


@pytest.mark.parametrize("name", PACKINGS)
def test_packing_does_not_matter(bench: Bench, name: str) -> None:
    """Valid, equal values in the machine's byte order, equal content hash."""
    path = bench.copy(f"{name}.nc")
    with h5py.File(path, "r+") as file:
        store(file, positions(file), **PACKINGS[name])
    assert not bench.validate(path).findings
    with open_predictions(path) as packed, open_predictions(bench.valid) as plain:
        got = packed.frames(3, GIVEN, HORIZON)
        assert got.dtype.isnative
        np.testing.assert_array_equal(got, truth(3))
        assert packed.content_sha256() == plain.content_sha256()


def _extra(file: h5py.File) -> None:
    file.create_group("notes").attrs["author"] = "someone"
    file["more"] = np.zeros(3)
    file.attrs["comment"] = "x" * 1000


def _xarray(file: h5py.File) -> None:
    file.attrs["lagbench_format"] = np.int64(1)


@pytest.mark.parametrize("change", [_extra, _xarray])
def test_what_the_format_does_not_know_is_ignored(bench: Bench, change: Callable[[h5py.File], None]) -> None:
    """Further variables, groups and attributes, and wider integers, do no harm."""
    path = bench.copy("extra.nc")
    with h5py.File(path, "r+") as file:
        change(file)
    assert not bench.validate(path).findings


def test_files_of_xarray_and_links_to_files_are_read(bench: Bench) -> None:
    """Opened, stored and symlinked with nothing of ours."""
    with xr.open_dataset(bench.valid) as dataset:
        assert dataset["position"].dims == ("scenario", "frame", "particle", "space")
        dataset.to_netcdf(bench.folder / "xarray.nc")
    link = bench.folder / "link.nc"
    link.symlink_to(bench.folder / "xarray.nc")
    assert not bench.validate(link).findings


def test_the_content_hash_is_that_of_the_document(bench: Bench) -> None:
    """Computed by hashlib and json alone, as docs/predictions.md says."""
    values = np.stack([truth(i) for i in TESTS]).astype("<f4")
    header = {
        "dims": ["scenario", "frame", "particle", "space"],
        "dtype": "float32",
        "name": "position",
        "shape": list(values.shape),
    }
    variable = hashlib.sha256(_json(header) + b"\n" + values.tobytes()).hexdigest()
    with open_predictions(bench.valid) as predictions:
        got, head = predictions.content_sha256(), predictions.header
    whole = {
        "dataset_sha256": head.dataset_sha256,
        "dataset_version": "2.2.0",
        "frames": ALL,
        "method": "truth",
        "scenarios": list(TESTS),
        "size": "tiny",
        "split": "cavity",
        "variables": {"position": variable},
    }
    assert got == hashlib.sha256(_json(whole)).hexdigest()


def _json(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def test_blocks_cover_a_scenario_in_order_and_in_bounded_memory(tmp_path: Path) -> None:
    """A scenario of 96 MB in pieces of 1 MiB, read in less than 20 MB."""
    path = tmp_path / "large.nc"
    frames, particles = 120, 100_000
    with h5py.File(path, "w") as file:
        for name, values in {"scenario": [1], "frame": np.arange(2, 2 + frames)}.items():
            file[name] = np.asarray(values)
            file[name].make_scale(name)
        for name, length in {"particle": particles, "space": 2}.items():
            file[name] = np.zeros(length)
            file[name].make_scale(name)
        shape, chunks = (1, frames, particles, 2), (1, 1, particles, 2)
        position = file.create_dataset("position", shape, "f4", chunks=chunks)
        for frame in range(frames):
            position[0, frame] = frame
        for axis, name in enumerate(("scenario", "frame", "particle", "space")):
            position.dims[axis].attach_scale(file[name])
        file.attrs.update(lagbench_format=1, split="a", size="b", method="c")
        file.attrs.update(dataset_version="1.0.0", dataset_sha256="d")
    tracemalloc.start()
    seen: list[int] = []
    with open_predictions(path) as predictions:
        for first, block in predictions.blocks(1):
            assert (block[:, 0, 0] == np.arange(len(seen), len(seen) + len(block))).all()
            assert first == 2 + len(seen)
            seen += [first] * len(block)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(seen) == frames
    assert peak < 20e6


@pytest.mark.parametrize(
    ("scenario", "start", "count"), [(9, 3, 1), (3, 2, 1), (3, 3, 9), (3, 11, 1), (3, 3, -1)]
)
def test_frames_that_are_not_there_are_named(bench: Bench, scenario: int, start: int, count: int) -> None:
    """No such scenario, before the first, beyond the last."""
    with open_predictions(bench.valid) as predictions, pytest.raises(UsageError, match="no such frames"):
        predictions.frames(scenario, start, count)


@pytest.mark.parametrize("name", ["fifo", "truncated_half", "netcdf3"])
def test_opening_what_is_unreadable_raises(bench: Bench, name: str) -> None:
    """Exit code 3."""
    with pytest.raises(UnreadableFileError):
        open_predictions(FAULTS[name].make(bench))


@pytest.mark.parametrize(
    "name", ["external_link", "virtual_dataset", "positions_float64", "space_before_particle"]
)
def test_opening_another_layout_raises(bench: Bench, name: str) -> None:
    """Exit code 1, naming the check."""
    with pytest.raises(ChecksFailedError, match=FAULTS[name].check):
        open_predictions(FAULTS[name].make(bench))


def test_a_frozen_rollout_is_recorded(bench: Bench) -> None:
    """diverged_at comes back by id; other scenarios have none."""
    path = bench.folder / "frozen.nc"
    values = {i: truth(i) for i in TESTS}
    values[5] = frozen(truth(5), 7)
    write(path, values, split="cavity", size="tiny", method="m", registry=bench.registry, diverged_at={5: 7})
    with open_predictions(path) as predictions:
        assert predictions.header.diverged_at == {5: 7}
    assert not bench.validate(path).findings
