"""Flags: hand-made traces, and predictions made with and without the answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from metric_flows import Floats, pairs_of, rollout, scenario_of
from numpy.testing import assert_allclose
from score_bench import Predict, ScoreBench, half_right, late, right, still, straight

from lagbench.data.box import Box
from lagbench.data.grid import Grid
from lagbench.metrics import FramePair, snapshots
from lagbench.scoring.flags import (
    SHIFTS,
    Trace,
    Tracer,
    analyse_error,
    judge_copying,
    judge_physics,
    judge_predictability,
)

HORIZON = 6


def trace_of(truth: Floats, prediction: Floats, **changes: Any) -> Trace:
    """Return the trace of trajectories of the swirl; six frames are predicted."""
    scenario = scenario_of(truth, **changes)
    tracer = Tracer(scenario)
    for pair in pairs_of(scenario, truth, prediction):
        tracer.add(pair)
    return tracer.trace


def make_trace(
    error: Sequence[float],
    *,
    cosine: float = 1.0,
    motion: float = 1.0,
) -> Trace:
    """Return a trace with these RMS errors and one cosine between neighbours.

    No shift fits better.
    """
    rms = np.array(error)
    rms = np.array(error)
    ones = np.ones(len(rms))
    products = cosine * rms[1:] * rms[:-1]
    square_motion = motion**2 * ones
    return Trace(
        error=rms**2,
        overlap=np.concatenate([[np.nan], products]),
        motion=square_motion,
        predicted_motion=square_motion,
        shifted=dict.fromkeys(SHIFTS, 4.0 * rms**2),
        occupancy=ones,
        outside=np.zeros_like(ones),
    )


def test_trace_of_an_offset_that_grows() -> None:
    """Predicted = true + f (1, 0) / 100: error f^2 / 2, overlap f (f - 1) / 2.

    In units of 1e-4.
    """
    truth = rollout()
    frames = np.array([0, 0, 1, 2, 3, 4, 5, 6])[:, None, None]
    offset = np.array([0.01, 0.0])
    trace = trace_of(truth, truth + frames * offset)
    errors = [0.5, 2.0, 4.5, 8.0, 12.5, 18.0]
    overlaps = [1.0, 3.0, 6.0, 10.0, 15.0]
    first_overlap, *other_overlaps = 1e4 * trace.overlap
    assert_allclose(1e4 * trace.error, errors, rtol=1e-9)
    assert_allclose(other_overlaps, overlaps, rtol=1e-9)
    assert math.isnan(first_overlap)

    # cosine 1 throughout; the smallest ratio is 6/5; the last quarter is the last
    # frame: 6/1
    dynamics = analyse_error(trace)
    assert dynamics.autocorrelation == pytest.approx(1.0)
    assert dynamics.drop == pytest.approx(1.2)
    assert dynamics.growth == pytest.approx(6.0)


@pytest.mark.parametrize("shift", SHIFTS)
def test_a_shift_is_found_across_periodic_ends(shift: int) -> None:
    """A stream carries particles across the end of the box in each frame."""
    torus = Box.from_bounds(((0.0, 1.0), (0.0, 1.0)), periodic=[True, True])
    stream = 0.2 * np.arange(12)[:, None, None] * np.array([1.0, 0.0])
    truth = (rollout(frames=12) + stream) % 1.0
    offset = 0.02  # so that some particles lie on the other side of the end
    moved = (np.roll(truth, -shift, axis=0) + offset) % 1.0
    trace = trace_of(truth[:8], moved[:8], grid=Grid(10, box=torus))
    dynamics = analyse_error(trace)
    assert dynamics.shift == shift
    assert dynamics.shift_gain < 0.2


def test_particles_out_of_the_box_are_counted() -> None:
    """A quarter of the particles is far outside in every predicted frame."""
    truth = rollout()
    prediction = truth.copy()
    prediction[2:, ::4] = 2.0
    trace = trace_of(truth, prediction)
    assert_allclose(trace.outside, 0.25)


def test_a_cloud_in_half_the_box_occupies_half() -> None:
    """Of ten columns of nodes it fills five, and the sixth by the spline's tail."""
    truth = rollout()
    squeezed = truth.copy()
    squeezed[:, :, 0] /= 2.0
    trace = trace_of(truth, squeezed)
    error = np.abs(trace.occupancy - 0.5)
    assert np.all(error <= 0.1)
    whole = trace_of(truth, truth)
    assert_allclose(whole.occupancy, 1.0)


GROWING = make_trace([1, 2, 3, 4, 5, 6])


@pytest.mark.parametrize(
    "trace",
    [
        GROWING,
        # It does not grow, but is larger than a frame's motion.
        make_trace([3, 3, 3, 3, 3, 3]),
        # Among rounding errors a drop means nothing.
        make_trace([1e-9, 9e-9, 1e-9, 9e-9, 1e-7, 1e-6]),
    ],
)
def test_honest_errors_are_no_copies(trace: Trace) -> None:
    assert not judge_copying([GROWING, trace]).raised


@pytest.mark.parametrize(
    ("trace", "reason"),
    [
        (make_trace([0.3, 0.3, 0.3, 0.3, 0.3, 0.3]), "accumulate"),
        (make_trace([1, 2, 3, 4, 5, 6], cosine=0.3), "does not follow"),
        (make_trace([1, 2, 3, 1, 2, 3]), "drops"),
        (make_trace([0, 0, 0, 0, 0, 0]), "bit for bit"),
    ],
)
def test_copies_raise_the_flag_for_their_own_reason(trace: Trace, reason: str) -> None:
    """One scenario is enough."""
    flag = judge_copying([GROWING, trace])
    assert flag.raised
    assert len(flag.reasons) == 1
    assert reason in flag.reasons[0]


PERTURBED_ERROR = [1e-6, 1e-5, 1e-4, 0.5]
PERSISTENCE_ERROR = np.array([0.01, 0.1, 0.5, 1.0])


def test_errors_below_the_perturbed_run_raise_the_flag() -> None:
    """Frames 0 and 3 are below it, and only the first of these counts.

    At frame 3 the perturbed run is past a tenth of persistence.
    """
    error = np.array([5e-7, 1e-3, 1e-2, 0.4])
    flag = judge_predictability(error, PERSISTENCE_ERROR, PERTURBED_ERROR)
    assert flag.raised
    assert flag.evidence == {"frames_below": 1.0, "frames_compared": 3.0}


@pytest.mark.parametrize(
    ("error", "limit", "is_raised"),
    [
        (np.array([5e-5, 1e-3, 1e-2, 0.4]), PERTURBED_ERROR, False),
        (PERSISTENCE_ERROR, (), None),
        (PERSISTENCE_ERROR, PERTURBED_ERROR[:3], None),  # of other frames
        (PERSISTENCE_ERROR, PERSISTENCE_ERROR, None),  # it has lost the truth
    ],
)
def test_other_errors_do_not_raise_it(
    error: Floats, limit: Sequence[float], is_raised: bool | None
) -> None:
    assert judge_predictability(error, PERSISTENCE_ERROR, limit).raised is is_raised


@pytest.mark.parametrize(
    ("energy", "is_raised"),
    [
        (0.0, True),
        (0.5, False),
        (2.0, False),
        (20.0, True),
    ],
)
def test_a_wrong_energy_raises_the_flag(energy: float, is_raised: bool) -> None:
    """The energy is relative to the truth."""
    trace = make_trace([1, 2, 3])
    trace = replace(trace, predicted_motion=energy * trace.motion)
    assert judge_physics([trace]).raised == is_raised


def test_a_wrong_area_raises_the_flag() -> None:
    trace = make_trace([1, 2, 3])
    wide = replace(trace, occupancy=2.0 * trace.occupancy)
    flag = judge_physics([wide])
    assert "area" in flag.reasons[0]
    in_space = judge_physics([wide], dimension=3)
    assert in_space.raised
    assert "volume" in in_space.reasons[0]
    assert "area" not in in_space.reasons[0]


def one_step(truth: Floats, n: int, h: int) -> Floats:
    """Extrapolate each frame from the two true frames before it."""
    last = truth[n - 1 : n + h - 1].astype(float)
    before = truth[n - 2 : n + h - 2]
    return np.asarray(2.0 * last - before)


def noisy(truth: Floats, n: int, h: int) -> Floats:
    """Add noise of a twentieth of a frame's motion to the truth."""
    rng = np.random.Generator(np.random.PCG64(1))
    steps = np.diff(truth, axis=0)
    motion = np.sqrt(np.mean(steps**2))
    future = truth[n : n + h]
    noise = rng.standard_normal(future.shape)
    return np.asarray(future + 0.05 * motion * noise)


def restarted(truth: Floats, n: int, h: int) -> Floats:
    """Extrapolate at constant velocity, restarting from the truth every five frames."""
    parts = [straight(truth, frame, 5) for frame in range(n, n + h, 5)]
    return np.concatenate(parts)[:h]


def trace_scenarios(bench: ScoreBench, predict: Predict) -> list[Trace]:
    """Return the traces of a prediction in the test scenarios."""
    first = bench.size.task.input_frames
    horizon = bench.size.task.horizon
    traces = []
    for number in bench.size.subsets["test"]:
        with bench.task.opened(number) as opened:
            scenario = opened.scenario
            tracer = Tracer(scenario)
            truth = opened.file.read("position")
            prediction = predict(truth, first, horizon)
            frames = zip(
                range(first, first + horizon),
                opened.snapshots(),
                snapshots(scenario, prediction),
                strict=True,
            )
            for frame, true, predicted in frames:
                pair = FramePair(scenario, frame, true, predicted)
                tracer.add(pair)
            traces.append(tracer.trace)
    return traces


@pytest.mark.parametrize(
    ("predict", "is_copy"),
    [
        (still, False),
        (straight, False),
        (right, True),
        (late, True),
        (noisy, True),
        (one_step, True),
        (restarted, True),
        (half_right, True),
    ],
)
def test_copies_of_generated_data_raise_the_flag(
    bench: ScoreBench, predict: Predict, is_copy: bool
) -> None:
    """Predictions that do not use the answer do not raise it."""
    traces = trace_scenarios(bench, predict)
    assert judge_copying(traces).raised == is_copy
