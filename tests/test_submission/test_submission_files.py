"""Predictions as files: what is written is read, in any packing, in bounded memory;
what is refused.
"""

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
import torch
import xarray as xr
from faults import DIMS, FAULTS, positions, rows, store
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
from lagbench.submission import (
    PredictionsWriter,
    open_predictions,
    template,
    write,
)

SHAPE = (HORIZON, PARTICLES, 2)
RIGHT = {scenario: truth(scenario) for scenario in TESTS}


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
    values=hnp.arrays(
        np.float32,
        (len(TESTS), *SHAPE),
        elements=FINITE,
        fill=FINITE,
    )
)
def test_what_is_written_is_read(bench: Bench, values: np.ndarray) -> None:
    """Every finite float32 comes back bit by bit, from an array and from a mapping."""
    by_scenario = dict(zip(TESTS, values, strict=True))
    for form in (values, by_scenario):
        path = write(bench.folder / "round.nc", form, **options(bench))
        with open_predictions(path) as predictions:
            for scenario, expected in by_scenario.items():
                frames = predictions.frames(scenario, GIVEN, HORIZON)
                assert_array_equal(frames.view("u4"), expected.view("u4"))


def test_the_template_is_the_last_given_frame_repeated(
    bench: Bench, tmp_path: Path
) -> None:
    """Valid as it is; one frame per chunk; no time, host or path enters the file.

    Without the test scenarios the message has the command that makes them, and nothing
    is written.
    """
    location: dict[str, Any] = {
        "root": bench.root,
        "registry": bench.registry,
    }
    result = template(
        "cavity",
        "tiny",
        output=bench.folder / "t.nc",
        **location,
    )
    assert result.scenarios == TESTS
    assert result.frames == (GIVEN, FRAMES - 1)
    assert result.particles == PARTICLES
    assert bench.validate(result.path).exit_code == 0
    with open_predictions(result.path) as predictions:
        assert predictions.header.method == "persistence"
        for scenario in TESTS:
            input_frames = frames_of(scenario, FRAMES, PARTICLES)
            last_given = input_frames[GIVEN - 1]
            expected = np.broadcast_to(last_given, SHAPE)
            frames = predictions.frames(scenario, GIVEN, HORIZON)
            assert_array_equal(frames, expected)
    with h5py.File(result.path) as file:
        assert file["position"].chunks == (1, 1, PARTICLES, 2)
    again = template(
        "cavity",
        "tiny",
        output=bench.folder / "twice.nc",
        **location,
    )
    assert again.path.read_bytes() == result.path.read_bytes()
    output = tmp_path / "t.nc"
    location["root"] = tmp_path
    with pytest.raises(DataError) as caught:
        template("cavity", "tiny", output=output, **location)
    assert caught.value.where.endswith("cavity/tiny/v2/test")
    assert not output.exists()


def test_without_a_recorded_hash_one_must_be_given(
    unmeasured: Registry, tmp_path: Path
) -> None:
    """A split that nobody measured has no hash; a given one is stored."""
    halves = np.full((2, 20, 324, 2), 0.5)
    more: dict[str, Any] = {
        "split": "cavity",
        "size": "tiny",
        "method": "m",
        "registry": unmeasured,
    }
    with pytest.raises(DataError) as caught:
        write(tmp_path / "p.nc", halves, root=tmp_path, **more)
    assert caught.value.where == "cavity tiny"
    path = write(
        tmp_path / "p.nc",
        halves,
        root=tmp_path,
        dataset_sha256="ab" * 32,
        **more,
    )
    with open_predictions(path) as predictions:
        assert predictions.header.dataset_sha256 == "ab" * 32


Values = Any
Labels = dict[str, Any]


def changed(change: Callable[[np.ndarray], object]) -> Values:
    """Return the truth of all scenarios, changed."""
    return {scenario: change(values) for scenario, values in RIGHT.items()}


def with_first(values: object) -> Values:
    """Return the truth of all scenarios but the first."""
    return RIGHT | {3: values}


def with_nan(values: np.ndarray) -> np.ndarray:
    """Return positions of which one is not a number."""
    values = values.copy()
    values[2, 5, 1] = np.nan
    return values


FIRST = truth(3)
ALL = np.stack(list(RIGHT.values()))
MASKED = np.ma.masked_less(FIRST, 0.5)
RAGGED = [FIRST[0], FIRST[0, :2]]

WRONG_VALUES: list[tuple[Values, str]] = [
    ({3: FIRST, 4: truth(4)}, "refused.nc"),
    (RIGHT | {9: FIRST}, "scenario 9"),
    (changed(lambda values: values[:5]), "position of scenario 3"),
    (changed(lambda values: values.swapaxes(1, 2)), "position of scenario 3"),
    (changed(with_nan), "frame 5, particle 5"),
    (changed(lambda values: values.astype("f8") * 1e300), "frame 3"),
    (np.zeros((2, *SHAPE)), "positions"),
    (np.zeros(SHAPE), "positions"),
    # no arrays of numbers: nothing is dropped in silence
    (with_first(MASKED), "position of scenario 3"),
    (with_first(FIRST.astype(complex)), "position of scenario 3"),
    (with_first(RAGGED), "position of scenario 3"),
    (with_first(torch.ones(SHAPE, requires_grad=True)), "of scenario 3"),
    # in one array of all scenarios
    (ALL.astype(complex), "positions"),
]

WRONG_LABELS: list[tuple[Labels, str]] = [
    ({"sed": 3}, "sed"),
    ({"seed": "three"}, "'seed'"),
    ({"seconds_per_frame": -1}, "'seconds_per_frame'"),
    ({"device": "a\0b"}, "'device'"),
    ({"method": "a\x07"}, "'method'"),
    ({"dataset_sha256": "zz"}, "dataset_sha256"),
]

WRONG_COMPANIONS: list[tuple[Labels, str]] = [
    # rows instead of ids
    ({"diverged_at": {0: 10}}, "diverged_at"),
    # a mark before motion that goes on, beyond the horizon, or in the given frames
    ({"diverged_at": {4: 7}}, "diverged_at of scenario 4"),
    ({"diverged_at": {4: 100_000}}, "diverged_at of scenario 4"),
    ({"diverged_at": {4: GIVEN - 1}}, "diverged_at of scenario 4"),
    ({"diverged_at": {4: 7.0}}, "diverged_at of scenario 4"),
]


@pytest.mark.parametrize(
    ("values", "labels", "place"),
    [
        *[(values, {}, place) for values, place in WRONG_VALUES],
        # before values are looked at, here none
        *[({}, labels, place) for labels, place in WRONG_LABELS],
        *[(RIGHT, companions, place) for companions, place in WRONG_COMPANIONS],
    ],
)
def test_what_does_not_fit_is_refused(
    bench: Bench, values: Values, labels: Labels, place: str
) -> None:
    """The error says where; no file is left."""
    before = sorted(bench.folder.iterdir())
    with pytest.raises(UsageError) as caught:
        write(bench.folder / "refused.nc", values, **options(bench, **labels))
    assert place in str(caught.value.where)
    assert sorted(bench.folder.iterdir()) == before


def test_frozen_rollouts_are_recorded_by_id(bench: Bench) -> None:
    values = RIGHT | {5: frozen(truth(5), 7)}
    more = options(bench, diverged_at={5: 7})
    path = write(bench.folder / "v.nc", values, **more)
    with open_predictions(path) as predictions:
        assert predictions.header.diverged_at == {5: 7}
    assert not bench.validate(path).findings
    with pytest.raises(WorkFailedError) as caught:
        write(bench.valid / "p.nc", RIGHT, **options(bench))
    assert caught.value.where.endswith("valid.nc/p.nc")


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


def test_an_error_of_the_caller_goes_on_as_it_is(bench: Bench) -> None:
    """A pipe that broke is no disk that is full."""
    path = bench.folder / "broken.nc"
    with (
        pytest.raises(BrokenPipeError),
        PredictionsWriter(path, **options(bench)),
    ):
        raise BrokenPipeError
    assert not path.exists()


ALL = list(range(GIVEN, FRAMES))


def test_frames_are_found_by_id_and_absolute_number(bench: Bench) -> None:
    """Scenario 4, three frames from frame 5 on; names, ids, frames, optional attributes
    in the header. No such scenario, before the first, beyond the last, fewer than none:
    each is an error.
    """
    with open_predictions(bench.valid) as predictions:
        three_frames = predictions.frames(4, 5, 3)
        header = predictions.header
        for place in (
            (9, 3, 1),
            (3, 2, 1),
            (3, 3, 9),
            (3, 11, 1),
            (3, 3, -1),
        ):
            with pytest.raises(UsageError) as caught:
                predictions.frames(*place)
            assert caught.value.where.endswith("valid.nc")
    assert three_frames.dtype == np.float32
    from_frame_5 = truth(4)[5 - GIVEN :]
    assert_array_equal(three_frames, from_frame_5[:3])
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
    passed = bench.validate(path).passed
    assert passed == bench.validate(bench.valid).passed
    with open_predictions(path) as shuffled, open_predictions(bench.valid) as plain:
        assert shuffled.header.scenarios == (5, 3, 4)
        for scenario in TESTS:
            frames = shuffled.frames(scenario, GIVEN, HORIZON)
            expected = plain.frames(scenario, GIVEN, HORIZON)
            assert_array_equal(frames, expected)
        assert shuffled.content_sha256() == plain.content_sha256()


PACKINGS: dict[str, dict[str, Any]] = {
    "contiguous": {},
    "big_endian": {"dtype": ">f4"},
    "chunks_over_scenarios": {
        "chunks": (2, 3, 7, 1),
        "compression": 1,
        "shuffle": True,
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
        frames = packed.frames(3, GIVEN, HORIZON)
        assert frames.dtype.isnative
        assert_array_equal(frames, truth(3))
        assert packed.content_sha256() == plain.content_sha256()


def test_the_content_hash_is_that_of_the_document(bench: Bench) -> None:
    """Computed by hashlib and json alone, as docs/predictions.md says."""

    def canonical_json(value: object) -> bytes:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"))
        return text.encode()

    values = np.stack(list(RIGHT.values())).astype("<f4")
    header = {
        "dims": list(DIMS),
        "dtype": "float32",
        "name": "position",
        "shape": list(values.shape),
    }
    variable = canonical_json(header) + b"\n" + values.tobytes()
    variable_sha256 = hashlib.sha256(variable).hexdigest()
    with open_predictions(bench.valid) as predictions:
        actual = predictions.content_sha256()
        dataset_sha256 = predictions.header.dataset_sha256
    identity = {
        "dataset_sha256": dataset_sha256,
        "dataset_version": "2.2.0",
        "method": "truth",
        "split": "cavity",
        "size": "tiny",
        "scenarios": list(TESTS),
        "frames": ALL,
        "variables": {"position": variable_sha256},
    }
    whole = canonical_json(identity)
    assert actual == hashlib.sha256(whole).hexdigest()


def test_blocks_cover_a_scenario_in_order_and_in_bounded_memory(tmp_path: Path) -> None:
    """A scenario of 96 MB in pieces of 1 MiB, read in less than 20 MB."""
    path = tmp_path / "large.nc"
    frame_count = 120
    particle_count = 100_000
    frame_numbers = np.arange(frame_count, dtype="f4")
    values = np.broadcast_to(
        frame_numbers[:, None, None],
        (1, frame_count, particle_count, 2),
    )
    attributes = {
        "lagbench_format": 1,
        "split": "a",
        "size": "b",
        "method": "c",
        "dataset_version": "1.0.0",
        "dataset_sha256": "d",
    }
    coordinates = {
        "scenario": [1],
        "frame": np.arange(2, 2 + frame_count),
    }
    data = xr.Dataset({"position": (DIMS, values)}, coordinates, attributes)
    chunks = (1, 1, particle_count, 2)
    data.to_netcdf(path, encoding={"position": {"chunksizes": chunks}})
    tracemalloc.start()
    frames_read = 0
    with open_predictions(path) as predictions:
        for first, block in predictions.blocks(1):
            block_end = frames_read + len(block)
            expected = frame_numbers[frames_read:block_end]
            assert_array_equal(block[:, 0, 0], expected)
            assert first == 2 + frames_read
            frames_read = block_end
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert frames_read == frame_count
    assert peak < 20e6


LAYOUTS = (
    "external_link",
    "virtual_dataset",
    "positions_f8",
    "space_before_particle",
)


@pytest.mark.parametrize("name", ["truncated_half", "netcdf3", *LAYOUTS])
def test_opening_what_is_unreadable_raises(bench: Bench, name: str) -> None:
    """Exit code 3; of another layout exit code 1, naming the check."""
    kind: type[Exception] = UnreadableFileError
    words = None
    if name in LAYOUTS:
        kind = ChecksFailedError
        words = FAULTS[name].check
    with pytest.raises(kind, match=words):
        open_predictions(FAULTS[name].make(bench))
