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
import sys
import time
from collections import defaultdict
from pathlib import Path

import torch

from lagbench.baselines.baseline import Baseline
from lagbench.baselines.catalogue import find
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.machine import multiplies_bfloat16
from lagbench.baselines.recipe import Recipe, recipe_for
from lagbench.errors import LagbenchError
from lagbench.torch import WindowDataset, collate

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
OPERATORS = ("gns", "supergat", "gat", "gatv2", "pointnet", "transformer")
WINDOWS = 120
"""Windows whose terms are averaged.

On the free surface a few violent ones make most of the mean.
"""

STEPS = 12
"""Steps that are taken; the first two are not timed."""


def uses_bfloat16(recipe: Recipe) -> bool:
    """Return whether a recipe multiplies in bfloat16 here."""
    precision = recipe.training.precision
    if precision == "auto":
        return multiplies_bfloat16("cpu")
    return precision == "bf16"


def mean_terms(
    recipe: Recipe, model: Baseline, data: WindowDataset
) -> dict[str, float]:
    """Return the weighted terms of the loss at the start that are not 0.

    They are means over windows spread over train.
    """
    generator = torch.Generator().manual_seed(0)
    totals: defaultdict[str, float] = defaultdict(float)
    stride = max(1, len(data) // WINDOWS)
    places = range(0, len(data), stride)
    is_rounded = uses_bfloat16(recipe)
    for index in places:
        window = collate([data[index]])
        with (
            torch.no_grad(),
            torch.autocast("cpu", torch.bfloat16, enabled=is_rounded),
        ):
            raw_terms = model(window, generator)
        for name, value in raw_terms.items():
            weight = model.weights.get(name, 1.0)
            totals[name] += weight * float(value)
    means = {}
    for name, total in totals.items():
        if total:
            means[name] = total / len(places)
    return means


def step_seconds(recipe: Recipe, model: Baseline, data: WindowDataset) -> float:
    """Return the processor seconds of a step."""
    batch = recipe.training.batch
    stride = len(data) // (STEPS * batch)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    generator = torch.Generator().manual_seed(0)
    is_rounded = uses_bfloat16(recipe)
    seconds = []
    for step in range(STEPS):
        samples = []
        for place in range(batch):
            number = step + STEPS * place
            samples.append(data[number * stride])
        windows = collate(samples)
        start = time.process_time()
        with torch.autocast("cpu", torch.bfloat16, enabled=is_rounded):
            raw_terms = model(windows, generator)
        weighted_terms = []
        for name, value in raw_terms.items():
            weight = model.weights.get(name, 1.0)
            weighted_terms.append(weight * value)
        loss = torch.stack(weighted_terms).sum()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds[2:])


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
    options = parser.parse_args()
    entries = [find(name) for name in options.operator]
    torch.set_num_threads(1)
    print(
        "| split | operator | terms at the start | s per step | steps | minutes "
        "|\n|---|---|---|---|---|---|"
    )
    for split in options.split:
        info = read_dataset_info(split, options.size, root=options.root)
        for entry in entries:
            recipe = recipe_for(entry, split, options.size, variant=options.recipe)
            torch.manual_seed(0)
            model = entry.model.build(recipe.model, info)
            data = WindowDataset(
                split,
                size=options.size,
                root=options.root,
                history=model.history,
                future=model.future,
            )
            terms = []
            for term, value in mean_terms(recipe, model, data).items():
                terms.append(f"{term} {value:.2g}")
            cost = step_seconds(recipe, model, data)
            count = recipe.training.steps or 0
            minutes = count * cost / 60
            print(
                f"| {split} | {entry.name} | {', '.join(terms)} | {cost:.3f} | "
                f"{count} | {minutes:.1f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"operator_recipes: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
