"""Make the tables of the thesis at one size: train, predict, score, compare.

    python -m studies.thesis --table 5.4 --size mini --root DATA --runs runs

Prints the table as CSV, our values beside the thesis's. Complete runs are kept, so an
interrupted command can be repeated. The figures of the thesis (fields, histograms and
residuals of the vorticity, curves over frames) are those of ``lagbench score --report``
with the predictions that this command leaves in the folder of runs.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .published import (
    FRAME_MODELS,
    MEASURES,
    MLP_STUDIES,
    OPERATORS,
    TABLE_4_8,
    TABLE_5_4,
    MLPStudy,
)

Row = dict[str, object]
MOST_WINDOWS = 4096
"""Windows of a subset, evenly spread, that the error of one step is measured on."""


@dataclass(frozen=True)
class Place:
    """Where the data and the runs of one size lie."""

    size: str
    root: Path
    runs: Path
    seed: int

    def folder(self, split: str, name: str) -> Path:
        """The folder of a run."""
        return self.runs / split / self.size / f"{name}-{self.seed}"


def lagbench(*words: object) -> Any:  # noqa: ANN401 (JSON)
    """Run a command; return the JSON that it prints."""
    command = [sys.executable, "-m", "lagbench", *map(str, words), "--json"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout)


def train(place: Place, split: str, baseline: str, recipe: str | None = None) -> Path:
    """Train a model; return its weights. A finished training is kept."""
    folder = place.folder(split, recipe or baseline)
    record = folder / "training.json"
    if not record.is_file() or json.loads(record.read_text())["state"] != "finished":
        words: list[object] = ["train", split, "--baseline", baseline]
        words += ["--size", place.size, "--seed", place.seed, "--output", folder]
        words += ["--root", place.root]
        if recipe is not None:
            words += ["--recipe", recipe]
        lagbench(*words)
    return folder / "weights.safetensors"


def scores_of(place: Place, split: str, baseline: str) -> dict[str, Any]:
    """Return the metrics of a model on test; what is missing is trained and scored."""
    weights = train(place, split, baseline)
    scores = weights.with_name("scores.json")
    if not scores.is_file():
        predictions = weights.with_name("predictions.nc")
        if not predictions.is_file():
            lagbench(
                *("predict", weights, "--output", predictions, "--root", place.root)
            )
        lagbench(
            *("score", predictions, "--output", weights.parent, "--root", place.root)
        )
    metrics: dict[str, Any] = json.loads(scores.read_text())["rows"]["submission"]
    return metrics


def one_step_error(place: Place, split: str, weights: Path, subset: str) -> float:
    """Return the mean of Eq. 4.16 over windows of a subset [standardised^2]."""
    import torch

    from lagbench.baselines.checkpoint import load, restore
    from lagbench.tensors import collate
    from lagbench.torch import WindowDataset

    model = restore(load(weights)).eval()
    data = WindowDataset(
        split, place.size, subset=subset, root=place.root, history=model.history
    )
    count = min(len(data), MOST_WINDOWS)
    total = 0.0
    with torch.no_grad():
        for i in range(count):
            terms = model(collate([data[i * len(data) // count]]))
            total += float(terms["position"] + terms["velocity"]) / 2.0
    return total / count


def recipe_of(study: MLPStudy) -> str:
    """Return the recipe of a row of Tables 4.2 to 4.5.

    >>> recipe_of(MLP_STUDIES[0])
    'table-4.2-sigmoid'
    """
    distinctions = {
        "4.2": study.activation,
        "4.3": study.widths[0],
        "4.4": len(study.widths),
        "4.5": study.row,
    }
    return f"table-{study.table}-{distinctions[study.table]}"


def mlp_table(place: Place, table: str) -> Iterator[Row]:
    """Yield Tables 4.2 to 4.5: errors of one step of MLPs from frame to frame."""
    split = "fluid" if table < "4.4" else "multimaterial"
    for study in MLP_STUDIES:
        if study.table == table:
            weights = train(place, split, "mlp", recipe_of(study))
            yield {
                "row": study.row,
                "layers": " ".join(map(str, study.widths)),
                "activation": study.activation,
                "train": one_step_error(place, split, weights, "train"),
                "train, thesis": study.train,
                "valid": one_step_error(place, split, weights, "valid"),
                "valid, thesis": study.valid,
            }


def rollout_table(place: Place) -> Iterator[Row]:
    """Yield Table 4.8: rollouts of the frame models; the thesis has single scenarios.

    Ours are means over all test scenarios.
    """
    for split, thesis_rows in TABLE_4_8.items():
        for i, model in enumerate(FRAME_MODELS):
            metrics = scores_of(place, split, model)
            for row in thesis_rows:
                yield {
                    "split": split,
                    "model": model,
                    "scene of the thesis": row.scene,
                    "average": metrics["mse_avg"]["mean"],
                    "average, thesis": row.average[i],
                    "end": metrics["mse_end"]["mean"],
                    "end, thesis": row.end[i],
                }


def vorticity_table(place: Place) -> Iterator[Row]:
    """Yield Table 5.4: vorticity of the cavity at frame 54, six graph operators.

    Ours are means over all test scenarios; the thesis has one. At tiny the frame is the
    last that was scored.
    """
    for operator in OPERATORS:
        metrics = scores_of(place, "cavity", operator)
        row: Row = {"model": operator}
        for measure in MEASURES:
            at_frames = metrics[f"vorticity_{measure}"]["at"]
            frame = "54" if "54" in at_frames else max(at_frames, key=int)
            row[measure] = at_frames[frame]["mean"]
            row[f"{measure}, thesis"] = TABLE_5_4[operator][measure]
        yield row


def main() -> int:
    """Print one table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tables = ("4.2", "4.3", "4.4", "4.5", "4.8", "5.4")
    parser.add_argument("--table", choices=tables, required=True)
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    place = Place(options.size, options.root, options.runs, options.seed)
    if options.table == "4.8":
        rows = list(rollout_table(place))
    elif options.table == "5.4":
        rows = list(vorticity_table(place))
    else:
        rows = list(mlp_table(place, options.table))
    writer = csv.DictWriter(sys.stdout, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
