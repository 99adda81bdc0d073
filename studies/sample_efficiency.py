"""Error of trained networks against the number of training scenarios and of windows.

    python -m studies.sample_efficiency train --split cavity --baseline neuralmpm \
        --scenarios 3,6,12,24 --seeds 0,1 --root FOLDER --runs runs
    python -m studies.sample_efficiency draw

``train`` trains by the recipe of size mini on the first scenarios of ``train`` and adds
the validations to docs/figures/samples.csv: the ranking metric on ``valid`` after so
many windows. Finished trainings are kept, so an interrupted command can be repeated.
``draw`` makes docs/figures/samples.svg of the file.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path

from lagbench.baselines.train import train
from lagbench.data.registry import Registry, load
from lagbench.figures.canvas import figure, save
from lagbench.figures.colours import MUTED, SERIES

TABLE = Path("docs/figures/samples.csv")
PICTURE = Path("docs/figures/samples.svg")


@dataclass(frozen=True)
class TrainedError:
    """The error of a network on ``valid`` in the course of a training."""

    split: str
    model: str  # baseline, and the variant of its recipe
    scenarios: int  # of train that the network has seen
    seed: int
    windows: int  # seen up to this validation
    error: float  # the ranking metric


def with_scenarios(split: str, count: int) -> Registry:
    """Return the registry with the first scenarios of ``train`` only."""
    registry = load()
    entry = registry.splits[split]
    mini = entry.sizes["mini"]
    subsets = {**mini.subsets, "train": mini.subsets["train"][:count]}
    sizes = {**entry.sizes, "mini": mini.model_copy(update={"subsets": subsets})}
    splits = {**registry.splits, split: entry.model_copy(update={"sizes": sizes})}
    return Registry(splits, registry.measured, registry.files)


def train_all(options: argparse.Namespace) -> None:
    """Train each network that is missing; rewrite the table after each."""
    model = options.baseline
    if options.recipe:
        model = f"{model}-{options.recipe}"
    for seed in map(int, options.seeds.split(",")):
        for count in map(int, options.scenarios.split(",")):
            folder = options.runs / f"{options.split}-{model}-{count}-{seed}"
            result = train(
                options.baseline,
                options.split,
                "mini",
                recipe=options.recipe,
                settings=tuple(options.set),
                seed=seed,
                root=options.root,
                output=folder,
                device="cpu",
                threads=1,
                registry=with_scenarios(options.split, count),
            )
            log = json.loads((folder / "training.json").read_text())
            windows = log["windows_seen"] / log["steps"]  # a step
            rows = [
                TrainedError(
                    options.split,
                    model,
                    count,
                    seed,
                    round(each["step"] * windows),
                    each[log["metric"]],
                )
                for each in log["validation"]
            ]
            place = (options.split, model, count, seed)
            kept = [row for row in read_table() if place_of(row) != place]
            write_table([*kept, *rows])
            sys.stderr.write(f"{place}: {result.best_value}\n")


def place_of(row: TrainedError) -> tuple[str, str, int, int]:
    """Return what a training is told by."""
    return row.split, row.model, row.scenarios, row.seed


def read_table() -> list[TrainedError]:
    """Read the table; nothing where there is none."""
    if not TABLE.is_file():
        return []
    rows = []
    with TABLE.open(newline="") as file:
        for row in csv.DictReader(file):
            rows.append(
                TrainedError(
                    row["split"],
                    row["model"],
                    int(row["scenarios"]),
                    int(row["seed"]),
                    int(row["windows"]),
                    float(row["error"]),
                )
            )
    return rows


def write_table(rows: list[TrainedError]) -> None:
    """Write the table, sorted."""
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, TrainedError.__annotations__, lineterminator="\n")
        writer.writeheader()
        for row in sorted(rows, key=lambda row: (*place_of(row), row.windows)):
            writer.writerow({**asdict(row), "error": round(row.error, 5)})


def draw() -> None:
    """Draw a row of two panels for each split: over scenarios, and over windows."""
    trainings = defaultdict(list)
    for row in read_table():
        trainings[place_of(row)].append(row)
    splits = sorted({split for split, *_ in trainings})
    models = sorted({model for _, model, *_ in trainings})
    with figure(8.0, 2.9 * len(splits)) as drawn:
        panels = drawn.subplots(len(splits), 2, squeeze=False, sharey="row")
        for (over_scenarios, over_windows), split in zip(panels, splits, strict=True):
            for model, colour in zip(models, SERIES, strict=False):
                best = defaultdict(list)  # least errors by scenarios, one a seed
                for (place, name, count, _), rows in trainings.items():
                    if (place, name) == (split, model):
                        best[count].append(min(row.error for row in rows))
                if not best:
                    continue
                counts = sorted(best)
                means = [sum(best[count]) / len(best[count]) for count in counts]
                over_scenarios.plot(counts, means, "-", color=colour, label=model)
                for count in counts:
                    seeds = best[count]
                    over_scenarios.plot([count] * len(seeds), seeds, "o", color=colour)
                for (place, name, count, _), rows in trainings.items():
                    if (place, name, count) == (split, model, counts[-1]):
                        windows = [row.windows for row in rows]
                        errors = [row.error for row in rows]
                        over_windows.plot(windows, errors, "o-", color=colour)
            over_scenarios.set_xlabel("training scenarios")
            over_scenarios.set_ylabel(f"{split} mini: error on valid")
            over_windows.set_xlabel("windows seen, all scenarios")
            over_scenarios.legend(frameon=False)
            for axes in (over_scenarios, over_windows):
                axes.set_xscale("log")
                axes.set_yscale("log")
                axes.tick_params(colors=MUTED, which="both")
        drawn.tight_layout()
        save(drawn, PICTURE)


def main() -> int:
    """Train, or draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("draw")
    training = commands.add_parser("train")
    training.add_argument("--split", required=True)
    training.add_argument("--baseline", required=True)
    training.add_argument("--recipe")
    training.add_argument("--set", action="append", default=[])
    training.add_argument("--scenarios", default="3,6,12,24")
    training.add_argument("--seeds", default="0,1")
    training.add_argument("--root", type=Path)
    training.add_argument("--runs", type=Path, default=Path("runs/samples"))
    options = parser.parse_args()
    if options.command == "draw":
        draw()
    else:
        train_all(options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
