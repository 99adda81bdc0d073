"""Print how compressible the generated data are, and which bounds they reach.

    python -m validation.soundness --root FOLDER [--split fluid] [--size mini]

Every file states its Mach numbers, the range of J and the particles that reached a
numerical bound (:mod:`lagbench.generators.soundness`); the manifest repeats them.
Files of full boxes state the extremes of J and the largest velocity component of any
particle or node at any substep.

Exit code 0: every scenario of a free surface has a Mach number of at most 0.3 for 99.9
% of its particles and frames, a J of at least 0.9 for 99.9 % of liquid particles and
frames, and no particle at a numerical bound, and every scenario of a full box has a J
from 0.85 to 1.15; 1: one has not; 2: bad options; 4: no data.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from lagbench.data.local import resolve_root
from lagbench.data.manifest import FileEntry, read_manifest
from lagbench.data.registry import Size, load
from lagbench.errors import DataError, LagbenchError

FREE_SURFACES = ("fluid", "multimaterial", "fluid-3d", "multimaterial-3d")
FULL_BOXES = (
    "cavity",
    "curl-noise",
    "decaying-vortices",
    "poiseuille",
    "curl-noise-3d",
    "cavity-3d",
    "cylinder",
)
SIZES = ("tiny", "mini", "full")

MACH_MAX = 0.3
"""Largest Mach number of 99.9 % of particles and frames [1]."""

JACOBIAN_MIN = 0.9
"""Smallest J of 99.9 % of liquid particles and frames [1]."""

FULL_BOX_JACOBIANS = (0.85, 1.15)
"""Smallest and largest J of a full box, of any particle at any substep [1]."""


def is_sound(entry: FileEntry) -> bool:
    """Tell whether a scenario is nearly incompressible and reached no bound."""
    facts = entry.facts
    if "mach_999" not in facts:
        low, high = FULL_BOX_JACOBIANS
        return low <= facts["jacobian_min"] and facts["jacobian_max"] <= high
    return (
        facts["mach_999"] <= MACH_MAX
        and facts["liquid_jacobian_999"] >= JACOBIAN_MIN
        and facts["clamped_particles"] == 0
    )


def entries_of(size: Size, root: Path) -> list[FileEntry]:
    """Return the files of a size that state what is asked for.

    Raises:
        DataError: the manifest is damaged.
    """
    manifest = read_manifest(root, size.split, size.name, size.major)
    if manifest is None:
        return []
    stated = "mach_999" if size.split in FREE_SURFACES else "jacobian_min"
    return [entry for entry in manifest.files if stated in entry.facts]


def describe_full_box(size: Size, entries: Sequence[FileEntry]) -> str:
    """Return one line about a data set in a full box."""
    jacobian_min = min(entry.facts["jacobian_min"] for entry in entries)
    jacobian_max = max(entry.facts["jacobian_max"] for entry in entries)
    sound_speed = math.sqrt(size.value("modulus") / size.value("density"))
    speed = max(entry.facts["max_speed"] for entry in entries)
    sound_count = sum(is_sound(entry) for entry in entries)
    return (
        f"{size.split} {size.name} {size.version}: {sound_count} of {len(entries)} "
        f"scenarios sound; J {jacobian_min:.3f} to {jacobian_max:.3f}; largest Mach "
        f"(of a velocity component) {speed / sound_speed:.3f}"
    )


def describe(size: Size, entries: Sequence[FileEntry]) -> str:
    """Return one line about a data set."""
    mach_999 = max(entry.facts["mach_999"] for entry in entries)
    mach_max = max(entry.facts["mach_max"] for entry in entries)
    jacobian_999 = min(entry.facts["liquid_jacobian_999"] for entry in entries)
    jacobian_min = min(entry.facts["liquid_jacobian_min"] for entry in entries)
    plastic_min = min(entry.facts["snow_jp_min"] for entry in entries)
    clamped = sum(int(entry.facts["clamped_particles"]) for entry in entries)
    sound_count = sum(is_sound(entry) for entry in entries)
    return (
        f"{size.split} {size.name} {size.version}: {sound_count} of {len(entries)} "
        f"scenarios sound; Mach 99.9 % <= {mach_999:.3f}, largest {mach_max:.3f}; "
        f"liquid J 99.9 % >= {jacobian_999:.3f}, smallest {jacobian_min:.3f}; "
        f"snow Jp >= {plastic_min:.3f}; particles at a numerical bound {clamped}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.soundness",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    all_splits = (*FREE_SURFACES, *FULL_BOXES)
    parser.add_argument("--split", choices=all_splits)
    parser.add_argument("--size", choices=SIZES)
    parser.add_argument("--root", type=Path)
    options = parser.parse_args(arguments)
    splits = [options.split] if options.split else list(all_splits)
    sizes = [options.size] if options.size else list(SIZES)
    root = resolve_root(options.root)
    checked: list[FileEntry] = []
    try:
        for split in splits:
            for name in sizes:
                if name not in load().split(split).sizes:
                    continue
                size = load().size(split, name)
                entries = entries_of(size, root)
                if entries:
                    line = describe if split in FREE_SURFACES else describe_full_box
                    sys.stdout.write(line(size, entries) + "\n")
                    checked += entries
        if not checked:
            raise DataError("no generated data", where=str(root))
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    return int(not all(is_sound(entry) for entry in checked))


if __name__ == "__main__":
    raise SystemExit(main())
