"""Taichi and Quadrants make the same bits."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lagbench.data.registry import load
from lagbench.work.engine import ENGINE_VARIABLE, ENGINES

QUICK = ("curl-noise", "fluid")
"""A split of each formulation; the others take a minute."""

SPLITS = (
    *QUICK,
    *(
        pytest.param(split, marks=pytest.mark.slow)
        for split in load().splits
        if split not in QUICK
    ),
)


@pytest.mark.parametrize("split", SPLITS)
def test_the_second_engine_makes_the_bits_of_tiny(split: str, tmp_path: Path) -> None:
    """A scenario has the hash that datasets.yaml states, else ``generate`` fails.

    All other tests run on the first engine that is installed.
    """
    engine = ENGINES[-1]
    if importlib.util.find_spec(engine) is None:
        pytest.skip(f"{engine} is not installed")
    command = [sys.executable, "-m", "lagbench", "generate", "--split", split]
    options = ["--size", "tiny", "--scenarios", "0", "--workers", "1"]
    options += ["--root", str(tmp_path), "--json"]
    done = subprocess.run(
        [*command, *options],
        env=os.environ | {ENGINE_VARIABLE: engine},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
