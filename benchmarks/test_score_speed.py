"""How long and in what memory a full cavity submission is scored, beside a naive
scorer.

    OMP_NUM_THREADS=1 pytest benchmarks/test_score_speed.py -s

Ours runs in a fresh process as ``lagbench score`` would: twenty scenarios, 90 or 594
frames, all metrics but Sinkhorn, one worker and two. The naive one scores two
scenarios' first frames of the same files in the same run; its time is scaled to all
frames. It is plain, as one would write it after the thesis: whole arrays, velocities by
SciPy griddata, cubic, on the 40x40 grid, five metrics against our sixty.
``scoring_against.py`` is the comparison with an earlier scorer.
"""

from __future__ import annotations

import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import griddata
from scipy.stats import entropy, pearsonr
from score_data import ScoreData, make_score_data
from timing import measured_apart

from lagbench.scoring.task import load_scored_task

MEMORY = 200e6
"""Target for the largest process [bytes]."""

NAIVE_FRAMES = 4
CELLS = 40

Floats = NDArray[np.float64]

CHILD = """
import json, sys, time
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
import netCDF4
from lagbench.data.registry import load
from lagbench.scoring.score import score

def cpu_seconds():
    return sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))

def peak_kib():
    children = getrusage(RUSAGE_CHILDREN).ru_maxrss
    # getrusage's maximum of this process is that of its parent before exec
    status = Path("/proc/self/status")
    if not status.is_file() or "VmHWM:" not in status.read_text():
        return max(getrusage(RUSAGE_SELF).ru_maxrss, children)
    peak = int(status.read_text().split("VmHWM:")[1].split()[0])
    return max(peak, children)

folder = Path(sys.argv[1])
registry = load(folder / "datasets.yaml")
wall_start = time.perf_counter()
cpu_start = cpu_seconds()
card = score(
    folder / "predictions.nc",
    root=folder / "root",
    registry=registry,
    workers=int(sys.argv[2]),
)
print(json.dumps({
    "wall": time.perf_counter() - wall_start,
    "cpu": cpu_seconds() - cpu_start,
    "memory": 1024 * peak_kib(),
    "metrics": len(card.submission),
    "bytes": card.files[1].stat().st_size,
}))
"""


def run_ours(folder: Path, workers: int) -> dict[str, float]:
    """Score in a fresh process; return its time, processor time and memory."""
    costs: dict[str, float] = measured_apart("-c", CHILD, str(folder), str(workers))
    return costs


def naive_scores(
    truth: Path,
    predictions: Path,
    *,
    row: int,
    first: int,
    frames: int,
) -> dict[str, float]:
    """Return five metrics of one scenario, means over frames.

    Args:
        truth: scenario file.
        predictions: predictions.nc.
        row: row of the scenario in it.
        first: absolute number of the first predicted frame.
        frames: frames to score.
    """
    last_given = first - 1
    end = first + frames
    with h5py.File(truth) as file:
        stored_truth = file["position"][last_given:end]
    with h5py.File(predictions) as file:
        stored_prediction = file["position"][row, :frames]
    true = stored_truth.astype(np.float64)
    predicted = np.concatenate([true[:1], stored_prediction])
    frame_scores = []
    for frame in range(1, frames + 1):
        both_frames = slice(frame - 1, frame + 1)
        scores = _score_frame(true[both_frames], predicted[both_frames])
        frame_scores.append(scores)
    means = {}
    for name in frame_scores[0]:
        values = [scores[name] for scores in frame_scores]
        means[name] = float(np.mean(values))
    return means


def _score_frame(true: Floats, predicted: Floats) -> dict[str, float]:
    """Return five metrics of a frame.

    Args:
        true: positions in the frame before and in this one, shape [2, particle, 2].
        predicted: the same of the prediction.
    """
    true_field = _vorticity(true)
    predicted_field = _vorticity(predicted)
    has_both = np.isfinite(true_field) & np.isfinite(predicted_field)
    true_vorticity = true_field[has_both]
    vorticity = predicted_field[has_both]
    residual = vorticity - true_vorticity
    position_error = predicted[1] - true[1]
    true_magnitude = np.abs(true_vorticity) + 1e-10
    magnitude = np.abs(vorticity) + 1e-10
    correlation = pearsonr(true_vorticity, vorticity)
    return {
        "position_mse": float(np.mean(position_error**2)),
        "vorticity_mse": float(np.mean(residual**2)),
        "vorticity_mae": float(np.abs(residual).mean()),
        "vorticity_pearson": float(correlation.statistic),
        "vorticity_kl": float(entropy(true_magnitude, magnitude)),
    }


def _vorticity(positions: Floats) -> Floats:
    """Return the vorticity of the second of two frames at the nodes [1/frame]."""
    before, position = positions
    spacing = 1 / CELLS
    axis = (np.arange(CELLS) + 0.5) / CELLS
    nodes = np.meshgrid(axis, axis, indexing="ij")
    velocity = griddata(position, position - before, tuple(nodes), method="cubic")
    u = velocity[..., 0]
    v = velocity[..., 1]
    dv_dx = np.gradient(v, spacing, axis=0)
    du_dy = np.gradient(u, spacing, axis=1)
    return np.asarray(dv_dx - du_dy)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ScoreData:
    """Twenty scenarios of 90 frames."""
    folder = tmp_path_factory.mktemp("short")
    return make_score_data(folder)


def test_score_beside_a_naive_scorer(data: ScoreData) -> None:
    """All metrics take a tenth of the time of five naive ones, or less."""
    folder = data.predictions.parent
    one = run_ours(folder, 1)
    two = run_ours(folder, 2)
    size = data.registry.size("cavity", "full")
    task = load_scored_task(size, data.root)
    wall_start = time.perf_counter()
    cpu_start = time.process_time()
    for row, scenario in enumerate(task.scenarios[:2]):
        naive_scores(
            task.truth.path(scenario),
            data.predictions,
            row=row,
            first=6,
            frames=NAIVE_FRAMES,
        )
    wall = time.perf_counter() - wall_start
    cpu = time.process_time() - cpu_start
    frame_count = len(task.scenarios) * 90
    scale = frame_count / (2 * NAIVE_FRAMES)
    naive_wall = scale * wall
    naive_cpu = scale * cpu
    costs = {"one worker": one, "two workers": two}
    for name, ours in costs.items():
        print(
            f"\n{name}: {ours['wall']:.2f} s, {ours['cpu']:.2f} CPU-s, "
            f"{ours['memory'] / 1e6:.0f} MB, {ours['metrics']} metrics, "
            f"scores.nc {ours['bytes'] / 1e3:.0f} kB "
            f"(targets {MEMORY / 1e6:.0f} MB, 1 MB)"
        )
    # Idle BLAS threads count as processor time of the naive side, other processes as
    # its wall time.
    ratio = min(naive_cpu, naive_wall) / one["cpu"]
    print(
        f"naive, 5 metrics: {naive_wall:.0f} s, {naive_cpu:.0f} CPU-s, extrapolated "
        f"from {2 * NAIVE_FRAMES} of {frame_count} frames: {ratio:.0f} times ours"
    )
    assert ratio >= 10
    assert max(one["memory"], two["memory"]) <= MEMORY
    assert two["bytes"] <= 1_000_000


def test_memory_does_not_grow_with_the_horizon(tmp_path: Path) -> None:
    """594 predicted frames (all 600 but the given six) take the memory of 90.

    Both have two scenarios, whose reference predictors are measured too: none are
    shipped for 594 frames.
    """
    memory = {}  # by predicted frames [bytes]
    for horizon in (90, 594):
        folder = tmp_path / str(horizon)
        folder.mkdir()
        make_score_data(
            folder,
            horizon=horizon,
            scenario_count=2,
            has_shipped_references=False,
        )
        costs = run_ours(folder, 1)
        memory[horizon] = costs["memory"]
        print(f"\n{horizon} frames: {costs['memory'] / 1e6:.0f} MB")
        print(f"{costs['cpu']:.1f} CPU-s, {costs['wall']:.1f} s")
    assert memory[594] <= 1.15 * memory[90]
