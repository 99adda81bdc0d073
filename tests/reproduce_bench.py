"""Pretended models and runs on the cavity, for tests of reproduction."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from score_bench import Floats, Predict, ScoreBench

from lagbench.metrics import METRICS, Score
from studies.thesis.split_results import Method, ScoredTraining, Sources, SplitResults

SPLIT = "cavity"
SIZE = "tiny"

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
    "windows": 100,
    "recipe": {"name": "cavity/tiny", "training": {"batch": 2}},
    "hardware": {"device": "cpu", "processor": "a core", "threads": 1},
    "validation": [
        {"step": 10, "rmse": 4.0},
        {"step": 20, "rmse": 2.0},
        {"step": 40, "rmse": 0.5},
    ],
}
"""What a pretended training recorded."""


def a_score(values: list[float], metric: str) -> Score:
    """Return a score with these values over the horizon and at its only frame, 54."""
    scenario_values = np.array(values)
    return Score(
        METRICS[metric],
        tuple(range(len(values))),
        (54,),
        scenario_values[:, None],
        scenario_values,
        (0,) * len(values),
    )


def a_method(name: str, *seeds: list[float]) -> Method:
    """Return a model whose every metric has these values, one list per seed."""
    trainings = []
    for seed, values in enumerate(seeds):
        scores = {metric: a_score(values, metric) for metric in METRICS}
        trainings.append(
            ScoredTraining(seed=seed, scores=scores, record={}, path=Path())
        )
    return Method(name=name, trainings=tuple(trainings))


def made_up_results(models: Mapping[str, list[float]]) -> SplitResults:
    """Return results of the mini cavity: models and baselines of one seed each."""
    results = SplitResults(Sources(board=None), SPLIT, "mini")
    results.methods = {name: a_method(name, values) for name, values in models.items()}
    return results


def noisy(noise: float) -> Predict:
    """Return a model that predicts the truth with noise."""
    draw = np.random.default_rng(0)

    def predict(truth: Floats, n: int, h: int) -> Floats:
        future = truth[n : n + h]
        noisy_future = future + noise * draw.standard_normal(future.shape)
        return np.asarray(np.clip(noisy_future, 0.0, 1.0))

    return predict


def pretend(bench: ScoreBench, folder: Path) -> Path:
    """Write scored runs of six operators and a variant that nobody trained."""
    for name, noise in NOISE.items():
        home = folder / SPLIT / SIZE / f"{name}-0"
        home.mkdir(parents=True)
        bench.score(bench.submit(home / "predictions.nc", noisy(noise), method=name))
        (home / "training.json").write_text(json.dumps(RECORD))
        (home / "predictions.json").write_text(
            json.dumps({"seconds_per_frame": 0.5, "device": "a core"})
        )
    return folder


def markdown_rows(text: str, head: str) -> list[dict[str, str]]:
    """Return the rows of the first Markdown table that has a column of this name."""
    lines = iter(text.splitlines())
    for line in lines:
        heads = [cell.strip() for cell in line.strip("| ").split(" | ")]
        if line.startswith("|") and head in heads:
            next(lines)
            rows = []
            for row in lines:
                if not row.startswith("|"):
                    return rows
                cells = [cell.strip() for cell in row.strip("| ").split(" | ")]
                rows.append(dict(zip(heads, cells, strict=True)))
            return rows
    raise AssertionError(f"no table with a column {head}")
