"""Writing predictions: round trip, template, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenario_factory import frames_of
from submission_data import FRAMES, GIVEN, HORIZON, PARTICLES, TESTS, Bench, make_bench, truth

from lagbench.data.registry import Registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.submission import PredictionsWriter, open_predictions, template, write

SHAPE = (HORIZON, PARTICLES, 2)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A small data set and a valid submission."""
    return make_bench(tmp_path_factory.mktemp("bench"))


def options(bench: Bench, **more: Any) -> dict[str, Any]:
    """What every call needs."""
    return {"split": "cavity", "size": "tiny", "method": "m", "registry": bench.registry, **more}


FINITE = st.floats(-(2.0**99), 2.0**99, width=32)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=hnp.arrays(np.float32, (len(TESTS), *SHAPE), elements=FINITE, fill=FINITE))
def test_what_is_written_is_read(bench: Bench, values: np.ndarray) -> None:
    """Every finite float32 comes back bit by bit, from an array and from a mapping."""
    for form in (values, dict(zip(TESTS, values, strict=True))):
        path = write(bench.folder / "round.nc", form, **options(bench))
        with open_predictions(path) as predictions:
            for row, scenario in enumerate(TESTS):
                got = predictions.frames(scenario, GIVEN, HORIZON)
                np.testing.assert_array_equal(got.view("u4"), values[row].view("u4"))


def test_the_template_is_the_last_given_frame_repeated(bench: Bench) -> None:
    """Valid as it is; one frame per chunk."""
    result = template(
        "cavity", "tiny", output=bench.folder / "t.nc", root=bench.root, registry=bench.registry
    )
    assert (result.scenarios, result.frames, result.particles) == (TESTS, (GIVEN, FRAMES - 1), PARTICLES)
    assert bench.validate(result.path).exit_code == 0
    with open_predictions(result.path) as predictions:
        assert predictions.header.method == "persistence"
        for scenario in TESTS:
            last = frames_of(scenario, FRAMES, PARTICLES)[GIVEN - 1]
            np.testing.assert_array_equal(
                predictions.frames(scenario, GIVEN, HORIZON), np.broadcast_to(last, SHAPE)
            )
    with h5py.File(result.path) as file:
        assert file["position"].chunks == (1, 1, PARTICLES, 2)


def test_the_same_predictions_give_the_same_bytes(bench: Bench) -> None:
    """No time, host or path enters the file."""
    paths = [bench.folder / "once.nc", bench.folder / "twice.nc"]
    for path in paths:
        template("cavity", "tiny", output=path, root=bench.root, registry=bench.registry)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_template_needs_the_test_scenarios(bench: Bench, tmp_path: Path) -> None:
    """The message has the command that makes them; nothing is written."""
    output = tmp_path / "t.nc"
    with pytest.raises(DataError, match="lagbench generate --split cavity --size tiny --subset test"):
        template("cavity", "tiny", output=output, root=tmp_path, registry=bench.registry)
    assert not output.exists()


def test_without_a_recorded_hash_one_must_be_given(unmeasured: Registry, tmp_path: Path) -> None:
    """A split that nobody measured has no hash; a given one is stored."""
    zeros = np.full((2, 20, 324, 2), 0.5)
    path = tmp_path / "p.nc"
    more: dict[str, Any] = {"split": "cavity", "size": "tiny", "method": "m", "registry": unmeasured}
    with pytest.raises(DataError, match="hash of the data set is not known"):
        write(path, zeros, root=tmp_path, **more)
    write(path, zeros, root=tmp_path, dataset_sha256="ab" * 32, **more)
    with open_predictions(path) as predictions:
        assert predictions.header.dataset_sha256 == "ab" * 32


def test_velocities_are_stored_beside_positions(bench: Bench) -> None:
    """They are not read by the scorer but are there for others."""
    values = {i: truth(i) for i in TESTS}
    path = write(bench.folder / "v.nc", values, velocities={i: -truth(i) for i in TESTS}, **options(bench))
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["velocity"][...], -file["position"][...])
    assert not bench.validate(path).findings


def _nan(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[2, 5, 1] = np.nan
    return values


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({3: truth(3), 4: truth(4)}, "missing: 5"),
        ({**{i: truth(i) for i in TESTS}, 9: truth(3)}, "no test scenario"),
        ({i: truth(i)[:5] for i in TESTS}, "shape"),
        ({i: truth(i).swapaxes(1, 2) for i in TESTS}, "shape"),
        ({i: _nan(truth(i)) for i in TESTS}, "frame 5, particle 5"),
        ({i: truth(i).astype("f8") * 1e300 for i in TESTS}, "not finite as float32"),
        (np.zeros((2, *SHAPE)), "one entry per test scenario"),
        (np.zeros(SHAPE), "one entry per test scenario"),
    ],
)
def test_wrong_arrays_are_refused_and_leave_no_file(bench: Bench, values: Any, message: str) -> None:
    """Missing, unknown, misshapen, not finite; the folder stays as it was."""
    before = sorted(bench.folder.iterdir())
    with pytest.raises(UsageError, match=message):
        write(bench.folder / "refused.nc", values, **options(bench))
    assert sorted(bench.folder.iterdir()) == before


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"sed": 3}, "did you mean 'seed'"),
        ({"seed": "three"}, "an integer"),
        ({"seed": True}, "an integer"),
        ({"parameters": -5}, "an integer >= 0"),
        ({"seconds_per_frame": -1}, "positive"),
        ({"seconds_per_frame": float("inf")}, "positive"),
    ],
)
def test_wrong_labels_are_refused(bench: Bench, labels: dict[str, Any], message: str) -> None:
    """Unknown names suggest the nearest; types are checked."""
    with pytest.raises(UsageError, match=message):
        write(bench.folder / "p.nc", {}, **options(bench, **labels))


@pytest.mark.parametrize(
    ("mark", "message"),
    [(7, "frame 8 differs"), (100_000, "no such frame"), (GIVEN - 1, "no such frame"), (-5, "no such frame")],
)
def test_a_rollout_must_be_frozen_where_it_says(bench: Bench, mark: int, message: str) -> None:
    """A mark beyond the horizon, in the given frames, or before motion that goes on."""
    values = {i: truth(i) for i in TESTS}
    with pytest.raises(UsageError, match=message):
        write(bench.folder / "moving.nc", values, diverged_at={4: mark}, **options(bench))


def test_labels_may_come_while_writing(bench: Bench) -> None:
    """The cost of a frame is known only after the rollout."""
    path = bench.folder / "late.nc"
    with PredictionsWriter(path, **options(bench)) as writer:
        for scenario in reversed(TESTS):
            writer.add(scenario, truth(scenario))
        with pytest.raises(UsageError, match="written twice"):
            writer.add(3, truth(3))
        writer.label(seconds_per_frame=0.5, device="one core")
    with open_predictions(path) as predictions:
        assert (predictions.header.seconds_per_frame, predictions.header.device) == (0.5, "one core")


def test_a_folder_that_cannot_be_written_is_named(bench: Bench) -> None:
    """A parent that is a file."""
    with pytest.raises(WorkFailedError, match="cannot write"):
        write(bench.valid / "p.nc", {i: truth(i) for i in TESTS}, **options(bench))
