"""What a device whose bits differ leaves in the manifest."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT

from lagbench.campaign import Campaign
from lagbench.errors import DataError
from lagbench.generators.record import measured_values
from lagbench.generators.solver import Device
from lagbench.manifest import Manifest, read_manifest
from lagbench.progress import Meter
from lagbench.registry import Registry


def manifest_of(root: Path) -> Manifest:
    """Return the manifest of the tiny data set."""
    manifest = read_manifest(root, SPLIT, SIZE, 1)
    assert manifest is not None
    return manifest


def test_a_gpu_with_other_bits_marks_the_manifest(copied: Callable[[], Path], unmeasured: Registry) -> None:
    """Other hashes from a GPU: tolerance and an error; files made right again on a CPU: bitwise again."""
    root = copied()
    right = measured_values(manifest_of(root))
    wrong = right.model_copy(update={"scenario_sha256": {**right.scenario_sha256, 4: "0" * 16}})
    size = unmeasured.size(SPLIT, SIZE)
    gpu = Campaign(size.model_copy(update={"measured": wrong}), root, Device.CUDA, 1, Meter())
    gpu.manifest = manifest_of(root)
    with pytest.raises(DataError, match="1 of 5 scenarios have another hash"):
        gpu._compare()
    assert manifest_of(root).identity == "tolerance"
    cpu = Campaign(size.model_copy(update={"measured": right}), root, Device.CPU, 1, Meter())
    cpu.run(size.scenarios)
    assert cpu.verdict == "equal to datasets.yaml"
    assert manifest_of(root).identity == "bitwise"
