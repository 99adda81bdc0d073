"""Time and memory of ``lagbench import`` for a run in each format.

    python benchmarks/import_formats.py [--particles N] [--frames N] [FORMAT ...]

Writes a run by the library of its field, and two short ones for valid and test, imports
them in a process of its own and prints a row of a table: length of the file, processor
time, and the most memory of that process. Its table stands in docs/exchange.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

CLONE = Path(__file__).parents[1]
sys.path.insert(0, str(CLONE / "tests"))

from foreign_files import (  # type: ignore[import-not-found]  # noqa: E402
    CODE_BASES,
    FORMATS,
    INTERVAL,
)

SHORT = 4_000
"""Particles of the runs for valid and test."""


def rotating_square(particles: int, frames: int, seed: int) -> NDArray[np.float32]:
    """Return particles at random places that turn, [frame, particle, 2]."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(-0.3, 0.3, (particles, 2)) @ [1, 1j]
    turn = np.exp(0.002j * np.arange(frames))
    path = start * turn[:, None]
    return np.stack([path.real + 0.5, path.imag + 0.5], axis=-1).astype(np.float32)


def write_runs(
    name: str, folder: Path, particles: int, frames: int
) -> dict[str, object]:
    """Write three runs; return the options of their import."""
    counts = {"train": particles, "valid": SHORT, "test": SHORT}
    for seed, (subset, count) in enumerate(counts.items()):
        position = rotating_square(count, frames, seed)
        if name in CODE_BASES:
            CODE_BASES[name](folder, subset, position)
        else:
            FORMATS[name][0](folder / subset, position)
    if name in FORMATS:
        return dict(FORMATS[name][1])
    (folder / "metadata.json").write_text(json.dumps({"dt": INTERVAL}))
    return {}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("formats", nargs="*", metavar="FORMAT")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=100)
    words = parser.parse_args()
    print("| format | file [MB] | processor time [s] | memory [MB] |")
    print("|---|---|---|---|")
    for name in words.formats or [*FORMATS, *CODE_BASES]:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "runs"
            folder.mkdir()
            options = write_runs(name, folder, words.particles, words.frames)
            size = sum(one.stat().st_size for one in folder.rglob("*") if one.is_file())
            program = (
                "from lagbench.exchange import adopt; "
                f"adopt({str(folder)!r}, output={temporary + '/own'!r}, **{options!r})"
            )
            child = os.spawnv(
                os.P_NOWAIT, sys.executable, [sys.executable, "-c", program]
            )
            _, status, usage = os.wait4(child, 0)
            if status:
                print(f"| {name} | {size / 1e6:.0f} | failed | |", flush=True)
                continue
            seconds = usage.ru_utime + usage.ru_stime
            print(
                f"| {name} | {size / 1e6:.0f} | {seconds:.0f} | "
                f"{usage.ru_maxrss / 1e3:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
