"""Taichi's runtime starts as the device says, whatever the environment says."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT

from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.make.generate import GenerationResult
from lagbench.make.verify import verify

START = """
from lagbench.generators import backend
from lagbench.generators.solver import Device
backend.start(Device.CPU)
config = backend.ti.lang.impl.current_cfg()
print(config.arch, config.opt_level, config.advanced_optimization, config.debug)
import os
print(sorted(name for name in os.environ if name.startswith("TI_") and "VERSION" not in name))
"""

HOSTILE = {
    "TI_ARCH": "vulkan",
    "TI_OPT_LEVEL": "0",
    "TI_ADVANCED_OPTIMIZATION": "0",
    "TI_DEBUG": "1",
    "TI_DEFAULT_FP": "64",
}


def started(**variables: str) -> list[str]:
    """Return what a fresh process prints about the runtime that it started."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("TI_")}
    command = [sys.executable, "-c", START]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=True, env={**plain, **variables}
    )
    return done.stdout.splitlines()


def test_the_environment_does_not_choose_the_arithmetic() -> None:
    """Device, optimisation and checks are the same with hostile variables, which stay as they were."""
    clean, hostile = started(), started(**HOSTILE)
    assert clean[0].startswith(("Arch.x64", "Arch.arm64"))
    assert hostile[0] == clean[0]
    assert hostile[1] == str(sorted(HOSTILE))


def test_simulating_anew_without_taichi_names_the_remedy(
    generated: GenerationResult, unmeasured: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that finds no Taichi is a usage error with the extra to install, not a crash."""
    (tmp_path / "taichi.py").write_text("raise ModuleNotFoundError('no taichi', name='taichi')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UsageError, match="taichi is not installed") as caught:
        verify(SPLIT, SIZE, root=generated.root, regenerate=1, workers=1, registry=unmeasured)
    assert caught.value.fix == "pip install 'lagbench[generate]'"
