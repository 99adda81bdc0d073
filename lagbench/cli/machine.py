"""Look at this machine: libraries, cores, disk, registry; what a bug report needs.

Time our solver: what a surrogate has to beat on the same machine.
"""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.errors import LagbenchError, check_installed
from lagbench.make.plan import free_bytes
from lagbench.work.machine import available_cores
from lagbench.work.pool import Pool, Report, WorkItem

NEEDED = (
    *(
        "numpy",
        "scipy",
        "xarray",
        "netCDF4",
        "h5py",
        "dask",
        "pandas",
        "pydantic",
        "PyYAML",
    ),
    *("typer", "rich", "platformdirs", "filelock", "fsspec"),
)
OPTIONAL = {"taichi": "generate", "matplotlib": "plots", "imageio": "plots"}
OPTIONAL |= {"torch": "baselines", "distributed": "cluster", "s3fs": "s3"}
"""Libraries of our extras."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing looked at."""

    name: str  # what it is
    state: str  # "ok", "missing" (something optional) or "broken"
    detail: str  # what was found, and how to mend it


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """All that was looked at."""

    checks: tuple[Check, ...]  # in the order of looking

    @property
    def healthy(self) -> bool:
        """Whether nothing is broken."""
        return all(check.state != "broken" for check in self.checks)


def doctor(root: str | Path | None = None) -> Diagnosis:
    """Look at what lagbench needs on this machine, data sets under ``root``; changes
    nothing.
    """
    folder = resolve_root(root)
    native = platform.machine() in {"x86_64", "AMD64"} and platform.system() == "Linux"
    if native:
        promise = "bits as in datasets.yaml"
    else:
        promise = "bits may differ: see docs/determinism.md"
    cores = f"{platform.machine()}, {available_cores()} of {os.cpu_count()} cores; {promise}"
    return Diagnosis(
        checks=(
            Check(name="lagbench", state="ok", detail=version("lagbench")),
            Check(
                name="python",
                state="ok",
                detail=f"{platform.python_version()} on {platform.platform()}",
            ),
            Check(name="processor", state="ok", detail=cores),
            *(_library(name) for name in NEEDED),
            *(_library(name, extra) for name, extra in OPTIONAL.items()),
            _attempt("registry", _registry),
            _attempt("data folder", lambda: _folder(folder)),
        )
    )


def _library(name: str, extra: str | None = None) -> Check:
    """Look for a library; nothing is broken without that of an extra."""
    try:
        return Check(name=name, state="ok", detail=version(name))
    except PackageNotFoundError:
        if extra is None:
            return Check(
                name=name, state="broken", detail="not installed: pip install lagbench"
            )
        return Check(
            name=name, state="missing", detail=f"pip install 'lagbench[{extra}]'"
        )


def _attempt(name: str, look: Callable[[], str]) -> Check:
    try:
        return Check(name=name, state="ok", detail=look())
    except (LagbenchError, OSError) as error:
        return Check(name=name, state="broken", detail=str(error))


def _registry() -> str:
    registry = load()
    measured = sum(len(sizes) for sizes in registry.measured.values())
    return f"{len(registry.splits)} splits, hashes of {measured} sizes"


def _folder(folder: Path) -> str:
    """Return where data sets live; an OSError when nothing can be written there."""
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    with tempfile.TemporaryFile(dir=existing):
        return f"{folder}, {free_bytes(folder)} bytes free"


WARM_UP = 2  # frames before the clock starts: kernels compile when they first run
LEAST = 0.5  # shortest time over which the mean is taken [s]


@dataclass(frozen=True, kw_only=True)
class SolverBench:
    """What a frame costs the solver, one scenario on one core."""

    split: str  # name of the split
    size: str  # name of the size
    particles: int  # particles of the scenario
    substeps: int  # solver steps of a frame
    frames: int  # frames that were timed
    # mean processor time of a frame [s], so that other work on the machine does not
    # count; writing it to disk is not part of it
    seconds_per_frame: float


def bench_solver(split: str, size: str, *, frames: int = 20) -> SolverBench:
    """Simulate the first test scenario and time so many frames, or as many as half a
    second takes.

    Taichi starts once per process: call this from one of its own, as
    :func:`bench_apart` does.
    """
    tier = load().size(split, size)
    check_installed("taichi", extra="generate")
    from lagbench.generators.batch import draw_initial_state
    from lagbench.generators.constants import solver_constants
    from lagbench.generators.solver import build

    solver = build(solver_constants(tier))
    solver.load([draw_initial_state(tier, tier.subsets["test"][0])])
    solver.advance(WARM_UP * tier.substeps_per_frame)
    started = time.process_time()
    timed = 0
    while timed < frames or time.process_time() - started < LEAST:
        solver.advance(tier.substeps_per_frame)
        solver.position()
        timed += 1
    seconds = (time.process_time() - started) / timed
    flow = {
        "particles": tier.particles,
        "substeps": tier.substeps_per_frame,
        "frames": timed,
    }
    return SolverBench(split=split, size=size, **flow, seconds_per_frame=seconds)


def bench_apart(split: str, size: str) -> SolverBench:
    """Time the solver in a process of its own, which this one's memory and threads do
    not disturb.
    """
    load().size(split, size)
    check_installed("taichi", extra="generate")
    with Pool(1) as pool:
        pool.submit(
            WorkItem(
                name=f"bench of {split} {size}",
                function=_bench,
                arguments=(split, size),
            )
        )
        timed: SolverBench = next(
            event.value for event in pool.events() if event.kind == "done"
        )
    return timed


def _bench(split: str, size: str, report: Report) -> SolverBench:
    """Time the solver in a worker process; there is nothing to report meanwhile."""
    return bench_solver(split, size)
