"""Random numbers of a training as a function of seed, step and process, and of nothing else.

No state of any generator has to be stored: a training that was interrupted draws, at every
step, what an uninterrupted one draws there, whatever happened in between.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

__all__ = ["generators_kept", "reseed", "seed_of"]


def seed_of(seed: int, *place: int) -> int:
    """Return a seed of 63 bits for a place in a training, such as (step, process).

    Args:
        seed: seed of the whole training.
        place: numbers >= 0 that name the place.
    """
    return int(np.random.SeedSequence((seed, *place)).generate_state(1, np.uint64)[0] >> np.uint64(1))


def reseed(seed: int) -> None:
    """Set the global generators of Python, NumPy and torch, which layers of others draw from."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (what PyTorch Geometric may draw from)
    torch.manual_seed(seed)


@contextmanager
def generators_kept() -> Iterator[None]:
    """Give the caller's global generators back as they were."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 (the global one)
    with torch.random.fork_rng():
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002
