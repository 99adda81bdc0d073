"""What one size of a split is, costs and has on this machine or in a store; nothing is read but names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lagbench.data.layout import dataset_folder, url_of
from lagbench.data.registry import Size
from lagbench.work.process import available_cores

from .cards import PICTURES
from .plan import estimate, scenario_bytes

__all__ = ["Overview", "overview"]

DRAWN = 2
"""Scenarios of a size that are drawn to estimate the time: all of them would take seconds."""


@dataclass(frozen=True, kw_only=True)
class Overview:
    """What tables say about one size of a split."""

    split: str  # name of the split
    size: str  # name of the size
    version: str  # semantic version
    scenarios: dict[str, int]  # number of scenarios by subset
    particles: int  # particles in one scenario
    frames: int  # recorded frames of all scenarios
    bytes: int  # disk space before compression [bytes]
    # time to generate on all cores of this machine [s], for orientation; 0 for what cannot be simulated
    seconds: float
    measured: bool  # whether that is at a rate that this machine has measured
    # scenario files that are there, by subset; 'lagbench verify' checks them. Of a store
    # what its manifest names.
    present: dict[str, int]
    folder: Path  # where they are, or would be
    picture: Path | None  # picture of the data set once it is generated
    dataset_sha256: str | None  # data set hash as datasets.yaml has it

    @property
    def state(self) -> str:
        """Whether it is on this machine: "yes", "no" or how much of it."""
        there, wanted = sum(self.present.values()), sum(self.scenarios.values())
        if there == wanted:
            return "yes"
        return f"{there} of {wanted}" if there else "no"


def overview(size: Size, root: Path) -> Overview:
    """Return what a size is, costs, and has below a root folder."""
    folder = dataset_folder(root, size.split, size.name, size.major)
    ids = size.scenarios
    expected = estimate(size, ids, drawn=DRAWN) if size.simulated else None
    return Overview(
        split=size.split,
        size=size.name,
        version=size.version,
        scenarios={subset: len(ids) for subset, ids in size.subsets.items()},
        particles=size.particles,
        frames=sum(map(size.frame_count, ids)),
        bytes=sum(scenario_bytes(size, i) for i in ids),
        seconds=expected.seconds(available_cores()) if expected else 0.0,
        measured=expected is not None and expected.measured,
        present=_present(size, root, folder),
        folder=folder,
        picture=next((folder / name for name in PICTURES if (folder / name).is_file()), None),
        dataset_sha256=size.measured.dataset_sha256 if size.measured else None,
    )


def _present(size: Size, root: Path, folder: Path) -> dict[str, int]:
    url = url_of(root)
    if url is None:
        return {
            subset: sum((folder / subset / f"{i:04d}.nc").is_file() for i in ids)
            for subset, ids in size.subsets.items()
        }
    from lagbench.store.copy import remote_manifest  # what a store takes is not loaded for a folder

    found = remote_manifest(size, url)
    named = {entry.scenario for entry in found.files} if found else set()
    return {subset: len(named & {*ids}) for subset, ids in size.subsets.items()}
