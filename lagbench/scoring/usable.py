"""Whether a data set can be scored: what the metric that ranks needs of it, and how to
mend it.

Our own splits can be. Those that users bring may have too few particles for their score
grid, test scenarios that differ in particles, or a truth at rest, beside which there is
no skill.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

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


def few_nodes(task: ScoredTask, scenarios: Collection[int]) -> ValidationIssue:
    """Return how many nodes scenarios without any vorticity cover, and a grid of which
    all cover enough.
    """
    setting = task.setting
    counts = [covered_nodes(_clouds(task, i)[0], setting.grid) for i in scenarios]
    cells = fitting_cells(
        lambda: (cloud for i in task.scenarios for cloud in _clouds(task, i)),
        setting.grid.placement,
        near=setting.grid.cells,
    )
    if cells is None:
        fix = "more particles: they cover enough nodes of no grid"
    else:
        if cells < setting.grid.cells:
            word = "coarser"
        else:
            word = "finer"
        # no path of this machine: scores.json repeats it
        described = Path(task.size.split) / DESCRIPTION
        local = (task.truth.root / described).is_file()
        if local:
            here = f"cells: {cells} under score_grid in {described.as_posix()}, or "
        else:
            here = ""
        fix = f"a {word} grid: {here}--cells {cells} of lagbench adopt and import"
    least = min(counts)
    most = max(counts)
    return ValidationIssue(
        check="undefined",
        severity=Severity.WARNING,
        what="the vorticity has no value in any frame",
        where=f"score grid of {setting.grid.cells} cells",
        expected=f"{MINIMUM_NODES} nodes with particles enough around them",
        got=f"{len(counts)} of {len(task.scenarios)} {task.truth.subset} scenarios "
        f"undefined:"
        f" {least if least == most else f'{least} to {most}'} nodes counted, "
        f"{MINIMUM_NODES} needed",
        fix=fix,
    )


def _clouds(task: ScoredTask, scenario: int) -> tuple[Cloud, Cloud]:
    """Return the particles of the first and the last predicted frame."""
    frames = task.setting.predicted_frames
    with task.opened(scenario) as opened:
        first, last = (
            opened.file.read("position", slice(f, f + 1))[0]
            for f in (frames[0], frames[-1])
        )
        return Cloud(first, opened.scenario.area), Cloud(last, opened.scenario.area)


def unusable(size: Size, root: Path, *, validated: bool = True) -> Iterator[str]:
    """Yield why predictions of a data set could not be scored or validated, with what
    mends it.

    Only the first and last frames that are to be predicted are read, beside what checks
    the files.
    """
    for subset in ("test", "valid") if validated else ("test",):
        counts = set()
        moves = False
        sparse = []
        try:
            task = load_scored_task(size, root, subset=subset)
            for i in task.scenarios:
                with task.opened(i) as opened:
                    before = opened.scenario.last_given.position
                clouds = _clouds(task, i)
                counts.add(len(before))
                moves |= any(
                    not np.array_equal(before, cloud.position) for cloud in clouds
                )
                if all(
                    covered_nodes(cloud, task.setting.grid) < MINIMUM_NODES
                    for cloud in clouds
                ):
                    sparse.append(i)
            if len(counts) > 1 and subset == "test":
                yield (
                    f"test scenarios have {min(counts)} to {max(counts)} particles: "
                    f"predictions need one"
                    " number; put those of one number into test: lagbench adopt with "
                    "folders train, valid and"
                    " test"
                )
            if not moves:
                yield (
                    f"nothing moves in {subset}: no floor has an error to be better "
                    f"than; other trajectories"
                    f" for {subset}: lagbench adopt with folders train, valid and test"
                )
            elif sparse and ranking_metric(task.size) == OF_NODES:
                found = few_nodes(task, sparse)
                yield f"{found.got}; {found.fix}"
        except (
            LagbenchError
        ) as error:  # the training itself may do without what is missing here
            if error.fix:
                fix = f"; {error.fix}"
            else:
                fix = ""
            yield f"{error.what}: expected {error.expected}, got {error.got}{fix}"
