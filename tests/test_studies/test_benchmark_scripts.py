"""The scripts of benchmarks/ end with a message where something is wrong."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from score_bench import ScoreBench, still

from benchmarks import (
    by_materials,
    free_flight,
    inference_cost,
    naive_attempts,
    table_3_1,
)
from benchmarks.naive_attempts import (
    AnalogCase,
    Kinds,
    Library,
    Predictors,
    State,
    States,
    describe,
    measured_frames,
)
from lagbench.data.registry import load
from lagbench.errors import UsageError
from lagbench.generators.split import Device
from lagbench.references.predictor import Floats, Given

REPOSITORY = Path(__file__).parents[2]


def run_script(words: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a script of benchmarks/ as its page says."""
    name, *options = words.split()
    command = [sys.executable, f"benchmarks/{name}.py", *options, *map(str, arguments)]
    return subprocess.run(
        command,
        cwd=REPOSITORY,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    "words",
    [
        "flag_calibration --size tiny --splits cavity",
        "operator_recipes --size tiny --split cavity",
        "naive_attempts --split fluid",
        "free_flight",
    ],
)
def test_missing_data_are_named_with_their_remedy(words: str, tmp_path: Path) -> None:
    """As by every command of the package."""
    done = run_script(words, "--root", tmp_path)
    assert done.returncode in {3, 4}
    assert "Traceback" not in done.stderr
    assert "lagbench generate" in done.stderr


@pytest.mark.parametrize(
    ("words", "right"),
    [
        ("flag_calibration --splits decaying-vortices", "cavity"),
        ("flag_calibration --splits fluid-3d", "fluid"),
        ("naive_attempts --split fluid --attempt shiped", "shipped"),
        ("operator_recipes --operator gsn --root . --split cavity", "gns"),
        ("scaling_plan --rows 12", "9"),
        ("scaling_plan --rows x", "9"),
        ("table_3_1 --rows x", "9"),
        ("references --data cavity", "cavity/full"),
        ("solver_against --against no-commit", "no-commit"),
        ("solver_against --against HEAD --rounds 0", "rounds"),
    ],
)
def test_what_no_script_can_do_is_refused(words: str, right: str) -> None:
    """Before any data are read."""
    done = run_script(words)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert right in done.stderr


def test_the_plan_is_made_from_the_largest_row_in_any_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is the last one; a row that is named twice is measured once."""
    monkeypatch.syspath_prepend(REPOSITORY / "benchmarks")
    script = importlib.import_module("scaling_plan")
    rows = script.read_rows("4,2,4")
    assert [row.q for row in rows] == [2, 4]


@pytest.mark.parametrize("script", [table_3_1, inference_cost])
def test_rows_are_those_that_a_text_names(script: ModuleType) -> None:
    """Others are refused before the files of earlier measurements are replaced."""
    assert len(script.read_rows("2")) == 1
    assert len(script.read_rows("1-4")) == 4
    for text in ("0", "4-1", "1-", "-1", "", "1,1", "one"):
        with pytest.raises(UsageError) as caught:
            script.read_rows(text)
        assert caught.value.where == "--rows"
    for text in ("20", "9-20"):
        with pytest.raises(UsageError):
            table_3_1.read_rows(text)


def test_one_row_has_no_slope(tmp_path: Path) -> None:
    """No line is drawn, and NumPy does not warn of a fit."""
    row = table_3_1.THESIS[1]
    timed = table_3_1.TimedRow(row=row, substep_ms=1.0, frame_ms=20.0)
    path = tmp_path / "one.png"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table_3_1.draw([timed], "cpu", path)
    assert path.stat().st_size > 0


def test_bodies_that_do_not_fly_have_no_error() -> None:
    """A 0 would say that they move exactly with gravity."""
    assert float(free_flight.describe_mean(3.0, 2)) == 1.5
    text = free_flight.describe_mean(0.0, 0)
    assert not any(character.isdigit() for character in text)


def test_predictions_of_another_data_set_are_refused(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """None of the printed lines would be theirs."""
    predictions = bench.submit(tmp_path / "still.nc", still)
    words = "flag_calibration --splits cavity --size tiny --trained"
    done = run_script(words, predictions, "--root", bench.root)
    assert done.returncode == 2, done.stderr
    assert str(predictions) in done.stderr


def test_a_scenario_at_rest_is_compared_at_a_predicted_frame() -> None:
    """A frame that is given has no error."""
    size = load().size("fluid", "mini")
    first_predicted = size.task.input_frames
    assert measured_frames(size, 30, 0) == (first_predicted,)


START = np.array([[0.5, 0.8], [0.52, 0.8]])  # last given positions [length]
VELOCITY = np.array([0.002, 0.001])  # of both particles [length/frame]


def falling_case(**changes: Any) -> AnalogCase:
    """Return two particles that fly and meet nothing before the last frame."""
    size = load().size("fluid", "mini")
    end = size.task.input_frames + size.task.horizon
    given = Given(
        size=size,
        root=Path(),
        position=np.array([START - VELOCITY, START]),
        material=np.zeros(2, np.int8),
        walls=np.zeros((end, 4, 2)),
        area=0.01,
        parameters={},
    )
    last_given = size.task.input_frames - 1
    frames = (last_given + 1, last_given + 2, last_given + 12)
    keys = {"given": given, "frames": frames, "without": None, "thinning": 1}
    return AnalogCase(**(keys | changes))


def assert_falling(case: AnalogCase, clouds: Mapping[int, Floats]) -> None:
    """Assert the parabola of falling points in time steps, in a closed form."""
    last_given = case.given.size.task.input_frames - 1
    for frame in case.frames:
        k = frame - last_given
        expected = START + k * VELOCITY + case.given.fall * (k * (k + 1) / 2)
        assert_allclose(clouds[frame], expected, rtol=0.0, atol=1e-12)


def test_damped_flight_without_contact_is_free_flight() -> None:
    case = falling_case()
    no_library: Any = None
    predictors = Predictors(no_library)
    clouds = predictors.damped(case, {"bounce": 0.6, "friction": 0.0})
    assert_falling(case, clouds)


class OneScenario(Library):
    """A library of one scenario of train, with one state."""

    def states(
        self, kinds: Kinds, velocity_weight: float, *, is_exact: bool
    ) -> States | None:
        """Return that state."""
        position = START
        velocity = np.broadcast_to(VELOCITY, START.shape)
        material = np.zeros(len(START), np.int8)
        feature = describe(position, velocity, material, kinds, velocity_weight)
        return States((State(0, 0, 1),), feature[None])


@pytest.mark.parametrize("name", ["windows", "from_the_start", "with_climatology"])
def test_the_only_scenario_of_train_is_predicted_by_free_flight(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may not be looked at, and there is no other one."""
    monkeypatch.setattr(naive_attempts, "long_enough", lambda _: [0])
    case = falling_case(without=0)
    predictors = Predictors(OneScenario(case.given.size, Path()))
    # analogs would take over at the first frame
    choice = {
        "window": 5,
        "lag": -case.flight,
        "velocity_weight": 20.0,
        "analogs": 2,
        "most": 0.5,
        "time": 50,
    }
    predict = getattr(predictors, name)
    assert_falling(case, predict(case, choice))


def test_scenarios_without_a_value_do_not_count_in_means_by_materials() -> None:
    """As in the scores of the leaderboard; a mean of none is NaN."""
    kinds = np.array(["liquid", "snow", "liquid", "jelly"])
    values = np.array([1.0, 3.0, np.nan, np.nan])
    jelly, liquid, snow, of_all = by_materials.means_by_kind(values, kinds)
    assert np.isnan(jelly)
    assert (liquid, snow, of_all) == (1.0, 3.0, 2.0)


@pytest.mark.parametrize("device", list(Device))
def test_the_text_of_table_3_1_names_the_clock_of_its_device(device: Device) -> None:
    """The serial CPU device is timed by processor time, the others on the wall."""
    text = "\n".join(table_3_1.describe(device, machine="", repeats=3))
    assert ("processor time" in text) == (device == Device.CPU)
    assert ("wall-clock time" in text) == (device != Device.CPU)
    assert ("On a GPU" in text) == (device == Device.CUDA)
