"""Flags: hand-made traces, and predictions made with and without the answer."""

from __future__ import annotations

import math
import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from metric_flows import Floats, pairs_of, rollout, scenario_of
from score_bench import Predict, ScoreBench, half_right, late, right, still, straight

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


def trace_of(truth: Floats, prediction: Floats) -> Trace:
    """Return the trace of whole trajectories of the swirl, two frames given, six
    predicted.
    """
    scenario = scenario_of(truth)
    tracer = Tracer(scenario)
    for pair in pairs_of(scenario, truth, prediction):
        tracer.add(pair)
    return tracer.result()


def made(error: Sequence[float], *, cosine: float = 1.0, motion: float = 1.0) -> Trace:
    """Return a trace with these RMS errors and one cosine between neighbours.

    No shift fits better.
    """
    e = np.array(error)
    ones = np.ones(len(e))
    products = cosine * e[1:] * e[:-1]
    return Trace(
        error=e**2,
        overlap=np.concatenate([[np.nan], products]),
        motion=motion**2 * ones,
        predicted_motion=motion**2 * ones,
        shifted=dict.fromkeys(SHIFTS, 4.0 * e**2),
        occupancy=ones,
        outside=0.0 * ones,
    )


def test_trace_of_an_offset_that_grows() -> None:
    """Predicted = true + f (1, 0) / 100: error f^2 / 2, overlap f (f - 1) / 2.

    In units of 1e-4.
    """
    truth = rollout()
    frames = np.array([0, 0, 1, 2, 3, 4, 5, 6])[:, None, None]
    trace = trace_of(truth, truth + frames * np.array([0.01, 0.0]))
    errors = [0.5, 2.0, 4.5, 8.0, 12.5, 18.0]
    overlaps = [1.0, 3.0, 6.0, 10.0, 15.0]
    np.testing.assert_allclose(trace.error * 1e4, errors, rtol=1e-9)
    np.testing.assert_allclose(trace.overlap[1:] * 1e4, overlaps, rtol=1e-9)
    assert math.isnan(trace.overlap[0])

    # cosine 1 throughout; the smallest ratio is 6/5; the last quarter is the last
    # frame: 6/1
    dynamics = analyse_error(trace)
    assert dynamics.autocorrelation == pytest.approx(1.0)
    assert dynamics.drop == pytest.approx(1.2)
    assert dynamics.growth == pytest.approx(6.0)


@pytest.mark.parametrize("shift", SHIFTS)
def test_trace_finds_the_shift(shift: int) -> None:
    """Predicting the truth s frames away leaves no error at shift s.

    Ends without a partner are NaN.
    """
    truth = rollout(frames=12)
    moved = np.roll(truth, -shift, axis=0)
    trace = trace_of(truth[:8], moved[:8])
    shifted = trace.shifted[shift]
    defined = shifted[~np.isnan(shifted)]
    assert len(defined) == HORIZON - max(0, shift)
    np.testing.assert_allclose(defined, 0.0, atol=1e-30)

    dynamics = analyse_error(trace)
    assert dynamics.shift == shift
    assert dynamics.shift_gain == 0.0


def test_trace_occupancy_and_outside() -> None:
    """A quarter of the particles thrown out of the box are counted; a cloud in half the
    box fills half.
    """
    truth = rollout()
    thrown = truth.copy()
    thrown[2:, ::4] = 2.0
    np.testing.assert_allclose(trace_of(truth, thrown).outside, 0.25)
    squeezed = truth.copy()
    squeezed[:, :, 0] /= 2.0
    # ten columns of nodes: five are filled, and the sixth keeps enough of the spline's
    # tail or not
    assert np.all(np.abs(trace_of(truth, squeezed).occupancy - 0.5) <= 0.1)
    np.testing.assert_allclose(trace_of(truth, truth).occupancy, 1.0)


@pytest.mark.parametrize(
    ("trace", "reason"),
    [
        (made([1, 2, 3, 4, 5, 6]), None),
        (
            made([3, 3, 3, 3, 3, 3]),
            None,
        ),  # it does not grow, but is larger than a frame's motion
        (made([0.3, 0.3, 0.3, 0.3, 0.3, 0.3]), "accumulate"),
        (made([1, 2, 3, 4, 5, 6], cosine=0.3), "does not follow"),
        (made([1, 2, 3, 1, 2, 3]), "drops"),
        (made([0, 0, 0, 0, 0, 0]), "are the truth"),
        (
            made([1e-9, 9e-9, 1e-9, 9e-9, 1e-7, 1e-6]),
            None,
        ),  # falls among rounding errors are none
    ],
)
def test_copy_suspect_by_hand(trace: Trace, reason: str | None) -> None:
    """Each kind of trace raises for its own reason, and honest growth for none; one
    scenario is enough.
    """
    flag = judge_copying([made([1, 2, 3, 4, 5, 6]), trace])
    assert flag.raised == (reason is not None)
    if reason is not None:
        assert len(flag.reasons) == 1
        assert reason in flag.reasons[0]


def test_twin_floor_and_physics_by_hand() -> None:
    """Below the perturbed run in frames 0 and 3; only the first of these counts.

    At frame 3 the perturbed run is past a tenth of persistence. A prediction at rest
    and one of twenty times the energy are raised, one of twice is not.
    """
    limit = [1e-6, 1e-5, 1e-4, 0.5]
    persistence = np.array([0.01, 0.1, 0.5, 1.0])
    close = np.array([5e-7, 1e-3, 1e-2, 0.4])
    flag = judge_predictability(close, persistence, limit)
    assert flag.raised
    assert flag.evidence == {"frames_below": 1.0, "frames_compared": 3.0}
    honest = np.array([5e-5, 1e-3, 1e-2, 0.4])
    assert judge_predictability(honest, persistence, limit).raised is False
    assert judge_predictability(persistence, persistence, ()).raised is None

    # as workers send it
    faster = trace_of(rollout(), rollout(speed=0.012))
    trace = pickle.loads(pickle.dumps(faster))
    assert set(trace.shifted) == set(SHIFTS)

    rest = made([1, 2, 3])
    for factor, raised in ((0.0, True), (0.5, False), (2.0, False), (20.0, True)):
        trace = replace(rest, predicted_motion=factor * rest.motion)
        assert judge_physics([trace]).raised == raised
    wide = replace(rest, occupancy=2.0 * rest.occupancy)
    assert "area" in judge_physics([wide]).reasons[0]


def one_step(truth: Floats, n: int, h: int) -> Floats:
    """Extrapolate each frame from the two true frames before it."""
    return np.asarray(
        2.0 * truth[n - 1 : n + h - 1].astype(float) - truth[n - 2 : n + h - 2]
    )


def noisy(truth: Floats, n: int, h: int) -> Floats:
    """Add noise of a twentieth of a frame's motion to the truth."""
    rng = np.random.Generator(np.random.PCG64(1))
    scale = 0.05 * np.sqrt(np.mean(np.diff(truth, axis=0) ** 2))
    return np.asarray(
        truth[n : n + h] + scale * rng.standard_normal(truth[n : n + h].shape)
    )


def restarted(truth: Floats, n: int, h: int) -> Floats:
    """Extrapolate at constant velocity, restarting from the truth every five frames."""
    return np.concatenate([straight(truth, f, 5) for f in range(n, n + h, 5)])[:h]


@pytest.mark.parametrize(
    "predict", [still, straight, right, late, noisy, one_step, restarted, half_right]
)
def test_copies_on_generated_data(bench: ScoreBench, predict: Predict) -> None:
    """On simulated flows both floors pass and what was made from the answer does
    not.
    """
    n = bench.size.task.input_frames
    h = bench.size.task.horizon
    traces = []
    for number in bench.size.subsets["test"]:
        with bench.task.opened(number) as opened:
            tracer = Tracer(opened.scenario)
            scenario = opened.scenario
            truth = opened.file.read("position")
            guess = snapshots(scenario, predict(truth, n, h))
            for frame, true, predicted in zip(
                range(n, n + h), opened.snapshots(), guess, strict=True
            ):
                tracer.add(FramePair(scenario, frame, true, predicted))
            traces.append(tracer.result())
    if predict is half_right:
        assert [analyse_error(trace).exact for trace in traces] == [h // 2, h // 2]
    assert judge_copying(traces).raised == (predict not in (still, straight))
