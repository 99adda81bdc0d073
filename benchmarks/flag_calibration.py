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

``--trained`` also prints the values of trained models, in lines of their own. Their
predictions must be of the splits and the size that are named.

The thresholds in lagbench/scoring/flags.py lie between the extremes that this prints.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Grid, fields
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.errors import LagbenchError, UsageError, suggest_name
from lagbench.metrics import FramePair, Scenario, snapshots
from lagbench.scoring.flags import Trace, Tracer, analyse_error, judge_copying
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.submission import Predictions, open_predictions

Floats = NDArray[np.float64]
Numbers = list[float]
"""The numbers of a scenario, in the order of the columns."""

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
        path = positions[: self.end]
        displacement = np.diff(path, axis=0)
        mean_square = np.mean(displacement**2)
        self.step = float(np.sqrt(mean_square))  # [length/frame]

    def noise(self) -> Floats:
        """Return white noise of one frame's motion, shape of the truth."""
        normal = self.rng.standard_normal(self.truth.shape)
        return self.step * normal

    def shifted(self, frames: int) -> Floats:
        """Return the truth of so many frames earlier, shape of the truth."""
        first = self.first - frames
        end = self.end - frames
        return self.positions[first:end]

    def next_frames(self) -> Floats:
        """Return the truth one frame later; the last frame repeats."""
        later = self.truth[1:]
        last = self.truth[-1:]
        return np.concatenate([later, last])

    def last_motion(self, first: int) -> tuple[Floats, Floats]:
        """Return position and displacement in the frame before an absolute frame."""
        before = self.positions[first - 2]
        position = self.positions[first - 1]
        displacement = position - before
        return position, displacement

    def extrapolate(
        self,
        first: int,
        count: int,
        *,
        decay: float = 1.0,
    ) -> Floats:
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
        grid_fields = fields(
            position,
            displacement,
            grid,
            full=self.scenario.full_weight,
        )
        node_velocity = grid_fields.velocity
        frames = []
        for _ in range(count):
            velocity = sample(node_velocity, position, grid)
            position = position + velocity
            frames.append(position)
        return np.stack(frames)

    def restart(self, every: int) -> Floats:
        """Return constant velocity, started again from the truth every few frames."""
        pieces = []
        for first in range(self.first, self.end, every):
            piece = self.extrapolate(first, every)
            pieces.append(piece)
        frames = np.concatenate(pieces)
        return frames[: self.horizon]


def sample(velocity: Floats, position: Floats, grid: Grid) -> Floats:
    """Return a field at particles, bilinear, shape [particle, 2]."""
    coordinate = position * grid.cells - grid.origin
    coordinate = np.clip(coordinate, 0.0, grid.nodes - 1.001)
    node = coordinate.astype(int)
    offset = coordinate - node
    x, y = node.T
    bottom_left = velocity[x, y]
    top_left = velocity[x, y + 1]
    bottom_right = velocity[x + 1, y]
    top_right = velocity[x + 1, y + 1]

    right_share = offset[:, :1]  # of the nodes on the right, shape [particle, 1]
    left_share = 1 - right_share
    top_share = offset[:, 1:]
    bottom_share = 1 - top_share
    on_left = bottom_left * bottom_share + top_left * top_share
    on_right = bottom_right * bottom_share + top_right * top_share
    at_particle = on_left * left_share + on_right * right_share
    return np.asarray(at_particle, np.float64)


def interpolate(test: CalibrationScenario, every: int) -> Floats:
    """Return straight lines between every few true frames."""
    last = test.horizon - 1
    frames = []
    for first in range(0, test.horizon, every):
        end = min(first + every, last)
        start_position = test.truth[first]
        end_position = test.truth[end]
        displacement = end_position - start_position
        for step in range(every):
            share = step / every
            position = start_position + displacement * share
            frames.append(position)
    positions = np.stack(frames)
    return positions[: test.horizon]


def drift(test: CalibrationScenario, *, smooth: bool) -> Floats:
    """Return the truth plus integrated velocity errors of 2 % of its motion."""
    error = 0.02 * test.noise()
    if smooth:
        swapped_axes = test.truth[:, :, ::-1]
        waves = np.sin(6.0 * swapped_axes)
        error[:] = 0.02 * test.step * waves
    position_error = np.cumsum(error, axis=0)
    return test.truth + position_error


def persistence(test: CalibrationScenario) -> Floats:
    """Return the last given frame, repeated."""
    last_given = test.positions[test.first - 1]
    return np.broadcast_to(last_given, test.truth.shape)


def constant_velocity(test: CalibrationScenario) -> Floats:
    """Return motion at the last given velocity."""
    return test.extrapolate(test.first, test.horizon)


def decaying_velocity(test: CalibrationScenario) -> Floats:
    """Return motion at a velocity that loses 5 % per frame."""
    return test.extrapolate(test.first, test.horizon, decay=0.95)


def fixed_field(test: CalibrationScenario) -> Floats:
    """Return motion in the last given velocity field."""
    return test.follow_field(test.first, test.horizon)


def other_scenario(test: CalibrationScenario) -> Floats:
    """Return the last given frame plus the displacements of another scenario."""
    other = test.other_positions
    last_given = test.first - 1
    other_start = other[last_given]
    other_path = other[test.first : test.end]
    displacement = other_path - other_start
    position: Floats = test.positions[last_given] + displacement
    return position


def field_steps(test: CalibrationScenario) -> Floats:
    """Return one step in the fixed field from every true frame."""
    frames = []
    for first in range(test.first, test.end):
        frame = test.follow_field(first, 1)
        frames.append(frame)
    return np.concatenate(frames)


def moving_average(test: CalibrationScenario) -> Floats:
    """Return the mean of the true frames before, at and after each frame."""
    before = test.shifted(1)
    after = test.next_frames()
    return (test.truth + before + after) / 3.0


def jittered_field(test: CalibrationScenario) -> Floats:
    """Return motion in the last given velocity field, with a jitter of 0.1 steps."""
    return fixed_field(test) + 0.1 * test.noise()


def noisy_truth(test: CalibrationScenario, steps: float) -> Floats:
    """Return the truth with noise of so many steps."""
    return test.truth + steps * test.noise()


Predict = Callable[[CalibrationScenario], Floats]

HONEST: Mapping[str, Predict] = {
    "persistence": persistence,
    "constant velocity": constant_velocity,
    "decaying velocity": decaying_velocity,
    "fixed field": fixed_field,
    "fixed field, jitter": jittered_field,
    "other scenario": other_scenario,
    "accurate, smooth": lambda test: drift(test, smooth=True),
    "accurate, white": lambda test: drift(test, smooth=False),
}
DISHONEST: Mapping[str, Predict] = {
    "truth, noise of 0.01 steps": lambda test: noisy_truth(test, 0.01),
    "truth, noise of 1 step": lambda test: noisy_truth(test, 1.0),
    "truth, noise of 10 steps": lambda test: noisy_truth(test, 10.0),
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
    frames = scenario.config.predicted_frames
    true_snapshots = snapshots(scenario, test.truth)
    predicted_snapshots = snapshots(scenario, predicted)
    for frame, true_snapshot, predicted_snapshot in zip(
        frames, true_snapshots, predicted_snapshots, strict=True
    ):
        pair = FramePair(scenario, frame, true_snapshot, predicted_snapshot)
        tracer.add(pair)
    return tracer.result()


def read_tests(task: ScoredTask) -> dict[int, CalibrationScenario]:
    """Return the test scenarios of a split by id."""
    scenarios = []
    positions = []
    for number in task.scenarios:
        with task.opened(number) as opened:
            position = opened.file.read("position")
            positions.append(position.astype(np.float64))
            scenarios.append(opened.scenario)
    tests = {}
    for i, number in enumerate(task.scenarios):
        other_positions = positions[i - 1]
        test = CalibrationScenario(scenarios[i], positions[i], other_positions)
        tests[number] = test
    return tests


def check_splits(splits: Sequence[str]) -> None:
    """Refuse splits for which these predictions are not made.

    Positions jump at periodic boundaries, and fields are those of two axes.

    Raises:
        UsageError: one of the splits has such a boundary, or three axes.
    """
    for split in splits:
        if split not in SPLITS:
            raise UsageError(
                "no predictions are made for this split",
                where="--splits",
                expected=f"some of {', '.join(SPLITS)}",
                got=repr(split),
                fix=suggest_name(split, SPLITS),
            )


def check_trained(paths: Sequence[Path], splits: Sequence[str], size: str) -> None:
    """Refuse predictions of other data sets, of which no line would be printed.

    Raises:
        UsageError: a file has another split or another size.
    """
    for path in paths:
        with open_predictions(path) as predictions:
            header = predictions.header
        if header.split not in splits or header.size != size:
            raise UsageError(
                "these are predictions of another data set",
                where=f"--trained {path}",
                expected=f"{' or '.join(splits)}, size {size}",
                got=f"{header.split} {header.size}",
                fix="leave the file out, or name its data set: --splits, --size",
            )


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
    blocks = []
    for _, block in predictions.blocks(scenario):
        blocks.append(block)
    positions = np.concatenate(blocks)
    return positions.astype(float)


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
    root = resolve_root(options.root)
    splits = options.splits.split(",")
    check_splits(splits)
    check_trained(options.trained, splits, options.size)
    heads = ""
    for column in (*COLUMNS, "energy", "area"):
        heads += f"{column:>17s}"
    print(f"{'prediction':32s} {'split':14s}{heads}  copy_suspect")

    tables = {"honest": HONEST, "made from the truth": DISHONEST}
    all_numbers: dict[str, list[Numbers]] = {}
    for kind in (*tables, "trained"):
        all_numbers[kind] = []
    for split in splits:
        size = load().size(split, options.size)
        task = load_scored_task(size, root)
        tests = read_tests(task)
        for kind, table in tables.items():
            print(f"-- {split} {options.size}, {kind}")
            for name, predict in table.items():
                traces = []
                for test in tests.values():
                    predicted = predict(test)
                    trace = trace_prediction(test, predicted)
                    traces.append(trace)
                all_numbers[kind] += print_line(name, split, traces)

        print(f"-- {split} {options.size}, trained")
        trained = open_trained(options.trained, split, options.size)
        for name, predictions in trained:
            traces = []
            for number, test in tests.items():
                predicted = read_positions(predictions, number)
                trace = trace_prediction(test, predicted)
                traces.append(trace)
            all_numbers["trained"] += print_line(name, split, traces)
    for kind, numbers in all_numbers.items():
        if numbers:
            ranges = format_ranges(numbers)
            print(f"{'all splits, ' + kind:47s}{ranges}")
    return 0


def print_line(name: str, split: str, traces: Sequence[Trace]) -> list[Numbers]:
    """Print the line of a prediction; return its numbers by scenario."""
    numbers = []
    for trace in traces:
        scenario_numbers = numbers_of(trace)
        numbers.append(scenario_numbers)
    ranges = format_ranges(numbers)
    flag = "-"
    if judge_copying(traces).raised:
        flag = "raised"
    print(f"{name:32s} {split:14s}{ranges}  {flag}", flush=True)
    return numbers


def numbers_of(trace: Trace) -> Numbers:
    """Return the numbers of one scenario, in the order of the columns."""
    copy_evidence = analyse_error(trace)
    numbers = []
    for column in COLUMNS:
        value = getattr(copy_evidence, column)
        numbers.append(float(value))
    predicted_motion = np.mean(trace.predicted_motion)
    true_motion = np.mean(trace.motion)
    energy_ratio = predicted_motion / true_motion
    area_ratio = np.mean(trace.occupancy)
    numbers.append(float(energy_ratio))
    numbers.append(float(area_ratio))
    return numbers


def format_ranges(numbers: Sequence[Sequence[float]]) -> str:
    """Return the least and the greatest of each number; NaN is left out."""
    text = ""
    for column in np.array(numbers).T:
        is_number = ~np.isnan(column)
        values = column[is_number]
        cell = "-"
        if values.size:
            least = min(values)
            greatest = max(values)
            cell = f"{least:.3g}..{greatest:.3g}"
        text += f"{cell:>17s}"
    return text


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"flag_calibration: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
