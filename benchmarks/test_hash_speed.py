"""Content hash of one full cavity scenario: gigabytes of values per second."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture
from timing import best_seconds

from lagbench.data import checksums

TARGET = 1e9
FRAMES = 600
PARTICLES = 8192

Frames = NDArray[np.float32]


@pytest.fixture(scope="module")
def frames() -> Frames:
    """Return positions of a whole scenario, shape [frame, particle, 2]."""
    return np.random.default_rng(0).random((FRAMES, PARTICLES, 2), dtype=np.float32)


def stream(frames: Frames) -> str:
    """Hash frame by frame, as the writer does."""
    hasher = checksums.ContentHasher({"split": "cavity"})
    hasher.declare(
        "position", frames.dtype, ("frame", "particle", "space"), frames.shape
    )
    for frame in frames:
        hasher.update("position", frame)
    return hasher.hexdigest()


def test_content_hash(benchmark: BenchmarkFixture, frames: Frames) -> None:
    """At least 1 GB/s, printed beside the bare SHA-256 of the same bytes."""
    rate = frames.nbytes / best_seconds(
        benchmark, lambda: stream(frames), rounds=5, warmup_rounds=1
    )
    benchmark.extra_info["bytes_per_second"] = rate
    print(f"\ncontent hash: {rate / 1e9:.2f} GB/s (target {TARGET / 1e9:.0f})")
    assert rate >= TARGET


def test_bare_sha256(benchmark: BenchmarkFixture, frames: Frames) -> None:
    """Lower bound: SHA-256 of the bytes without looking at a value."""
    bare = best_seconds(
        benchmark,
        lambda: hashlib.sha256(frames.data).digest(),
        rounds=5,
        warmup_rounds=1,
    )
    print(f"\nbare SHA-256: {frames.nbytes / bare / 1e9:.2f} GB/s")
