"""Fixtures that several test modules share."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from lagbench.data.registry import Registry, default_path, load
from lagbench.make.generate import GenerationResult, generate

SPLIT, SIZE = "curl-noise", "tiny"
"""The quickest data set to generate: five scenarios of 312 substeps."""


@pytest.fixture(scope="session")
def unmeasured_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of datasets.yaml without its measured block, so that tests hold before and after a record."""
    path = tmp_path_factory.mktemp("registry") / "datasets.yaml"
    path.write_text(default_path().read_text().split("\nmeasured:")[0] + "\n")
    return path


@pytest.fixture(scope="session")
def unmeasured(unmeasured_path: Path) -> Registry:
    """Our splits without hashes to compare with."""
    return load(unmeasured_path)


@pytest.fixture(scope="session")
def generated(tmp_path_factory: pytest.TempPathFactory, unmeasured: Registry) -> GenerationResult:
    """The tiny curl-noise data set, generated once by two workers; do not change its files."""
    root = tmp_path_factory.mktemp("generated")
    return generate(SPLIT, SIZE, root=root, workers=2, registry=unmeasured)


@pytest.fixture
def copied(generated: GenerationResult, tmp_path: Path) -> Callable[[], Path]:
    """A function that copies the generated data set to a root folder that a test may damage."""

    def copy() -> Path:
        root = tmp_path / "root"
        shutil.copytree(generated.root, root)
        return root

    return copy
