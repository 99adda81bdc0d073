"""Scorability: whether a data set can be scored, and how to mend it if not.

Our own splits can be scored. A data set of a user may have too few particles for its
score grid, or a truth at rest, over which there is no skill.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from lagbench.data.box import SMALL_SIDE
from lagbench.data.local import DESCRIPTION
from lagbench.data.registry import Size
from lagbench.errors import LagbenchError
from lagbench.metrics.coverage import Cloud, covered_nodes, fitting_cells
from lagbench.metrics.metric import MINIMUM_NODES
from lagbench.metrics.table import ranking_metric
from lagbench.submission.issues import Severity, ValidationIssue

from .task import ScoredTask, load_scored_task

OF_NODES = "vorticity_nrmse"
"""The ranking metric that needs nodes."""


def few_nodes_warning(task: ScoredTask, scenarios: Collection[int]) -> ValidationIssue:
    """Return the warning for scenarios whose vorticity has no value in any frame.

    It names the nodes that they cover, and a grid of which all scenarios cover enough.
    """
    grid = task.config.grid
    counts = []
    for scenario in scenarios:
        first, _ = _clouds(task, scenario)
        counts.append(covered_nodes(first, grid))

    least = min(counts)
    most = max(counts)
    nodes = str(least)
    if most > least:
        nodes = f"{least} to {most}"
    return ValidationIssue(
        check="undefined",
        severity=Severity.WARNING,
        what="the vorticity has no value in any frame",
        where=f"score grid of {grid.cells} cells",
        expected=f"{MINIMUM_NODES} nodes with particles enough around them",
        got=f"{len(counts)} of {len(task.scenarios)} {task.truth.subset} scenarios "
        f"undefined: {nodes} nodes counted, {MINIMUM_NODES} needed",
        fix=_suggest_grid(task),
    )


def _suggest_grid(task: ScoredTask) -> str:
    """Return the hint that names a grid of which all scenarios cover enough nodes."""
    grid = task.config.grid
    cells = fitting_cells(
        lambda: _all_clouds(task), grid.placement, near=grid.cells, box=grid.box
    )
    longest_side = float(max(grid.box.lengths))
    if cells is None and longest_side < SMALL_SIDE:
        return (
            f"lengths in another unit: the longest side of the box is "
            f"{longest_side:.2g}; import the data anew, which scales them"
        )
    if cells is None:
        return "more particles: they cover enough nodes of no grid"

    word = "finer"
    if cells < grid.cells:
        word = "coarser"
    # no path of this machine: scores.json repeats it
    description = Path(task.size.split) / DESCRIPTION
    is_local = (task.truth.root / description).is_file()
    if not is_local:
        return f"a {word} grid: {cells} cells"
    return f"a {word} grid: cells: {cells} under score_grid in {description.as_posix()}"


def _all_clouds(task: ScoredTask) -> Iterator[Cloud]:
    for scenario in task.scenarios:
        yield from _clouds(task, scenario)


def _clouds(task: ScoredTask, scenario: int) -> tuple[Cloud, Cloud]:
    """Return the particles of the first and the last predicted frame."""
    frames = task.config.predicted_frames
    with task.opened(scenario) as opened:
        area = opened.scenario.area
        first = opened.file.read("position", frames[0])
        last = opened.file.read("position", frames[-1])
    return Cloud(first, area), Cloud(last, area)


def check_scorability(
    size: Size, root: Path, *, validated: bool = True
) -> Iterator[str]:
    """Yield reasons why predictions could not be scored or validated, each with a fix.

    Only the first and last frames that are to be predicted are read, beside the check
    of the files.

    Args:
        size: the split and size.
        root: folder of all data sets.
        validated: whether the valid subset is used too, to validate a training.
    """
    subsets = ["test"]
    if validated:
        subsets.append("valid")

    for subset in subsets:
        try:
            task = load_scored_task(size, root, subset=subset)
            yield from _check_subset(task)
        except LagbenchError as error:
            # the training itself may do without the missing files
            fix = ""
            if error.fix:
                fix = f"; {error.fix}"
            yield f"{error.what}: expected {error.expected}, got {error.got}{fix}"


def _check_subset(task: ScoredTask) -> Iterator[str]:
    """Yield reasons why predictions of a subset could not be scored."""
    subset = task.truth.subset
    moves = False
    sparse = []  # scenarios with too few covered nodes
    for scenario in task.scenarios:
        with task.opened(scenario) as opened:
            before = opened.scenario.initial_snapshot.position
        clouds = _clouds(task, scenario)

        covered = []
        for cloud in clouds:
            moves |= not np.array_equal(before, cloud.position)
            covered.append(covered_nodes(cloud, task.config.grid))
        if max(covered) < MINIMUM_NODES:
            sparse.append(scenario)

    if not moves:
        yield (
            f"nothing moves in {subset}: no reference has an error to be better than; "
            f"other trajectories for {subset}: lagbench import with folders train, "
            f"valid and test"
        )
    elif sparse and ranking_metric(task.size) == OF_NODES:
        warning = few_nodes_warning(task, sparse)
        yield f"{warning.got}; {warning.fix}"
