"""The ranking scores of the references, which `lagbench list SPLIT` shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lagbench.data.registry import Size
from lagbench.metrics.table import ranking_metric
from lagbench.references.shipped import shipped
from lagbench.references.table import REFERENCES

from .output import print_line, print_table


def measured_references(size: Size) -> dict[str, float]:
    """Return the mean ranking score of each reference that was measured, by name."""
    ranking = ranking_metric(size)
    references = shipped(size) or {}
    means = {}
    for name, reference in references.items():
        score = reference.scores[ranking]
        means[name] = score.mean
    return means


def print_references(
    sizes: Sequence[Size], references: Mapping[str, Mapping[str, float]]
) -> None:
    """Print the ranking scores of the references, a column for each size.

    Args:
        sizes: sizes of one split.
        references: scores by size and reference.
    """
    if not any(references.values()):
        print_line("references: none recorded; they are measured with each score")
        return

    size_names = [size.name for size in sizes]
    rows = []
    for name in REFERENCES:
        cells = []
        for size_name in size_names:
            value = references[size_name].get(name)
            cell = "-"
            if value is not None:
                cell = f"{value:.3g}"
            cells.append(cell)
        if any(cell != "-" for cell in cells):
            rows.append((name, REFERENCES[name].kind, *cells))
    columns = ("reference", "kind", *size_names)
    metric = ranking_metric(sizes[0])
    print_line(f"{metric} of the reference predictors: lower is better")
    print_table("", columns, rows)
