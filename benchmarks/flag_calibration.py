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


class Case:
    """One test scenario with its whole truth in memory.

    Args:
        scenario: what metrics see.
        positions: true positions from frame 0, shape [frame, particle, 2].
        other: those of another test scenario with as many particles.
    """

    def __init__(self, scenario: Scenario, positions: Floats, other: Floats) -> None:
        self.scenario = scenario
        self.other = other
        self.n = scenario.config.input_frames
        self.h = scenario.config.horizon
        self.all = positions[: self.n + self.h + 2]
        self.truth = positions[self.n : self.n + self.h]
        self.rng = np.random.Generator(np.random.PCG64(0))
        self.step = float(
            np.sqrt(np.mean(np.diff(positions[: self.n + self.h], axis=0) ** 2))
        )

    def noise(self) -> Floats:
        """Return white noise of one frame's motion, shape of the truth."""
        return self.step * self.rng.standard_normal(self.truth.shape)

    def from_frame(
        self, first: int, count: int, decay: float = 1.0
    ) -> Iterator[Floats]:
        """Yield ``count`` frames at the velocity before absolute frame ``first``."""
        x = self.all[first - 1]
        u = self.all[first - 1] - self.all[first - 2]
        for _ in range(count):
            u = decay * u
            x = x + u
            yield x

    def field(self, first: int, count: int) -> Iterator[Floats]:
        """Yield ``count`` frames carried by the grid velocity before absolute frame
        ``first``.
        """
        x = self.all[first - 1]
        u = self.all[first - 1] - self.all[first - 2]
        grid = self.scenario.config.grid
        velocity = fields(x, u, grid, full=self.scenario.full_weight).velocity
        for _ in range(count):
            x = x + sample(velocity, x, grid)
            yield x

    def resets(self, every: int) -> Floats:
        """Return constant velocity, started anew from the truth every few frames."""
        starts = range(self.n, self.n + self.h, every)
        return np.concatenate([list(self.from_frame(f, every)) for f in starts])[
            : self.h
        ]


def sample(velocity: Floats, x: Floats, grid: Grid) -> Floats:
    """Return a field at particles, bilinear, shape [particle, 2]."""
    s = np.clip(x * grid.cells - grid.origin, 0.0, grid.nodes - 1.001)
    i = s.astype(int)
    t = s - i
    a = t[:, :1]
    b = t[:, 1:]
    low = velocity[i[:, 0], i[:, 1]] * (1 - b) + velocity[i[:, 0], i[:, 1] + 1] * b
    high = (
        velocity[i[:, 0] + 1, i[:, 1]] * (1 - b)
        + velocity[i[:, 0] + 1, i[:, 1] + 1] * b
    )
    return np.asarray(low * (1 - a) + high * a, np.float64)


def interpolated(case: Case, every: int) -> Floats:
    """Return straight lines between every few true frames."""
    held = list(range(0, case.h, every))
    return np.stack(
        [
            case.truth[a]
            + (case.truth[min(a + every, case.h - 1)] - case.truth[a]) * (k / every)
            for a in held
            for k in range(every)
        ]
    )[: case.h]


def walk(case: Case, *, smooth: bool) -> Floats:
    """Return the truth plus integrated velocity errors of 2 % of its motion."""
    error = 0.02 * case.noise()
    if smooth:
        error[:] = 0.02 * case.step * np.sin(6.0 * case.truth[:, :, ::-1])
    return case.truth + np.cumsum(error, axis=0)


HONEST: Mapping[str, Callable[[Case], Floats]] = {
    "persistence": lambda c: np.broadcast_to(c.all[c.n - 1], c.truth.shape),
    "constant velocity": lambda c: np.stack(list(c.from_frame(c.n, c.h))),
    "decaying velocity": lambda c: np.stack(list(c.from_frame(c.n, c.h, 0.95))),
    "fixed field": lambda c: np.stack(list(c.field(c.n, c.h))),
    "fixed field, jitter": lambda c: (
        np.stack(list(c.field(c.n, c.h))) + 0.1 * c.noise()
    ),
    "other scenario": lambda c: (
        c.all[c.n - 1] + c.other[c.n : c.n + c.h] - c.other[c.n - 1]
    ),
    "accurate, smooth": lambda c: walk(c, smooth=True),
    "accurate, white": lambda c: walk(c, smooth=False),
}
DISHONEST: Mapping[str, Callable[[Case], Floats]] = {
    "truth, noise of 0.01 steps": lambda c: c.truth + 0.01 * c.noise(),
    "truth, noise of 1 step": lambda c: c.truth + c.noise(),
    "truth, noise of 10 steps": lambda c: c.truth + 10.0 * c.noise(),
    "truth, offset of 1 step": lambda c: c.truth + c.step,
    "one step, constant velocity": lambda c: c.resets(1),
    "one step, fixed field": lambda c: np.concatenate(
        [list(c.field(f, 1)) for f in range(c.n, c.n + c.h)]
    ),
    "reset every 5": lambda c: c.resets(5),
    "reset every 20": lambda c: c.resets(20),
    "one frame late": lambda c: c.all[c.n - 1 : c.n + c.h - 1],
    "two frames late": lambda c: c.all[c.n - 2 : c.n + c.h - 2],
    "one frame early": lambda c: np.concatenate([c.truth[1:], c.truth[-1:]]),
    "every 5th frame, interpolated": lambda c: interpolated(c, 5),
    "mean of three frames": lambda c: (
        (
            c.truth
            + c.all[c.n - 1 : c.n + c.h - 1]
            + np.concatenate([c.truth[1:], c.truth[-1:]])
        )
        / 3.0
    ),
}


def trace_of(case: Case, predicted: Floats) -> Trace:
    """Return the trace of a prediction."""
    tracer = Tracer(case.scenario)
    scenario = case.scenario
    sides = (snapshots(scenario, positions) for positions in (case.truth, predicted))
    for frame, true, guess in zip(
        scenario.config.predicted_frames, *sides, strict=True
    ):
        tracer.add(FramePair(scenario, frame, true, guess))
    return tracer.result()


def cases(task: ScoredTask) -> dict[int, Case]:
    """Return the test scenarios of a split by id."""
    held = []
    for number in task.scenarios:
        with task.opened(number) as opened:
            held.append(
                (opened.scenario, opened.file.read("position").astype(np.float64))
            )
    found = [
        Case(scenario, positions, held[i - 1][1])
        for i, (scenario, positions) in enumerate(held)
    ]
    return dict(zip(task.scenarios, found, strict=True))


def trained(
    paths: Sequence[Path], split: str, size: str
) -> Iterator[tuple[str, Predictions]]:
    """Yield the predictions of trained models on a split, opened."""
    for path in paths:
        with open_predictions(path) as predictions:
            if (predictions.header.split, predictions.header.size) == (split, size):
                yield path.parent.name, predictions


def main() -> int:
    """Print one line per split and prediction: least and greatest number over its
    scenarios.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path)
    parser.add_argument("--splits", default=",".join(SPLITS))
    parser.add_argument("--trained", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    names = "".join(f"{name:>17s}" for name in (*COLUMNS, "energy", "area"))
    print(f"{'prediction':32s} {'split':14s}{names}  copy_suspect")
    seen: dict[str, list[list[float]]] = {
        "honest": [],
        "made from the truth": [],
        "trained": [],
    }
    for split in options.splits.split(","):
        task = load_scored_task(
            load().size(split, options.size), resolve_root(options.root)
        )
        by_id = cases(task)
        held = list(by_id.values())
        for kind, table in (("honest", HONEST), ("made from the truth", DISHONEST)):
            print(f"-- {split} {options.size}, {kind}")
            for name, predict in table.items():
                seen[kind] += tell(
                    name, split, [trace_of(case, predict(case)) for case in held]
                )
        print(f"-- {split} {options.size}, trained")
        for name, predictions in trained(options.trained, split, options.size):
            rolled = {
                i: np.concatenate([block for _, block in predictions.blocks(i)]).astype(
                    float
                )
                for i in by_id
            }
            seen["trained"] += tell(
                name, split, [trace_of(case, rolled[i]) for i, case in by_id.items()]
            )
    for kind, numbers in seen.items():
        if numbers:
            print(f"{'all splits, ' + kind:47s}{ranges(numbers)}")
    return 0


def tell(name: str, split: str, traces: Sequence[Trace]) -> list[list[float]]:
    """Print the line of a prediction; return its numbers by scenario."""
    numbers = [numbers_of(trace) for trace in traces]
    if judge_copying(traces).raised:
        raised = "raised"
    else:
        raised = "-"
    print(f"{name:32s} {split:14s}{ranges(numbers)}  {raised}", flush=True)
    return numbers


def numbers_of(trace: Trace) -> list[float]:
    """Return the numbers of one scenario, in the order of the columns."""
    found = analyse_error(trace)
    energy = float(np.mean(trace.predicted_motion) / np.mean(trace.motion))
    return [
        *(float(getattr(found, column)) for column in COLUMNS),
        energy,
        float(np.mean(trace.occupancy)),
    ]


def ranges(numbers: Sequence[Sequence[float]]) -> str:
    """Return the least and the greatest of each number over scenarios; NaN is left
    out.
    """
    columns = np.array(numbers).T
    known = [column[~np.isnan(column)] for column in columns]
    cells = [f"{min(c):.3g}..{max(c):.3g}" if c.size else "-" for c in known]
    return "".join(f"{cell:>17s}" for cell in cells)


if __name__ == "__main__":
    raise SystemExit(main())
