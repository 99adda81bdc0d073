"""What a score file must hold: every statistic, at every frame at which the scorer measures it.

A statistic that is left out, or left out at the frames where a model fares badly, would better
the means without touching a number.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.data.writer import MATERIALS
from lagbench.metrics import METRICS, Metric, Tally, always, at_slow_frames
from lagbench.scoring.score_file import StoredScores
from lagbench.submission.task_checks import frames_to_predict

__all__ = ["gaps", "reported_frames"]

BODIES = "bodies"
"""Family of metrics that scenarios without elastic bodies do not have."""


def reported_frames(size: Size) -> tuple[int, ...]:
    """Return the frames of interest and the last one, absolute."""
    frames = tuple(frames_to_predict(size))
    return tuple(sorted({*size.task.frames_of_interest, frames[-1]}.intersection(frames)))


def gaps(scores: StoredScores, size: Size) -> Iterator[tuple[str, str]]:
    """Yield what the score file of a split and size should hold and does not: expected, got."""
    held = next(iter(scores.tallies.values())).names
    known = [metric for metric in METRICS.values() if metric.statistic is not None]
    lacking = [metric.name for metric in known if metric.extra is None and metric.name not in held]
    if lacking:
        yield "a value of every statistic", f"no {_listed(lacking)}"
    wrong = [
        (metric.name, told)
        for metric in known
        if metric.name in held and (told := _gap(metric, scores, size)) is not None
    ]
    if wrong:
        name, (expected, got) = wrong[0]
        more = f"; {len(wrong) - 1} more statistics have gaps" if len(wrong) > 1 else ""
        yield f"{name}: {expected}", f"{got}{more}"


def _listed(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _gap(metric: Metric, scores: StoredScores, size: Size) -> tuple[str, str] | None:
    """Return at which frames a statistic should be measured or defined and is not, if so."""
    for scenario, tally in sorted(scores.tallies.items()):
        measured = tally.measured(metric.name)
        wanted = _wanted(metric, tally, size)
        if not np.array_equal(measured, wanted):
            expected = f"{np.count_nonzero(wanted)} frames of scenario {scenario} measured"
            return expected, f"{np.count_nonzero(measured)}, or other ones"
        undefined = np.count_nonzero(measured & np.isnan(tally.series(metric.name)))
        if undefined and metric.defined is always and not _partial(metric):
            return f"a value at every measured frame of scenario {scenario}", f"{undefined} without one"
    return None


def _wanted(metric: Metric, tally: Tally, size: Size) -> NDArray[np.bool_]:
    """Return at which frames a statistic is measured, shape [frame]."""
    if metric.applies is at_slow_frames:
        return np.isin(tally.frames, reported_frames(size))
    present = not _partial(metric) or bool(tally.measured(metric.name).any())
    return np.full(len(tally.frames), present)


def _partial(metric: Metric) -> bool:
    """Tell whether a metric is of one material or kind of body, which a scenario may lack."""
    return metric.family == BODIES or metric.name.endswith(tuple(f"_{name}" for name in MATERIALS))
