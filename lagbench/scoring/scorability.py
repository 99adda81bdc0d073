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

    return ValidationIssue(
        check="undefined",
        severity=Severity.WARNING,
        what=f"the vorticity has no value in any frame of {len(counts)} of "
        f"{len(task.scenarios)} {task.truth.subset} scenarios: {min(counts)} to "
        f"{max(counts)} nodes counted, {MINIMUM_NODES} needed; {_suggest_grid(task)}",
        where=f"score grid of {grid.cells} cells",
    )


def _suggest_grid(task: ScoredTask) -> str:
    """Return the hint that names a grid of which all scenarios cover enough nodes."""
    grid = task.config.grid

    def clouds() -> Iterator[Cloud]:
        for scenario in task.scenarios:
            yield from _clouds(task, scenario)

    cells = fitting_cells(clouds, grid.placement, near=grid.cells, box=grid.box)
    if cells is None and max(grid.box.lengths) < SMALL_SIDE:
        return "import the data in another unit of length: the box is small"
    if cells is None:
        return "more particles are needed: they cover enough nodes of no grid"
    # no path of this machine: scores.json repeats it
    description = Path(task.size.split) / DESCRIPTION
    place = ""
    if (task.truth.root / description).is_file():
        place = f", under score_grid in {description.as_posix()}"
    return f"take a grid of {cells} cells{place}"


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
    for subset in ("test", "valid") if validated else ("test",):
        try:
            task = load_scored_task(size, root, subset=subset)
            moves = False
            sparse = []  # scenarios with too few covered nodes
            for scenario in task.scenarios:
                with task.opened(scenario) as opened:
                    before = opened.scenario.initial_snapshot.position
                covered = []
                for cloud in _clouds(task, scenario):
                    moves |= not np.array_equal(before, cloud.position)
                    covered.append(covered_nodes(cloud, task.config.grid))
                if max(covered) < MINIMUM_NODES:
                    sparse.append(scenario)
            if not moves:
                yield (
                    f"nothing moves in {subset}: no reference has an error to be "
                    "better than; import other trajectories for it"
                )
            elif sparse and ranking_metric(task.size) == OF_NODES:
                yield few_nodes_warning(task, sparse).what
        except LagbenchError as error:
            # the training itself may do without the missing files
            yield str(error)
