"""Predictions as files: what is written is read, in any packing, in bounded memory;
what is refused.
"""

from __future__ import annotations

import hashlib
import json
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import xarray as xr
from bad_submissions import FAULTS
from fault_registry import DIMS, positions, rows, store
from file_size_limit import largest_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal
from scenario_factory import frames_of
from submission_data import (
    FRAMES,
    GIVEN,
    HORIZON,
    PARTICLES,
    TESTS,
    Bench,
    frozen,
    small,
    truth,
)

from lagbench.data.registry import Registry
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.submission import PredictionsWriter, open_predictions, template, write

SHAPE = (HORIZON, PARTICLES, 2)
RIGHT = {i: truth(i) for i in TESTS}


bench = small


def options(bench: Bench, **more: Any) -> dict[str, Any]:
    """What every call needs."""
    return {
        "split": "cavity",
        "size": "tiny",
        "method": "m",
        "registry": bench.registry,
        **more,
    }


FINITE = st.floats(-(2.0**99), 2.0**99, width=32)


@settings(
    max_examples=10,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    values=hnp.arrays(np.float32, (len(TESTS), *SHAPE), elements=FINITE, fill=FINITE)
)
def test_what_is_written_is_read(bench: Bench, values: np.ndarray) -> None:
    """Every finite float32 comes back bit by bit, from an array and from a mapping."""
    for form in (values, dict(zip(TESTS, values, strict=True))):
        path = write(bench.folder / "round.nc", form, **options(bench))
        with open_predictions(path) as predictions:
            for row, scenario in enumerate(TESTS):
                got = predictions.frames(scenario, GIVEN, HORIZON)
                assert_array_equal(got.view("u4"), values[row].view("u4"))


def test_the_template_is_the_last_given_frame_repeated(
    bench: Bench, tmp_path: Path
) -> None:
    """Valid as it is; one frame per chunk; no time, host or path enters the file.

    Without the test scenarios the message has the command that makes them, and nothing
    is written.
    """
    made: dict[str, Any] = {"root": bench.root, "registry": bench.registry}
    result = template("cavity", "tiny", output=bench.folder / "t.nc", **made)
    assert result.scenarios == TESTS
    assert result.frames == (GIVEN, FRAMES - 1)
    assert result.particles == PARTICLES
    assert bench.validate(result.path).exit_code == 0
    with open_predictions(result.path) as predictions:
        assert predictions.header.method == "persistence"
        for scenario in TESTS:
            last = np.broadcast_to(
                frames_of(scenario, FRAMES, PARTICLES)[GIVEN - 1], SHAPE
            )
            assert_array_equal(predictions.frames(scenario, GIVEN, HORIZON), last)
    with h5py.File(result.path) as file:
        assert file["position"].chunks == (1, 1, PARTICLES, 2)
    again = template("cavity", "tiny", output=bench.folder / "twice.nc", **made)
    assert again.path.read_bytes() == result.path.read_bytes()
    with pytest.raises(DataError) as caught:
        template(
            "cavity",
            "tiny",
            output=tmp_path / "t.nc",
            **{**made, "root": tmp_path},
        )
    assert caught.value.where.endswith("cavity/tiny/v2/test")
    assert not (tmp_path / "t.nc").exists()


def test_without_a_recorded_hash_one_must_be_given(
    unmeasured: Registry, tmp_path: Path
) -> None:
    """A split that nobody measured has no hash; a given one is stored."""
    zeros = np.full((2, 20, 324, 2), 0.5)
    more: dict[str, Any] = {
        "split": "cavity",
        "size": "tiny",
        "method": "m",
        "registry": unmeasured,
    }
    with pytest.raises(DataError) as caught:
        write(tmp_path / "p.nc", zeros, root=tmp_path, **more)
    assert caught.value.where == "cavity tiny"
    path = write(
        tmp_path / "p.nc",
        zeros,
        root=tmp_path,
        dataset_sha256="ab" * 32,
        **more,
    )
    with open_predictions(path) as predictions:
        assert predictions.header.dataset_sha256 == "ab" * 32


def _nan(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[2, 5, 1] = np.nan
    return values


@pytest.mark.parametrize(
    ("values", "labels", "place"),
    [
        ({3: truth(3), 4: truth(4)}, {}, "refused.nc"),
        ({**RIGHT, 9: truth(3)}, {}, "scenario 9"),
        ({i: truth(i)[:5] for i in TESTS}, {}, "position of scenario 3"),
        ({i: truth(i).swapaxes(1, 2) for i in TESTS}, {}, "position of scenario 3"),
        ({i: _nan(truth(i)) for i in TESTS}, {}, "frame 5, particle 5"),
        ({i: truth(i).astype("f8") * 1e300 for i in TESTS}, {}, "frame 3"),
        *((np.zeros(shape), {}, "positions") for shape in ((2, *SHAPE), SHAPE)),
        ({}, {"sed": 3}, "'sed'"),
        *(({}, {"seed": odd}, "'seed'") for odd in ("three", True, 2**70)),
        ({}, {"parameters": -5}, "'parameters'"),
        *(
            ({}, {"seconds_per_frame": odd}, "'seconds_per_frame'")
            for odd in (10**400, -1, float("inf"))
        ),
        *(({}, {"device": odd}, "'device'") for odd in ("\udcff", "a\0b")),
        ({}, {"training": "x" * 70_000}, "'training'"),
        *(
            ({}, {"method": name}, "'method'")
            for name in ("", " ", "a\x07", "\udcff", "x" * 201, None)
        ),
        *(({}, {"dataset_sha256": odd}, "dataset_sha256") for odd in ("zz", "", 5)),
        # no arrays of numbers: nothing is dropped in silence
        (RIGHT | {3: np.ma.masked_less(truth(3), 0.5)}, {}, "position of scenario 3"),
        *(
            (RIGHT | {3: truth(3).astype(kind)}, {}, "position of scenario 3")
            for kind in (complex, str)
        ),
        (RIGHT | {3: [truth(3)[0], truth(3)[0, :2]]}, {}, "position of scenario 3"),
        (RIGHT | {3: torch.ones(SHAPE, requires_grad=True)}, {}, "of scenario 3"),
        # rows instead of ids
        (RIGHT, {"diverged_at": {0: 10}}, "diverged_at"),
        (RIGHT, {"velocities": RIGHT | {0: RIGHT[3]}}, "velocities"),
        # velocities of some scenarios only
        (RIGHT, {"velocities": {3: RIGHT[3]}}, "scenario 4"),
        # a mark before motion that goes on, beyond the horizon, or in the given frames
        *(
            (RIGHT, {"diverged_at": {4: mark}}, "diverged_at of scenario 4")
            for mark in (7, 100_000, GIVEN - 1, -5)
        ),
    ],
)
def test_wrong_arrays_and_labels_are_refused_and_leave_no_file(
    bench: Bench,
    values: Any,
    labels: dict[str, Any],
    place: str,
) -> None:
    """Missing, unknown, misshapen, no numbers: the error says where, what was expected
    and how to mend it; no file is left.
    """
    before = sorted(bench.folder.iterdir())
    with pytest.raises(UsageError) as caught:
        write(bench.folder / "refused.nc", values, **options(bench, **labels))
    assert place in str(caught.value.where)
    assert caught.value.expected
    assert caught.value.fix
    assert sorted(bench.folder.iterdir()) == before


def test_velocities_and_frozen_rollouts_are_recorded(bench: Bench) -> None:
    """Velocities are not read by the scorer but are there for others; diverged_at comes
    back by id.
    """
    values = RIGHT | {5: frozen(truth(5), 7)}
    more = options(
        bench, velocities={i: -v for i, v in values.items()}, diverged_at={5: 7}
    )
    path = write(bench.folder / "v.nc", values, **more)
    with h5py.File(path) as file:
        assert_array_equal(file["velocity"][...], -file["position"][...])
    with open_predictions(path) as predictions:
        assert predictions.header.diverged_at == {5: 7}
    assert not bench.validate(path).findings
    with pytest.raises(WorkFailedError) as caught:
        write(bench.valid / "p.nc", RIGHT, **options(bench))
    assert caught.value.where.endswith("valid.nc/p.nc")
    assert "--output" in str(caught.value.fix)


@pytest.mark.parametrize("size", [0, 5_000])
@pytest.mark.parametrize("whole", [True, False])
def test_a_full_disk_is_said(
    bench: Bench,
    tmp_path: Path,
    size: int,
    whole: bool,
) -> None:
    """Wherever the disk fills up, that is said and nothing is left, whatever the values
    lack.
    """
    values = RIGHT if whole else {TESTS[0]: RIGHT[TESTS[0]]}
    with largest_file(size), pytest.raises(WorkFailedError) as caught:
        write(tmp_path / "p.nc", values, **options(bench))
    assert "--output" in str(caught.value.fix)
    assert not list(tmp_path.iterdir())


def test_labels_may_come_while_writing(bench: Bench) -> None:
    """The cost of a frame is known only after the rollout; it may be a number of
    NumPy.
    """
    path = bench.folder / "late.nc"
    with PredictionsWriter(path, **options(bench)) as writer:
        for scenario in reversed(TESTS):
            writer.add(scenario, truth(scenario))
        with pytest.raises(UsageError):
            writer.add(3, truth(3))
        writer.label(
            seconds_per_frame=np.float32(0.5),
            seed=np.int64(2),
            device="one core",
        )
    with open_predictions(path) as predictions:
        header = predictions.header
        assert header.seconds_per_frame == 0.5
        assert header.seed == 2
        assert header.device == "one core"


def test_a_writer_that_failed_begins_anew(bench: Bench) -> None:
    """What an earlier try wrote is not taken for written; nothing is taken while no
    file is open.
    """
    path = bench.folder / "again.nc"
    writer = PredictionsWriter(path, **options(bench))
    with pytest.raises(UsageError):
        writer.add(TESTS[0], truth(TESTS[0]))

    def attempt(scenarios: Sequence[int], then: object = None) -> None:
        with writer:
            for scenario in scenarios:
                writer.add(scenario, truth(scenario))
            if then is not None:
                raise KeyError(then)

    with pytest.raises(KeyError):
        attempt(TESTS[:1], then="a crash")
    with pytest.raises(UsageError):
        attempt(TESTS[1:])
    assert not path.exists()
    attempt(TESTS)
    with pytest.raises(UsageError):
        attempt(())
    assert bench.validate(path).valid


ALL = list(range(GIVEN, FRAMES))


def test_frames_are_found_by_id_and_absolute_number(bench: Bench) -> None:
    """Scenario 4, three frames from frame 5 on; names, ids, frames, optional attributes
    in the header.

    No such scenario, before the first, beyond the last, fewer than none: that is told.
    """
    with open_predictions(bench.valid) as predictions:
        got = predictions.frames(4, 5, 3)
        header = predictions.header
        for place in ((9, 3, 1), (3, 2, 1), (3, 3, 9), (3, 11, 1), (3, 3, -1)):
            with pytest.raises(UsageError) as caught:
                predictions.frames(*place)
            assert caught.value.where.endswith("valid.nc")
    assert got.dtype == np.float32
    assert_array_equal(got, truth(4)[5 - GIVEN : 8 - GIVEN])
    assert header.split == "cavity"
    assert header.size == "tiny"
    assert header.method == "truth"
    assert header.scenarios == TESTS
    assert header.frames == tuple(ALL)
    assert header.particles == PARTICLES
    assert header.seconds_per_frame == 0.25
    assert header.seed == 7
    assert header.device is None


def test_scenarios_in_another_order_are_matched_by_id(bench: Bench) -> None:
    """A reordered file is valid, reads the same and has the same content hash."""
    path = rows(bench, "reordered", [5, 3, 4], ALL, [2, 0, 1])
    assert bench.validate(path).passed == bench.validate(bench.valid).passed
    with open_predictions(path) as shuffled, open_predictions(bench.valid) as plain:
        assert shuffled.header.scenarios == (5, 3, 4)
        for scenario in TESTS:
            assert_array_equal(
                *(f.frames(scenario, GIVEN, HORIZON) for f in (shuffled, plain))
            )
        assert shuffled.content_sha256() == plain.content_sha256()


PACKINGS: dict[str, dict[str, Any]] = {
    "contiguous": {},
    "big_endian": {"dtype": ">f4"},
    "one_chunk": {"chunks": (3, 8, PARTICLES, 2), "compression": 9},
    "chunks_over_scenarios": {
        "chunks": (2, 3, 7, 1),
        "compression": 1,
        "shuffle": True,
    },
    "checksummed": {"chunks": (1, 1, PARTICLES, 2), "fletcher32": True},
    "unlimited": {
        "chunks": (1, 1, PARTICLES, 2),
        "maxshape": (None, None, PARTICLES, 2),
    },
}


@pytest.mark.parametrize("name", PACKINGS)
def test_packing_does_not_matter(bench: Bench, name: str) -> None:
    """Valid, equal values in the machine's byte order, equal content hash, whatever
    else the file holds.
    """
    path = bench.copy(f"{name}.nc")
    with h5py.File(path, "r+") as file:
        store(file, positions(file), **PACKINGS[name])
        file.create_group("notes").attrs["author"] = "someone"
        file["more"] = np.zeros(3)
        file.attrs["comment"] = "x" * 1000
        file.attrs["lagbench_format"] = np.int64(1)
    assert not bench.validate(path).findings
    with open_predictions(path) as packed, open_predictions(bench.valid) as plain:
        got = packed.frames(3, GIVEN, HORIZON)
        assert got.dtype.isnative
        assert_array_equal(got, truth(3))
        assert packed.content_sha256() == plain.content_sha256()


def test_files_of_xarray_and_links_to_files_are_read(bench: Bench) -> None:
    """Opened, stored and symlinked with nothing of ours."""
    with xr.open_dataset(bench.valid) as dataset:
        assert dataset["position"].dims == DIMS
        dataset.to_netcdf(bench.folder / "xarray.nc")
    link = bench.folder / "link.nc"
    link.symlink_to(bench.folder / "xarray.nc")
    assert not bench.validate(link).findings


def test_the_content_hash_is_that_of_the_document(bench: Bench) -> None:
    """Computed by hashlib and json alone, as docs/predictions.md says."""

    def spelt(value: object) -> bytes:
        return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()

    values = np.stack([truth(i) for i in TESTS]).astype("<f4")
    header = {
        "dims": list(DIMS),
        "dtype": "float32",
        "name": "position",
    }
    variable = hashlib.sha256(
        spelt({**header, "shape": list(values.shape)}) + b"\n" + values.tobytes()
    )
    with open_predictions(bench.valid) as predictions:
        got = predictions.content_sha256()
        head = predictions.header
    whole = {
        "dataset_sha256": head.dataset_sha256,
        "dataset_version": "2.2.0",
        "method": "truth",
    }
    whole |= {
        "split": "cavity",
        "size": "tiny",
        "scenarios": list(TESTS),
        "frames": ALL,
    }
    whole |= {"variables": {"position": variable.hexdigest()}}
    assert got == hashlib.sha256(spelt(whole)).hexdigest()


def test_blocks_cover_a_scenario_in_order_and_in_bounded_memory(tmp_path: Path) -> None:
    """A scenario of 96 MB in pieces of 1 MiB, read in less than 20 MB."""
    path = tmp_path / "large.nc"
    frames = 120
    particles = 100_000
    values = np.broadcast_to(
        np.arange(frames, dtype="f4")[:, None, None], (1, frames, particles, 2)
    )
    named = {
        "lagbench_format": 1,
        "split": "a",
        "size": "b",
        "method": "c",
    }
    attributes = {
        **named,
        "dataset_version": "1.0.0",
        "dataset_sha256": "d",
    }
    coordinates = {"scenario": [1], "frame": np.arange(2, 2 + frames)}
    whole = xr.Dataset({"position": (DIMS, values)}, coordinates, attributes)
    whole.to_netcdf(path, encoding={"position": {"chunksizes": (1, 1, particles, 2)}})
    tracemalloc.start()
    seen: list[int] = []
    with open_predictions(path) as predictions:
        for first, block in predictions.blocks(1):
            assert (
                block[:, 0, 0] == np.arange(len(seen), len(seen) + len(block))
            ).all()
            assert first == 2 + len(seen)
            seen += [first] * len(block)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(seen) == frames
    assert peak < 20e6


LAYOUTS = (
    "external_link",
    "virtual_dataset",
    "positions_float64",
    "space_before_particle",
)


@pytest.mark.parametrize("name", ["fifo", "truncated_half", "netcdf3", *LAYOUTS])
def test_opening_what_is_unreadable_raises(bench: Bench, name: str) -> None:
    """Exit code 3; of another layout exit code 1, naming the check."""
    kind, words = (
        (ChecksFailedError, FAULTS[name].check)
        if name in LAYOUTS
        else (UnreadableFileError, None)
    )
    with pytest.raises(kind, match=words):
        open_predictions(FAULTS[name].make(bench))
