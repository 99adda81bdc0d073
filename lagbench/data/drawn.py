"""Blind tests: new test scenarios of a data set, drawn from a seed of your choice.

They are drawn as the scenarios of test are, have the ids 1000 to 1007, and lie in a
root folder of their own, `<root>/drawn-<seed>/`. Nothing is recorded of them.
"""

from __future__ import annotations

import re
from pathlib import Path

from lagbench.errors import UsageError

from .layout import DRAWN_PREFIX
from .local import resolve_root
from .registry import Registry, Size

DRAWN_IDS = tuple(range(1000, 1008))
"""Ids of drawn scenarios; all others are lower."""


def drawn_root(root: str | Path | None, draw_seed: str) -> Path:
    """Return the root folder of drawn scenarios, below the folder of all data sets."""
    return resolve_root(root) / f"{DRAWN_PREFIX}{draw_seed}"


def drawn_size(size: Size, draw_seed: str) -> Size:
    """Return a size whose subset test holds new scenarios, and which has no other.

    They are as long as the task needs. Statistics stay those of the public train.

    Args:
        size: the public size.
        draw_seed: seed of the draws [64 hexadecimal digits].

    Raises:
        UsageError: the seed has another form.
    """
    if re.fullmatch("[0-9a-f]{64}", draw_seed) is None:
        raise UsageError(
            f"--draw-seed takes 64 hexadecimal digits, got {draw_seed!a}; "
            "`openssl rand -hex 32` prints some"
        )
    measured = None
    if size.measured is not None:
        measured = size.measured.model_copy(
            update={"scenario_sha256": {}, "subset_sha256": {}, "twin_floor": ()}
        )
    return size.model_copy(
        update={
            "subsets": {"test": DRAWN_IDS},
            "frames": size.task.input_frames + size.task.horizon,
            "particle_counts": {},
            "draw_seed": draw_seed,
            "measured": measured,
        }
    )


def drawn_registry(
    registry: Registry, split: str, size: str, draw_seed: str
) -> Registry:
    """Return a registry of one size, whose subset test holds new scenarios."""
    drawn = drawn_size(registry.size(split, size), draw_seed)
    description = registry.split(split)
    entry = description.sizes[size].model_copy(
        update={
            "subsets": drawn.subsets,
            "frames": drawn.frames,
            "particle_counts": {},
            "draw_seed": draw_seed,
        }
    )
    blind = description.model_copy(update={"sizes": {size: entry}})
    return Registry({split: blind}, {}, registry.files)
