"""What the recipes of the graph networks rest on: loss terms at the start, and what a step costs.

    python benchmarks/operator_recipes.py --root DATA --size mini

prints for every split and operator the terms of the loss that count, times their weights, of the
untrained network on windows spread over train; the processor seconds of a training step on one
thread (the median of a few, without reading windows); and the steps of the recipe in minutes.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter
from pathlib import Path

import torch

from lagbench.baselines.baseline import Baseline, Batch
from lagbench.baselines.catalogue import find
from lagbench.baselines.facts import facts_of
from lagbench.baselines.machine import multiplies_bfloat16
from lagbench.baselines.recipe import Recipe, recipe_for
from lagbench.torch import WindowDataset, collate

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
OPERATORS = ("gns", "supergat", "gat", "gatv2", "pointnet", "transformer")
STEPS = 12
"""Steps that are taken; the first two are not timed."""


def batches(recipe: Recipe, model: Baseline, *, split: str, size: str, root: Path) -> list[Batch]:
    """Return one batch for every step, spread evenly over train."""
    data = WindowDataset(split, size=size, root=root, history=model.history, future=model.future)
    count = STEPS * recipe.training.batch
    windows = [data[index * len(data) // count] for index in range(count)]
    return [collate(windows[step::STEPS]) for step in range(STEPS)]


def steps(recipe: Recipe, model: Baseline, given: list[Batch]) -> tuple[dict[str, float], float]:
    """Return the terms at the start, weighted, and the seconds of a step."""
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0)  # the network stays untrained
    generator = torch.Generator().manual_seed(0)
    half = recipe.training.precision == "bf16" or (
        recipe.training.precision == "auto" and multiplies_bfloat16("cpu")
    )
    totals: Counter[str] = Counter()
    seconds = []
    for batch in given:
        started = time.process_time()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            terms = model(batch, generator)
        weighted = {name: model.weights.get(name, 1.0) * value for name, value in terms.items()}
        optimizer.zero_grad()
        torch.stack(list(weighted.values())).sum().backward()
        optimizer.step()
        seconds.append(time.process_time() - started)
        totals.update({name: float(value.detach()) / len(given) for name, value in weighted.items()})
    return {name: value for name, value in totals.items() if value}, statistics.median(seconds[2:])


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
        "| split | operator | terms at the start | s per step | steps | minutes |\n|---|---|---|---|---|---|"
    )
    for split in given.split:
        facts = facts_of(split, given.size, root=given.root)
        for name in given.operator:
            recipe = recipe_for(find(name), split, given.size, variant=given.recipe)
            torch.manual_seed(0)
            model = find(name).model.build(recipe.model, facts)
            windows = batches(recipe, model, split=split, size=given.size, root=given.root)
            terms, seconds = steps(recipe, model, windows)
            said = ", ".join(f"{term} {value:.3g}" for term, value in terms.items())
            count = recipe.training.steps or 0
            print(
                f"| {split} | {name} | {said} | {seconds:.3f} | {count} | {count * seconds / 60:.1f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
