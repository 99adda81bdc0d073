"""Pretended runs on the tiny cavity, for tests of reproduction scripts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from score_bench import Floats, Predict, ScoreBench

from lagbench.baselines.reproduce.method import Method, Seeded
from lagbench.metrics import METRICS, Score

SPLIT, SIZE = "cavity", "tiny"

NOISE = {
    "supergat": 0.0,
    "gat": 1e-4,
    "gns": 2e-4,
    "gns-novorticity": 4e-4,
    "gatv2": 6e-4,
    "pointnet": 8e-4,
    "transformer": 1e-3,
}
"""Deviation of what is added to the truth by each pretended model [length]."""

RECORD = {
    "parameters": 123,
    "cpu_seconds": 7200.0,
    "step": 40,
    "best_step": 30,
    "windows": 100,
    "recipe": {"name": "cavity/tiny", "training": {"batch": 2}},
    "hardware": {"device": "cpu", "processor": "a core", "threads": 1},
}
"""What a pretended training recorded."""

SCORED = ("vorticity_rmse", "vorticity_pearson", "mse_avg", "mse_end", "position_rmse", "energy_error")


def a_score(values: list[float], metric: str = "vorticity_rmse") -> Score:
    """Return a score with values over the horizon, the same at its only frame."""
    held = np.array(values)
    ids = tuple(range(len(values)))
    return Score(METRICS[metric], ids, (54,), held[:, None], held, (0,) * len(values))


def a_method(name: str, *seeds: list[float]) -> Method:
    """Return a model whose every metric has these values, one list per seed."""
    record = {"cpu_seconds": 1800.0}
    held = [
        Seeded(seed=i, scores={m: a_score(values, m) for m in SCORED}, record=record, path=Path())
        for i, values in enumerate(seeds)
    ]
    return Method(name=name, seeds=tuple(held))


def noisy(noise: float) -> Predict:
    """Return a model that knows the truth, with noise."""
    draw = np.random.default_rng(0)

    def predict(truth: Floats, n: int, h: int) -> Floats:
        held = truth[n : n + h]
        return np.asarray(np.clip(held + noise * draw.standard_normal(held.shape), 0.0, 1.0))

    return predict


def pretend(bench: ScoreBench, folder: Path) -> Path:
    """Write scored runs of six operators and a variant that nobody trained."""
    for name, noise in NOISE.items():
        home = folder / SPLIT / SIZE / f"{name}-0"
        home.mkdir(parents=True)
        bench.score(bench.submit(home / "predictions.nc", noisy(noise), method=name))
        (home / "training.json").write_text(json.dumps(RECORD))
        (home / "predictions.json").write_text(json.dumps({"seconds_per_frame": 0.5, "device": "a core"}))
    return folder
