"""The golden set: the numbers that a rewrite must not change.

Record them anew, with a commit that says why they changed:

    python tests/golden.py --record
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

GOLDEN_FILE = Path(__file__).parent / "data" / "golden.json"
QUICK_SPLITS = ("curl-noise", "fluid")
"""The splits whose tiny data every test run generates."""

# Facts about a machine, a moment or a folder.
VOLATILE = {
    *("bytes", "folder", "path", "picture", "present", "root", "seconds", "measured"),
    *("cost", "cost_source", "device", "predictions_sha256", "sha256"),
}

Floats = NDArray[np.float64]
Json = Any


def run_lagbench(*words: object, root: Path) -> Json:
    """Run a command with --json; return what it prints."""
    from lagbench.cli.program import app

    environment = {"LAGBENCH_ROOT": str(root), "OMP_NUM_THREADS": "1"}
    with (
        mock.patch.dict(os.environ, environment),
        redirect_stdout(io.StringIO()) as stdout,
    ):
        app([*map(str, words), "--json"])
    return json.loads(stdout.getvalue())


def without_volatile(value: Json) -> Json:
    """Return the value without the fields that differ between machines."""
    if isinstance(value, dict):
        kept = {}
        for key in sorted(value.keys() - VOLATILE):
            kept[key] = without_volatile(value[key])
        return kept
    if isinstance(value, list):
        return [without_volatile(item) for item in value]
    return value


def digest(value: Json) -> str:
    """Return the SHA-256 of a value's JSON, keys sorted."""
    text = json.dumps(value, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def dataset_hash(split: str, root: Path) -> str:
    """Generate the tiny data of a split; return their hash."""
    import lagbench

    return lagbench.generate(split, "tiny", root=root, workers=1).dataset_sha256


@functools.cache
def _true_positions(split: str, root: Path) -> dict[int, Floats]:
    """Return the positions [frame, particle, space] of each test scenario of tiny."""
    import lagbench

    test = lagbench.open_split(split, subset="test", size="tiny", root=root)
    positions = {}
    for scenario in test.scenario.values:
        rows = test.position.sel(scenario=scenario).values
        known = ~np.isnan(rows[0, :, 0])
        positions[int(scenario)] = rows[:, known].astype(np.float64)
    return positions


def _at_rest(truth: Floats, given: int) -> Floats:
    return np.broadcast_to(truth[given - 1], truth[given:].shape)


def _constant_velocity(truth: Floats, given: int) -> Floats:
    steps = np.arange(1, len(truth) - given + 1)[:, None, None]
    straight = truth[given - 1] + steps * (truth[given - 1] - truth[given - 2])
    return np.clip(straight, truth.min(axis=(0, 1)), truth.max(axis=(0, 1)))


def _slowed(truth: Floats, given: int) -> Floats:
    return 0.9 * truth[given:] + 0.1 * truth[given - 1]


PREDICTIONS = {
    "at-rest": ("curl-noise", _at_rest),
    "constant-velocity": ("curl-noise", _constant_velocity),
    "slowed": ("curl-noise", _slowed),
    "fluid-constant-velocity": ("fluid", _constant_velocity),
    "fluid-slowed": ("fluid", _slowed),
}


def write_prediction(name: str, root: Path, folder: Path) -> Path:
    """Write a predictions.nc of tiny data; it follows from the data alone."""
    import lagbench
    from lagbench.data.registry import load

    split, predict = PREDICTIONS[name]
    task = load().size(split, "tiny").task
    given, horizon = task.input_frames, task.horizon
    positions = {}
    for scenario, truth in _true_positions(split, root).items():
        positions[scenario] = predict(truth[: given + horizon], given)
    return lagbench.submission.write(
        folder / f"{name}.nc",
        positions,
        split=split,
        size="tiny",
        method=name,
        root=root,
    )


def _means(row: Json) -> Json:
    """Return the mean of each metric that is defined."""
    means = {}
    for metric, value in row.items():
        if value["mean"] is not None:
            means[metric] = value["mean"]
    return means


def score(path: Path, root: Path) -> Json:
    """Score predictions; return the means of the method's and references' metrics."""
    card = run_lagbench("score", path, root=root)
    ranking_metric = card["ranking_metric"]
    references = {}
    for name, row in sorted(card["rows"].items()):
        references[name] = row[ranking_metric]["mean"]
    return {
        "ranking_metric": ranking_metric,
        "skill": card["skill"],
        "metrics": _means(card["rows"]["submission"]),
        "references": references,
    }


def board_rows(root: Path) -> Json:
    """Return the first numbers of every row of the leaderboard."""
    rows = {}
    for tab in run_lagbench("leaderboard", "show", root=root)["tabs"]:
        ranking_metric = tab["ranking_metric"]
        for row in tab["references"] + tab["rows"]:
            facts = {
                "kind": row["kind"],
                "score": row["metrics"][ranking_metric],
                "metrics": digest(row["metrics"]),
            }
            for key in ("rank", "rank_range", "skill", "cost", "verified"):
                if key in row:
                    facts[key] = row[key]
            rows[f"{tab['split']}/{tab['size']}/{row['id']}"] = facts
    return rows


def train(root: Path, folder: Path) -> Json:
    """Train NeuralMPM for 50 steps; return its losses."""
    run = run_lagbench(
        *("train", "curl-noise", "--baseline", "neuralmpm", "--size", "tiny"),
        *("--set", "training.steps=50", "--seed", "1", "--device", "cpu"),
        *("--output", folder / "run"),
        root=root,
    )
    weights = _weights_of(Path(run["weights"]))
    sums = {}
    hashed = hashlib.sha256()
    for name, array in sorted(weights.items()):
        sums[name] = float(np.abs(array, dtype=np.float64).sum())
        hashed.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return {
        "processor": _processor(),
        "loss": run["loss"]["total"],
        "best_value": run["best_value"],
        "best_step": run["best_step"],
        "weight_sums": sums,
        "weights_sha256": hashed.hexdigest(),
    }


def _weights_of(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a weights file, whichever format it has."""
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        tensors = load_file(path)
    else:
        import torch

        tensors = torch.load(path, weights_only=True)["weights"]
    return {name: tensor.float().numpy() for name, tensor in tensors.items()}


def _processor() -> str:
    """Say which arithmetic torch uses: elsewhere the last bits differ."""
    import torch

    return f"torch {torch.__version__} {torch.backends.cpu.get_cpu_capability()}"


def command_outputs(root: Path, folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield each main command and what it prints, without volatile fields."""
    slowed = write_prediction("slowed", root, folder)
    straight = write_prediction("constant-velocity", root, folder)
    yield "list", digest(without_volatile(run_lagbench("list", root=root)))
    for split in QUICK_SPLITS:
        output = run_lagbench("info", split, root=root)
        yield f"info {split}", digest(without_volatile(output))
    yield "validate", without_volatile(run_lagbench("validate", slowed, root=root))
    yield (
        "compare",
        without_volatile(run_lagbench("compare", slowed, straight, root=root)),
    )


def record(root: Path, folder: Path) -> Json:
    """Return the whole golden set."""
    import lagbench

    hashes = {}
    for split in lagbench.list_splits():
        hashes[split] = dataset_hash(split, root)
    return {
        "datasets": hashes,
        "scores": {
            name: score(write_prediction(name, root, folder / "scores"), root)
            for name in PREDICTIONS
        },
        "training": train(root, folder),
        "commands": dict(command_outputs(root, folder)),
        "board": board_rows(root),
    }


def main() -> None:
    """Record the golden set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", action="store_true", required=True)
    parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "scores").mkdir()
        golden_set = record(folder / "root", folder)
    GOLDEN_FILE.write_text(json.dumps(golden_set, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
