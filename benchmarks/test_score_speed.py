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
import json, resource, sys, time
from pathlib import Path
import lagbench.scoring.score, netCDF4
from lagbench.data.registry import load
folder, workers = Path(sys.argv[1]), int(sys.argv[2])
who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
peak = lambda: int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
cpu = lambda: sum(sum(resource.getrusage(one)[:2]) for one in who)
wall, used = time.perf_counter(), cpu()
card = lagbench.scoring.score.score(folder / "predictions.nc", root=folder / "root",
                              registry=load(folder / "datasets.yaml"), workers=workers)
print(json.dumps({
    "wall": time.perf_counter() - wall,
    "cpu": cpu() - used,
    # the maximum that getrusage tells of this process is that of its parent before exec
    "memory": 1024 * max(peak(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss),
    "metrics": len(card.submission),
    "bytes": card.files[1].stat().st_size,
}))
"""


def run_ours(folder: Path, workers: int) -> dict[str, float]:
    """Score in a fresh process; return its time, processor time and memory."""
    return dict(measured_apart("-c", CHILD, str(folder), str(workers)))


def naive_scores(
    truth: Path, predictions: Path, row: int, first: int, frames: int
) -> dict[str, float]:
    """Return five metrics of one scenario, means over frames.

    Args:
        truth: scenario file.
        predictions: predictions.nc.
        row: row of the scenario in it.
        first: absolute number of the first predicted frame.
        frames: frames to score.
    """
    with h5py.File(truth) as file:
        true = np.asarray(file["position"][first - 1 : first + frames], np.float64)
    with h5py.File(predictions) as file:
        guess = np.asarray(file["position"][row, :frames], np.float64)
    guess = np.concatenate([true[:1], guess])
    found = [
        _frame(true[f - 1], true[f], guess[f - 1], guess[f])
        for f in range(1, frames + 1)
    ]
    return {name: float(np.mean([one[name] for one in found])) for name in found[0]}


def _frame(
    true_before: Floats, true: Floats, guess_before: Floats, guess: Floats
) -> dict[str, float]:
    t = _vorticity(true, true - true_before)
    p = _vorticity(guess, guess - guess_before)
    known = np.isfinite(t) & np.isfinite(p)
    t = t[known]
    p = p[known]
    return {
        "position_mse": float(np.mean((guess - true) ** 2)),
        "vorticity_mse": float(np.mean((p - t) ** 2)),
        "vorticity_mae": float(np.mean(np.abs(p - t))),
        "vorticity_pearson": float(pearsonr(t, p).statistic),
        "vorticity_kl": float(entropy(np.abs(t) + 1e-10, np.abs(p) + 1e-10)),
    }


def _vorticity(x: Floats, u: Floats) -> Floats:
    axis = (np.arange(CELLS) + 0.5) / CELLS
    nodes = tuple(np.meshgrid(axis, axis, indexing="ij"))
    field = griddata(x, u, nodes, method="cubic")
    return np.gradient(field[..., 1], 1 / CELLS, axis=0) - np.gradient(
        field[..., 0], 1 / CELLS, axis=1
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ScoreData:
    """Twenty scenarios of 90 frames."""
    return make_score_data(tmp_path_factory.mktemp("short"))


def test_score_beside_a_naive_scorer(data: ScoreData) -> None:
    """All metrics take a tenth of the time of five naive ones, or less."""
    folder = data.predictions.parent
    one = run_ours(folder, 1)
    two = run_ours(folder, 2)
    task = load_scored_task(data.registry.size("cavity", "full"), data.root)
    start = time.perf_counter()
    used = time.process_time()
    for row, scenario in enumerate(task.scenarios[:2]):
        naive_scores(task.truth.path(scenario), data.predictions, row, 6, NAIVE_FRAMES)
    frames = len(task.scenarios) * 90
    scale = frames / (2 * NAIVE_FRAMES)
    naive = {
        "wall": scale * (time.perf_counter() - start),
        "cpu": scale * (time.process_time() - used),
    }
    for name, found in (("one worker", one), ("two workers", two)):
        print(
            f"\n{name}: {found['wall']:.2f} s, {found['cpu']:.2f} CPU-s, "
            f"{found['memory'] / 1e6:.0f} MB,"
            f" {found['metrics']} metrics, scores.nc {found['bytes'] / 1e3:.0f} kB"
            f" (targets {MEMORY / 1e6:.0f} MB, 1 MB)"
        )
    # Idle BLAS threads count as processor time of the naive side, other processes as
    # its wall time.
    ratio = min(naive["cpu"], naive["wall"]) / one["cpu"]
    print(
        f"naive, 5 metrics: {naive['wall']:.0f} s, {naive['cpu']:.0f} CPU-s,"
        f" extrapolated from {2 * NAIVE_FRAMES} of {frames} frames: {ratio:.0f} "
        f"times ours"
    )
    assert ratio >= 10
    assert max(one["memory"], two["memory"]) <= MEMORY
    assert two["bytes"] <= 1_000_000


def test_memory_does_not_grow_with_the_horizon(data: ScoreData, tmp_path: Path) -> None:
    """594 predicted frames (all 600 but the given six) take the memory of 90."""
    short = run_ours(data.predictions.parent, 1)
    long = run_ours(make_score_data(tmp_path, horizon=594).predictions.parent, 1)
    print(
        f"\n90 frames: {short['memory'] / 1e6:.0f} MB, {short['cpu']:.1f} CPU-s;"
        f" 594 frames: {long['memory'] / 1e6:.0f} MB, {long['cpu']:.1f} CPU-s, "
        f"{long['wall']:.1f} s"
    )
    assert long["memory"] <= min(MEMORY, 1.15 * short["memory"])
