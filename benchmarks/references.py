"""Print the shipped scores of the reference predictors as Markdown.

    python benchmarks/references.py [--data cavity/full ...] [--each]

``python -m lagbench.scoring.measure_references`` measures these scores. The first table
has the best naive baseline and the best classical solver of each data set at mini and
full. The second table has a row for each data set and reference predictor: its kind
(naive or classical), the ranking metric with its 95 % interval over test scenarios, the
correlation of vorticity at frame 54 (tiny: the last), the CPU time of a frame, and that
time over the time of a frame of our solver. The best naive baseline is marked.

The third table says whether the full boxes can be won without learning: the share of
test scenarios in which the frozen field correlates below 0.8 at that frame, and its
median relative error of the vorticity. The fourth says how long the truth of the free
surfaces moves. Exits with 1 where, at full or mini, that share is below 75 %, or the
median error of the cavity below 0.8. ``frozen_field.py`` measures the same from the
data.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping

import numpy as np

from lagbench.data.registry import Size, load
from lagbench.errors import LagbenchError, UsageError
from lagbench.metrics.table import ranking_metric
from lagbench.references import ReferenceScores, shipped
from lagbench.references.shipped import solver_seconds
from lagbench.references.table import NAIVE, REFERENCES
from lagbench.scoring.skill import best_reference

FALLEN = 0.8
SHARE = 0.75
ERROR = 0.8
ACCEPTED = ("full", "mini")


def main() -> int:
    """Print the tables; return whether every task is hard enough."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", nargs="+", metavar="SPLIT/SIZE")
    parser.add_argument(
        "--each",
        action="store_true",
        help="correlation of the frozen field by scenario",
    )
    options = parser.parse_args()
    registry = load()
    names = options.data
    if not names:
        names = []
        for split, description in registry.splits.items():
            for size_name in description.sizes:
                names.append(f"{split}/{size_name}")

    measured = []
    for name in names:
        split, slash, size_name = name.partition("/")
        if not slash:
            raise UsageError(
                "not the name of a data set",
                where="--data",
                expected="a split and a size, as in cavity/full",
                got=repr(name),
                fix=f"name a size of the split too: {name}/mini",
            )
        size = registry.size(split, size_name)
        references = shipped(size)
        if references:
            measured.append((size, references))

    print(
        "| data set | best naive baseline | best classical solver |\n|---|---|---|",
    )
    for size, references in measured:
        if size.name in ACCEPTED:
            _print_best(size, references)
    print(
        "\n| data set | predictor | kind | ranking metric | 95 % interval "
        "| correlation | seconds per frame | times the solver |"
    )
    print("|---|---|---|---:|---:|---:|---:|---:|")
    for size, references in measured:
        _print_references(size, references)
    print(
        "\n| data set | test scenarios below 0.8 | median correlation | median error "
        "|\n|---|---:|---:|---:|"
    )
    are_hard_enough = []
    for size, references in measured:
        is_hard_enough = _print_hardness(size, references, each=options.each)
        are_hard_enough.append(is_hard_enough)
    print(
        "\n| data set | active frames, median | least | greatest | predicted frames "
        "|\n|---|---:|---:|---:|---:|"
    )
    for size, references in measured:
        _print_active(size, references)
    if all(are_hard_enough):
        return 0
    return 1


def _print_best(size: Size, references: Mapping[str, ReferenceScores]) -> None:
    """Print the best predictor of each kind with its score."""
    ranking = ranking_metric(size)
    naive_scores = {}
    classical_scores = {}
    for name, reference in references.items():
        if name in NAIVE:
            naive_scores[name] = reference.scores[ranking]
        else:
            classical_scores[name] = reference.scores[ranking]

    cells = []
    for scores in (naive_scores, classical_scores):
        best = best_reference(scores)
        cell = "none"
        if best is not None:
            cell = f"{best}: {scores[best].mean:.3g}"
        cells.append(cell)
    print(f"| {size.split} {size.name} | {' | '.join(cells)} |")


def _print_references(size: Size, references: Mapping[str, ReferenceScores]) -> None:
    ranking = ranking_metric(size)
    naive_scores = {}
    for name in NAIVE.intersection(references):
        naive_scores[name] = references[name].scores[ranking]
    best = best_reference(naive_scores)

    for name, reference in references.items():
        score = reference.scores[ranking]
        low, high = score.interval
        interval = "too few"
        if np.isfinite(low):
            interval = f"{low:.3g} to {high:.3g}"
        is_defined = np.isfinite(reference.correlation)
        defined = reference.correlation[is_defined]
        correlation = "undefined"
        if defined.size:
            correlation = f"{np.mean(defined):.3f}"
        mark = ""
        if name == best:
            mark = " (best)"
        kind = "not in the table"
        if name in REFERENCES:
            kind = str(REFERENCES[name].kind)
        print(
            f"| {size.split} {size.name} | {name}{mark} | {kind} | {score.mean:.4g} "
            f"| {interval} | {correlation} "
            f"| {reference.seconds_per_frame:.2g} | {_relative_cost(size, reference)} |"
        )


def _relative_cost(size: Size, reference: ReferenceScores) -> str:
    """Return the time of a frame over that of our solver, on the same machine."""
    seconds = solver_seconds(size)
    if seconds is None:
        return "unknown"
    return f"{reference.seconds_per_frame / seconds:.2g}"


def _print_hardness(
    size: Size, references: Mapping[str, ReferenceScores], *, each: bool
) -> bool:
    """Print how often the frozen field fails, and return whether that is enough.

    Where the correlation is undefined, it has failed.
    """
    if "frozen-field" not in references:
        return True
    frozen = references["frozen-field"]
    correlation = frozen.correlation
    errors = frozen.scores["vorticity_nrmse"].values
    error = float(np.median(errors))
    is_below = ~(correlation >= FALLEN)
    below = float(np.mean(is_below))
    middle = float(np.nanmedian(correlation))
    print(
        f"| {size.split} {size.name} | {below:.0%} of {correlation.size} | "
        f"{middle:.3f} | {error:.3g} |"
    )
    if each:
        cells = [f"{value:.2f}" for value in correlation]
        print(f"| | {' '.join(cells)} | | |")
    strong = size.split != "cavity" or error >= ERROR
    return size.name not in ACCEPTED or (below >= SHARE and strong)


def _print_active(size: Size, references: Mapping[str, ReferenceScores]) -> None:
    """Print for how many of the predicted frames the truth of a free surface moves."""
    if "ballistic" in references:
        active = references["ballistic"].scores["active_frames"].values
        where = f"{size.split} {size.name} | {np.median(active):g}"
        print(
            f"| {where} | {np.min(active):g} | {np.max(active):g} | "
            f"{size.task.horizon} |"
        )


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"references: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
