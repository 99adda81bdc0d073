"""Print what honest and dishonest predictions of our own splits show to the flags.

Honest ones see the given frames only: persistence, constant velocity, decaying
velocity, the last grid velocity field held fixed (as it is, and with a jitter of a
tenth of a frame's motion), another scenario's motion, and two emulations of an accurate
model: the truth plus integrated velocity errors of 2 %, smooth or white. Dishonest ones
are made from the true answer: noise on top, one-step predictions from true frames,
shifts in time, resets every few frames, interpolation between true frames, a moving
average.

    python benchmarks/flag_calibration.py --size mini --root DATA [--splits
        cavity,fluid] [--trained runs/cavity/mini/gns-0/predictions.nc ...]

``--trained`` adds predictions of trained models to the honest ones.

The thresholds in lagbench/scoring/flags.py lie between the extremes that this prints.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Grid, fields
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.metrics import FramePair, Scenario, snapshots
from lagbench.scoring.flags import Trace, Tracer, analyse_error, judge_copying
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.submission import Predictions, open_predictions

Floats = NDArray[np.float64]

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
COLUMNS = ("autocorrelation", "drop", "shift_gain", "growth", "steps")


class CalibrationScenario:
    """One test scenario with its whole truth in memory.

    Args:
        scenario: the scenario as metrics see it.
        positions: true positions from frame 0, shape [frame, particle, 2].
        other_positions: those of another test scenario with as many particles.
    """

    def __init__(
        self, scenario: Scenario, positions: Floats, other_positions: Floats
    ) -> None:
        self.scenario = scenario
        self.other_positions = other_positions
        self.first = scenario.config.input_frames  # first predicted frame
        self.horizon = scenario.config.horizon
        self.end = self.first + self.horizon
        self.positions = positions[: self.end + 2]
        self.truth = positions[self.first : self.end]
        self.rng = np.random.Generator(np.random.PCG64(0))
        displacement = np.diff(positions[: self.end], axis=0)
        self.step = float(np.sqrt(np.mean(displacement**2)))  # [length/frame]

    def noise(self) -> Floats:
        """Return white noise of one frame's motion, shape of the truth."""
        return self.step * self.rng.standard_normal(self.truth.shape)

    def shifted(self, frames: int) -> Floats:
        """Return the truth of so many frames earlier, shape of the truth."""
        return self.positions[self.first - frames : self.end - frames]

    def next_frames(self) -> Floats:
        """Return the truth one frame later; the last frame repeats."""
        return np.concatenate([self.truth[1:], self.truth[-1:]])

    def last_motion(self, first: int) -> tuple[Floats, Floats]:
        """Return position and displacement in the frame before an absolute frame."""
        position = self.positions[first - 1]
        return position, position - self.positions[first - 2]

    def extrapolate(self, first: int, count: int, decay: float = 1.0) -> Floats:
        """Return ``count`` frames at the velocity before absolute frame ``first``."""
        position, displacement = self.last_motion(first)
        frames = []
        for _ in range(count):
            displacement = decay * displacement
            position = position + displacement
            frames.append(position)
        return np.stack(frames)

    def follow_field(self, first: int, count: int) -> Floats:
        """Return ``count`` frames of particles carried by a velocity field that stays.

        It is the field on the grid of the last motion before absolute frame ``first``.
        """
        position, displacement = self.last_motion(first)
        grid = self.scenario.config.grid
        full = self.scenario.full_weight
        velocity = fields(position, displacement, grid, full=full).velocity
        frames = []
        for _ in range(count):
            position = position + sample(velocity, position, grid)
            frames.append(position)
        return np.stack(frames)

    def restart(self, every: int) -> Floats:
        """Return constant velocity, started again from the truth every few frames."""
        starts = range(self.first, self.end, every)
        pieces = [self.extrapolate(first, every) for first in starts]
        return np.concatenate(pieces)[: self.horizon]


def sample(velocity: Floats, position: Floats, grid: Grid) -> Floats:
    """Return a field at particles, bilinear, shape [particle, 2]."""
    coordinate = position * grid.cells - grid.origin
    coordinate = np.clip(coordinate, 0.0, grid.nodes - 1.001)
    node = coordinate.astype(int)
    offset = coordinate - node
    x, y = node.T
    right = offset[:, :1]  # share of the node to the right, shape [particle, 1]
    top = offset[:, 1:]
    on_left = velocity[x, y] * (1 - top) + velocity[x, y + 1] * top
    on_right = velocity[x + 1, y] * (1 - top) + velocity[x + 1, y + 1] * top
    return np.asarray(on_left * (1 - right) + on_right * right, np.float64)


def interpolate(test: CalibrationScenario, every: int) -> Floats:
    """Return straight lines between every few true frames."""
    last = test.horizon - 1
    frames = []
    for start in range(0, test.horizon, every):
        end = min(start + every, last)
        displacement = test.truth[end] - test.truth[start]
        for k in range(every):
            frames.append(test.truth[start] + displacement * (k / every))
    return np.stack(frames)[: test.horizon]


def drift(test: CalibrationScenario, *, smooth: bool) -> Floats:
    """Return the truth plus integrated velocity errors of 2 % of its motion."""
    error = 0.02 * test.noise()
    if smooth:
        error[:] = 0.02 * test.step * np.sin(6.0 * test.truth[:, :, ::-1])
    return test.truth + np.cumsum(error, axis=0)


def persistence(test: CalibrationScenario) -> Floats:
    """Return the last given frame, repeated."""
    return np.broadcast_to(test.positions[test.first - 1], test.truth.shape)


def constant_velocity(test: CalibrationScenario) -> Floats:
    """Return motion at the last given velocity."""
    return test.extrapolate(test.first, test.horizon)


def decaying_velocity(test: CalibrationScenario) -> Floats:
    """Return motion at a velocity that loses 5 % per frame."""
    return test.extrapolate(test.first, test.horizon, 0.95)


def fixed_field(test: CalibrationScenario) -> Floats:
    """Return motion in the last given velocity field."""
    return test.follow_field(test.first, test.horizon)


def other_scenario(test: CalibrationScenario) -> Floats:
    """Return the last given frame plus the displacements of another scenario."""
    other = test.other_positions
    displacement = other[test.first : test.end] - other[test.first - 1]
    return test.positions[test.first - 1] + displacement


def field_steps(test: CalibrationScenario) -> Floats:
    """Return one step in the fixed field from every true frame."""
    steps = [test.follow_field(first, 1) for first in range(test.first, test.end)]
    return np.concatenate(steps)


def moving_average(test: CalibrationScenario) -> Floats:
    """Return the mean of the true frames before, at and after each frame."""
    return (test.truth + test.shifted(1) + test.next_frames()) / 3.0


Predict = Callable[[CalibrationScenario], Floats]

HONEST: Mapping[str, Predict] = {
    "persistence": persistence,
    "constant velocity": constant_velocity,
    "decaying velocity": decaying_velocity,
    "fixed field": fixed_field,
    "fixed field, jitter": lambda test: fixed_field(test) + 0.1 * test.noise(),
    "other scenario": other_scenario,
    "accurate, smooth": lambda test: drift(test, smooth=True),
    "accurate, white": lambda test: drift(test, smooth=False),
}
DISHONEST: Mapping[str, Predict] = {
    "truth, noise of 0.01 steps": lambda test: test.truth + 0.01 * test.noise(),
    "truth, noise of 1 step": lambda test: test.truth + test.noise(),
    "truth, noise of 10 steps": lambda test: test.truth + 10.0 * test.noise(),
    "truth, offset of 1 step": lambda test: test.truth + test.step,
    "one step, constant velocity": lambda test: test.restart(1),
    "one step, fixed field": field_steps,
    "reset every 5": lambda test: test.restart(5),
    "reset every 20": lambda test: test.restart(20),
    "one frame late": lambda test: test.shifted(1),
    "two frames late": lambda test: test.shifted(2),
    "one frame early": lambda test: test.next_frames(),
    "every 5th frame, interpolated": lambda test: interpolate(test, 5),
    "mean of three frames": moving_average,
}


def trace_prediction(test: CalibrationScenario, predicted: Floats) -> Trace:
    """Return the trace of a prediction."""
    scenario = test.scenario
    tracer = Tracer(scenario)
    frames = zip(
        scenario.config.predicted_frames,
        snapshots(scenario, test.truth),
        snapshots(scenario, predicted),
        strict=True,
    )
    for frame, true_snapshot, predicted_snapshot in frames:
        pair = FramePair(scenario, frame, true_snapshot, predicted_snapshot)
        tracer.add(pair)
    return tracer.result()


def read_tests(task: ScoredTask) -> dict[int, CalibrationScenario]:
    """Return the test scenarios of a split by id."""
    scenarios = []
    positions = []
    for number in task.scenarios:
        with task.opened(number) as opened:
            scenarios.append(opened.scenario)
            positions.append(opened.file.read("position").astype(np.float64))
    tests = {}
    for i, number in enumerate(task.scenarios):
        tests[number] = CalibrationScenario(
            scenarios[i], positions[i], positions[i - 1]
        )
    return tests


def open_trained(
    paths: Sequence[Path], split: str, size: str
) -> Iterator[tuple[str, Predictions]]:
    """Yield the predictions of trained models on a split, opened."""
    for path in paths:
        with open_predictions(path) as predictions:
            header = predictions.header
            if header.split == split and header.size == size:
                yield path.parent.name, predictions


def read_positions(predictions: Predictions, scenario: int) -> Floats:
    """Return the predicted positions of a scenario, shape [frame, particle, 2]."""
    blocks = [block for _, block in predictions.blocks(scenario)]
    return np.concatenate(blocks).astype(float)


def main() -> int:
    """Print one line per split and prediction: the range of each number."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path)
    parser.add_argument("--splits", default=",".join(SPLITS))
    parser.add_argument("--trained", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    heads = "".join(f"{name:>17s}" for name in (*COLUMNS, "energy", "area"))
    print(f"{'prediction':32s} {'split':14s}{heads}  copy_suspect")
    tables = {"honest": HONEST, "made from the truth": DISHONEST}
    all_numbers: dict[str, list[list[float]]] = {}
    for kind in (*tables, "trained"):
        all_numbers[kind] = []
    for split in options.splits.split(","):
        size = load().size(split, options.size)
        tests = read_tests(load_scored_task(size, resolve_root(options.root)))
        for kind, table in tables.items():
            print(f"-- {split} {options.size}, {kind}")
            for name, predict in table.items():
                traces = []
                for test in tests.values():
                    traces.append(trace_prediction(test, predict(test)))
                all_numbers[kind] += print_line(name, split, traces)

        print(f"-- {split} {options.size}, trained")
        for name, predictions in open_trained(options.trained, split, options.size):
            traces = []
            for number, test in tests.items():
                predicted = read_positions(predictions, number)
                traces.append(trace_prediction(test, predicted))
            all_numbers["trained"] += print_line(name, split, traces)
    for kind, numbers in all_numbers.items():
        if numbers:
            print(f"{'all splits, ' + kind:47s}{format_ranges(numbers)}")
    return 0


def print_line(name: str, split: str, traces: Sequence[Trace]) -> list[list[float]]:
    """Print the line of a prediction; return its numbers by scenario."""
    numbers = [numbers_of(trace) for trace in traces]
    flag = "raised" if judge_copying(traces).raised else "-"
    print(f"{name:32s} {split:14s}{format_ranges(numbers)}  {flag}", flush=True)
    return numbers


def numbers_of(trace: Trace) -> list[float]:
    """Return the numbers of one scenario, in the order of the columns."""
    copy_evidence = analyse_error(trace)
    numbers = []
    for column in COLUMNS:
        numbers.append(float(getattr(copy_evidence, column)))
    numbers.append(float(np.mean(trace.predicted_motion) / np.mean(trace.motion)))
    numbers.append(float(np.mean(trace.occupancy)))
    return numbers


def format_ranges(numbers: Sequence[Sequence[float]]) -> str:
    """Return the least and the greatest of each number; NaN is left out."""
    text = ""
    for column in np.array(numbers).T:
        values = column[~np.isnan(column)]
        cell = "-"
        if values.size:
            cell = f"{min(values):.3g}..{max(values):.3g}"
        text += f"{cell:>17s}"
    return text


if __name__ == "__main__":
    raise SystemExit(main())
