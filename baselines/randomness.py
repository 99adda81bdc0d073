"""Random numbers of a training, as functions of seed, step and process alone.

So no generator's state has to be stored: at every step, a training that was interrupted
draws the numbers of an uninterrupted one, whatever happened in between.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


def derive_seed(seed: int, *place: int) -> int:
    """Return a seed of 63 bits for a place in a training, such as (step, process)."""
    sequence = np.random.SeedSequence((seed, *place))
    (state,) = sequence.generate_state(1, np.uint64)
    return int(state >> np.uint64(1))


def seed_generators(seed: int) -> None:
    """Seed the global generators of Python, NumPy and torch, for layers of others."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (what PyTorch Geometric may draw from)
    torch.manual_seed(seed)


@contextmanager
def preserve_generators() -> Iterator[None]:
    """Give the caller's global generators back in their state of before."""
    python_state = random.getstate()
    numpy_state = np.random.get_state()  # noqa: NPY002 (the global one)
    with torch.random.fork_rng():
        try:
            yield
        finally:
            random.setstate(python_state)
            np.random.set_state(numpy_state)  # noqa: NPY002
