"""What the recipes of the graph networks rest on: loss terms at the start, and what a
step costs.

    python benchmarks/operator_recipes.py --root DATA --size mini

prints for every split and operator the terms of the loss that count, times their
weights, of the untrained network on windows spread over train; the processor seconds of
a training step on one thread (the median of a few, without reading windows); and the
steps of the recipe in minutes.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter
from pathlib import Path

import torch

from lagbench.baselines.baseline import Baseline
from lagbench.baselines.catalogue import find
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.machine import multiplies_bfloat16
from lagbench.baselines.recipe import Recipe, recipe_for
from lagbench.torch import WindowDataset, collate

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
OPERATORS = ("gns", "supergat", "gat", "gatv2", "pointnet", "transformer")
WINDOWS = 120
"""Windows whose terms are averaged; a few violent ones make most of the mean on the
free surface.
"""

STEPS = 12
"""Steps that are taken; the first two are not timed."""


def half(recipe: Recipe) -> bool:
    """Return whether a recipe multiplies in bfloat16 here."""
    wanted = recipe.training.precision
    return wanted == "bf16" or (wanted == "auto" and multiplies_bfloat16("cpu"))


def terms(recipe: Recipe, model: Baseline, data: WindowDataset) -> dict[str, float]:
    """Return the weighted terms at the start that count, means over windows spread over
    train.
    """
    generator = torch.Generator().manual_seed(0)
    totals: Counter[str] = Counter()
    places = range(0, len(data), max(1, len(data) // WINDOWS))
    for index in places:
        with (
            torch.no_grad(),
            torch.autocast("cpu", torch.bfloat16, enabled=half(recipe)),
        ):
            found = model(collate([data[index]]), generator)
        totals.update(
            {
                name: model.weights.get(name, 1.0) * float(value)
                for name, value in found.items()
            }
        )
    return {name: value / len(places) for name, value in totals.items() if value}


def seconds(recipe: Recipe, model: Baseline, data: WindowDataset) -> float:
    """Return the processor seconds of a step."""
    batch = recipe.training.batch
    stride = len(data) // (STEPS * batch)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    generator = torch.Generator().manual_seed(0)
    found = []
    for step in range(STEPS):
        windows = collate(
            [data[(step + STEPS * place) * stride] for place in range(batch)]
        )
        started = time.process_time()
        with torch.autocast("cpu", torch.bfloat16, enabled=half(recipe)):
            raw = model(windows, generator)
        optimizer.zero_grad()
        torch.stack(
            [model.weights.get(name, 1.0) * value for name, value in raw.items()]
        ).sum().backward()
        optimizer.step()
        found.append(time.process_time() - started)
    return statistics.median(found[2:])


def main() -> int:
    """Print a row for each split and operator."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--size", default="mini")
    parser.add_argument("--recipe", help="variant of the recipe")
    parser.add_argument("--split", choices=SPLITS, nargs="*", default=SPLITS)
    parser.add_argument("--operator", nargs="*", default=OPERATORS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| split | operator | terms at the start | s per step | steps | minutes "
        "|\n|---|---|---|---|---|---|"
    )
    for split in given.split:
        facts = read_dataset_info(split, given.size, root=given.root)
        for name in given.operator:
            recipe = recipe_for(find(name), split, given.size, variant=given.recipe)
            torch.manual_seed(0)
            model = find(name).model.build(recipe.model, facts)
            data = WindowDataset(
                split,
                size=given.size,
                root=given.root,
                history=model.history,
                future=model.future,
            )
            said = ", ".join(
                f"{term} {value:.2g}"
                for term, value in terms(recipe, model, data).items()
            )
            cost = seconds(recipe, model, data)
            count = recipe.training.steps or 0
            print(
                f"| {split} | {name} | {said} | {cost:.3f} | {count} | "
                f"{count * cost / 60:.1f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
