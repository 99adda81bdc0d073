"""Gates: what the weights of a graph network must do before they support a claim.

    python -m studies.gates --root FOLDER [-o leaderboard] [--weights FILE ...]
    python -m studies.gates --recorded [-o leaderboard]

A graph network that fails them was trained too little or with settings that do not fit:
comparing it with another method says nothing about the method. On ``valid``:

- *one step*: root-mean-square error of the acceleration of one step, over that of the
  true acceleration beyond gravity. At 1 the network is as good as no network; at most
  a half is asked for.
- *free flight*: mean error of the vertical acceleration where matter falls freely [g].
- *settled*: the same where matter is at rest.
- *densest cell*: particles in the fullest cell of the score grid in rollouts, over
  those in the truth. A large number is a collapse.

Free flight and rest have no meaning in full boxes without gravity. On a free surface
they are not measured where no window of ``valid`` falls freely or is at rest.
``--recorded`` measures nothing: it prints the table of the active entries from the
gates.json of the folder that ``-o`` names, by default the leaderboard of lagbench.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.atomic import write_atomically
from lagbench.baselines.baseline import Baseline
from lagbench.baselines.catalogue import find
from lagbench.baselines.checkpoint import load, restore
from lagbench.baselines.rollout import roll_out, scenario_batch, scenario_paths
from lagbench.baselines.simulator import GraphNetwork
from lagbench.board.entry import read_entry
from lagbench.board.folder import GATES, Folder
from lagbench.data.checksums import file_sha256, round_digits
from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import LagbenchError, UnreadableFileError, UsageError
from lagbench.figures.tables import escape
from lagbench.tensors import Batch

BOARD = Path("leaderboard")

Floats = NDArray[np.float64]

LIMITS = {"one_step": 0.5, "free_flight": 0.02, "settled": 0.01, "densest_cell": 3.0}
"""The size of a measure, not its sign, must be less than its limit.

The densest cell may reach its limit.
"""

FORMAT = 1  # of gates.json
TEXTS = ("split", "size", "dataset_version", "method", "weights_sha256")  # of a row
FRAME_STEP = 20  # frames between the windows of a scenario
ROLLOUT_STEP = 10  # frames between the states in which the fullest cell is sought
FALL_TOLERANCE = 0.02  # of a window in free flight: mean acceleration off g, in g
REST_LIMIT = 0.05  # of a settled window: root-mean-square acceleration, in g


@dataclass(frozen=True, kw_only=True)
class Gates:
    """The measures of one file of weights.

    They are None where a gate has no meaning or was not measured.
    """

    split: str
    size: str
    dataset_version: str  # of the training data
    method: str  # name of the entry on the board, or of the file
    weights_sha256: str
    one_step: float  # error over the true acceleration beyond gravity [1]
    free_flight: float | None  # mean vertical error [g]
    settled: float | None  # mean vertical error [g]
    densest_cell: float  # over that of the truth [1]
    # the option --scenarios, the most scenarios of single steps; None in older records
    scenarios: int | None = None
    # the option --rollouts, the most scenarios of rollouts; None in older records
    rollouts: int | None = None

    @property
    def failed(self) -> list[str]:
        """Names of the gates that the weights fail. A value of None does not fail."""
        names = []
        for name, limit in LIMITS.items():
            value = getattr(self, name)
            if value is None:
                continue
            is_within = abs(value) < limit  # False for NaN
            if name == "densest_cell":
                is_within = value <= limit
            if not is_within:
                names.append(name)
        return names


@dataclass(kw_only=True)
class StepErrors:
    """Sums over the windows of one step [length/frame^2]."""

    squared_error: float = 0.0
    squared_truth: float = 0.0  # of accelerations beyond gravity
    values: int = 0
    free_flight: list[float]  # mean vertical errors of windows that fall
    settled: list[float]  # mean vertical errors of windows at rest

    def add(self, error: Floats, truth: Floats, fall: float) -> None:
        """Add a window.

        Args:
            error: predicted less true acceleration, shape [particle, axis].
            truth: true acceleration, shape [particle, axis].
            fall: acceleration of a free particle along the vertical axis.
        """
        beyond_gravity = truth.copy()
        beyond_gravity[:, 1] -= fall
        self.squared_error += float(np.square(error).sum())
        self.squared_truth += float(np.square(beyond_gravity).sum())
        self.values += error.size
        if fall == 0.0:
            return
        gravity = abs(fall)
        mean_error = float(error[:, 1].mean()) / gravity
        if np.abs(beyond_gravity.mean(axis=0)).max() < FALL_TOLERANCE * gravity:
            self.free_flight.append(mean_error)
        elif np.sqrt(np.square(truth).mean()) < REST_LIMIT * gravity:
            self.settled.append(mean_error)

    @property
    def relative(self) -> float:
        """Root-mean-square error over that of the truth beyond gravity [1]."""
        if self.squared_truth == 0.0:
            return math.inf
        return math.sqrt(self.squared_error / self.squared_truth)


@torch.no_grad()
def predict_step(
    model: Baseline, window: Batch, density_limit: Tensor | None
) -> tuple[Floats, Floats]:
    """Return error and truth of the acceleration of a window's last frame.

    Both are in length/frame^2 and have the shape [particle, axis].

    Args:
        model: the model that predicts the last frame from the others.
        window: frames of a scenario.
        density_limit: largest density that relaxation leaves alone in a rollout of the
            scenario, shape [1]; None without relaxation.
    """
    given = window.part(slice(window.frames - 1))
    state = model.start(given)
    if isinstance(model, GraphNetwork):
        state = replace(state, density_limit=density_limit)
    _, predicted = model.advance(state)
    box = model.box.box
    frames = window.position.double().numpy()
    before = box.displacement(frames[:, -3], frames[:, -2])
    true_velocity = box.displacement(frames[:, -2], frames[:, -1])
    error = box.displacement(frames[:, -1], predicted.double().numpy())
    return np.asarray(error), np.asarray(true_velocity - before)


@torch.no_grad()
def rollout_limit(model: Baseline, given: Batch) -> Tensor | None:
    """Return the largest density that relaxation leaves alone in a rollout, shape [1].

    None without relaxation.

    Args:
        model: the model.
        given: given frames of a scenario.
    """
    if not isinstance(model, GraphNetwork) or model.relaxation is None:
        return None
    return model.relaxation.limit(given.position[:, -1], given.sample)


def measure_steps(
    model: Baseline, paths: Sequence[Path], size: Size, *, every: int = FRAME_STEP
) -> StepErrors:
    """Return the errors of single steps from true states of whole scenarios."""
    gravity = size.parameters.get("gravity")
    fall = 0.0
    if gravity is not None and gravity.value:
        fall = -float(gravity.value) * size.frame_interval**2
    errors = StepErrors(free_flight=[], settled=[])
    needed = max(model.history, 3)
    for path in paths:
        scenario = scenario_batch(path, viscosity=size.viscosity())
        limit = rollout_limit(model, scenario.part(slice(size.task.input_frames)))
        for last in range(needed, scenario.frames, every):
            window = scenario.part(slice(last - needed, last + 1))
            error, truth = predict_step(model, window, limit)
            errors.add(error, truth, fall)
    return errors


def count_densest(position: NDArray[np.float32], cells: int) -> int:
    """Return the most particles in a cell of a grid over the unit box."""
    index = np.clip((position * cells).astype(np.int64), 0, cells - 1)
    flat = np.zeros(len(index), np.int64)
    for axis in range(index.shape[1]):
        flat = flat * cells + index[:, axis]
    return int(np.bincount(flat).max())


def measure_collapse(model: Baseline, paths: Sequence[Path], size: Size) -> float:
    """Return the particles in the fullest cell of rollouts over those of the truth.

    The largest ratio of all scenarios counts.
    """
    task = size.task
    cells = task.score_grid.cells
    last = task.input_frames + task.horizon
    ratios = []
    for path in paths:
        scenario = scenario_batch(path, slice(last), viscosity=size.viscosity())
        given = scenario.part(slice(task.input_frames))
        (rollout,) = roll_out(model, given, task.horizon)
        predicted_counts = []
        true_counts = []
        for step in range(0, task.horizon, ROLLOUT_STEP):
            true_frame = scenario.position[:, task.input_frames + step].numpy()
            predicted_counts.append(
                count_densest(rollout.position[step].numpy(), cells)
            )
            true_counts.append(count_densest(true_frame, cells))
        ratios.append(max(predicted_counts) / max(true_counts))
    return max(ratios)


def measure(
    weights: Path, *, root: Path, scenarios: int, rollouts: int, every: int = FRAME_STEP
) -> Gates:
    """Return the gates of a file of weights, on the subset valid of its data set.

    Args:
        weights: file of a training or of an entry.
        root: folder of all data sets.
        scenarios: scenarios whose single steps are measured, at most.
        rollouts: scenarios that are rolled out, at most.
        every: frames between the measured steps of a scenario.
    """
    checkpoint = load(weights)
    model = restore(checkpoint, where=str(weights))
    model.eval()
    info = checkpoint.info
    size = load_registry().size(info.split, info.size)
    valid = scenario_paths(info.split, subset="valid", size=info.size, root=root)
    paths = list(valid.values())
    errors = measure_steps(model, paths[:scenarios], size, every=every)
    return Gates(
        split=info.split,
        size=info.size,
        dataset_version=info.version,
        method=weights.stem,
        weights_sha256=file_sha256(weights),
        one_step=round_digits(errors.relative, 4),
        free_flight=_mean(errors.free_flight),
        settled=_mean(errors.settled),
        densest_cell=round_digits(measure_collapse(model, paths[:rollouts], size), 4),
        scenarios=scenarios,
        rollouts=rollouts,
    )


def _mean(values: Sequence[float]) -> float | None:
    if not values:
        return None
    return round_digits(float(np.mean(values)), 4)


def to_json(rows: Iterable[Gates], recorded: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return gates.json: limits, and measures with the gates that failed.

    Args:
        rows: what was measured now.
        recorded: lines of an older gates.json; those of other weights stay.
    """
    lines = {}
    for line in recorded:
        lines[line["split"], line["size"], line["method"]] = dict(line)
    for row in rows:
        lines[row.split, row.size, row.method] = {**asdict(row), "failed": row.failed}
    entries = [lines[key] for key in sorted(lines)]
    content = {"format": FORMAT, "limits": LIMITS, "weights": entries}
    return json.dumps(content, indent=1) + "\n"


def read_recorded(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a gates.json; none where there is no such file.

    Raises:
        UnreadableFileError: the file is not what :func:`to_json` returns.
    """
    if not path.exists():
        return []
    keys = set()
    for field in fields(Gates):
        # older files lack the fields that have a default
        if field.default is MISSING:
            keys.add(field.name)
    try:
        content = json.loads(path.read_text("utf-8"))
        lines = list(map(dict, content["weights"]))
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise _damaged(path, error) from error
    for number, line in enumerate(lines):
        missing = keys - line.keys()
        if missing:
            raise _damaged(path, f"no {', '.join(sorted(missing))} in row {number}")
        for name in TEXTS:
            if not isinstance(line[name], str):
                raise _damaged(path, f"no text for {name} in row {number}")
        for name in LIMITS:
            if not _is_measure(line[name]):
                raise _damaged(path, f"no number for {name} in row {number}")
    return lines


def _is_measure(value: object) -> bool:
    """Tell whether a gate may have a value: a number, or None."""
    if isinstance(value, bool):
        return False
    return value is None or isinstance(value, (int, float))


def _damaged(path: Path, reason: object) -> UnreadableFileError:
    """Return the error for a file that is no gates.json."""
    return UnreadableFileError(
        f"the gates cannot be read: {reason}; restore the file, or remove it and "
        "measure anew: python -m studies.gates",
        where=str(path),
    )


def active_rows(folder: Folder) -> list[Gates]:
    """Return the recorded measures of the weights of active entries."""
    active_hashes = set()
    for entry_path in folder.entries():
        entry = read_entry(folder.path / entry_path)
        for prediction in entry.predictions:
            if prediction.weights is not None:
                active_hashes.add(prediction.weights.sha256)
    rows = []
    for line in read_recorded(folder.path / GATES):
        if line["weights_sha256"] in active_hashes:
            measures: dict[str, Any] = {}
            for field in fields(Gates):
                measures[field.name] = line.get(field.name)
            rows.append(Gates(**measures))
    return rows


def to_markdown(rows: Iterable[Gates]) -> str:
    """Return the table of all measures.

    A dash stands for a gate that has no meaning in a full box. On a free surface
    *not measured* stands for a gate without a value.
    """
    lines = [
        "| data set | weights | one step | free flight [g] | settled [g] "
        "| densest cell | verdict |",
        "| --- | --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for row in rows:
        verdict = "*under-trained*" if row.failed else "passes"
        cells = [
            f"{row.split} {row.size} {row.dataset_version}",
            escape(row.method),
            *_format_measures(row),
            verdict,
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _format_measures(row: Gates) -> list[str]:
    gravity = load_registry().size(row.split, row.size).parameters.get("gravity")
    missing = "not measured" if gravity is not None and gravity.value else "-"
    cells = []
    for name in LIMITS:
        value = getattr(row, name)
        cells.append(missing if value is None else f"{value:.3g}")
    return cells


def board_weights(folder: Folder, splits: Sequence[str], size: str) -> list[Path]:
    """Return the weights of the graph networks among the active entries.

    The weights of another size have their gates there.
    """
    paths: dict[Path, None] = {}
    for entry_path in folder.entries():
        entry = read_entry(folder.path / entry_path)
        is_wanted = entry.split in splits and entry.size == size
        if not is_wanted:
            continue
        for prediction in entry.predictions:
            weights = prediction.weights
            if weights is None or Path(weights.path).parts[2] != size:
                continue
            path = folder.path / weights.path
            if is_graph_network(path):
                paths[path] = None
    return list(paths)


def is_graph_network(weights: Path) -> bool:
    """Tell whether the record in a file of weights names a graph network.

    ONNX files have no such record, and models of other packages may be missing here.
    """
    if weights.suffix == ".onnx":
        return False
    try:
        entry = find(load(weights).baseline)
    except UsageError:
        return False
    return issubclass(entry.model, GraphNetwork)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure weights, print the table and write both files; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.gates",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--root", type=Path, default=os.environ.get("LAGBENCH_ROOT"))
    parser.add_argument(
        "--weights", type=Path, nargs="+", help="instead of the board's"
    )
    parser.add_argument("--split", nargs="+", default=["cavity", "curl-noise", "fluid"])
    parser.add_argument("--size", default="mini")
    parser.add_argument("--scenarios", type=int, default=8)
    parser.add_argument("--rollouts", type=int, default=4)
    parser.add_argument(
        "--output",
        "-o",
        type=Path,
        help="folder of gates.json; with --recorded a leaderboard",
    )
    parser.add_argument(
        "--recorded", action="store_true", help="print recorded measures only"
    )
    options = parser.parse_args(arguments)
    if not options.recorded and options.root is None:
        parser.error("name the folder of all data sets: --root FOLDER")
    for option in ("scenarios", "rollouts"):
        if getattr(options, option) < 1:
            parser.error(f"--{option}: at least one scenario is needed")
    try:
        if options.recorded:
            folder = Folder(options.output or BOARD)
            folder.require()
            rows = active_rows(folder)
        else:
            rows = _measure_all(options)
        table = to_markdown(rows)
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(table)
    return 0


def _measure_all(options: argparse.Namespace) -> list[Gates]:
    """Measure the weights that the options name; write gates.json if they name it."""
    torch.set_num_threads(1)
    if options.output is not None:
        # A damaged file is refused before the long measurement.
        read_recorded(options.output / GATES)
    rows = []
    paths = options.weights
    if not paths:
        paths = board_weights(Folder(BOARD), options.split, options.size)
    for path in paths:
        row = measure(
            path,
            root=Path(options.root),
            scenarios=options.scenarios,
            rollouts=options.rollouts,
        )
        rows.append(row)
    if options.output is not None:
        # Another process may have written the file meanwhile.
        path = options.output / GATES
        text = to_json(rows, recorded=read_recorded(path))
        write_atomically(path, text.encode(), option="--output")
    return rows


if __name__ == "__main__":
    sys.exit(main())
