"""Who does the work of a generation: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from lagbench.generators.solver import Device
from lagbench.work.cluster import Cluster
from lagbench.work.pool import Pool, Report
from lagbench.work.run import run_all

__all__ = [
    "Crew",
]


Job = TypeVar("Job")
Result = TypeVar("Result")

WORTH_WORKERS = 1 << 30
"""Bytes of files below which starting processes to read them costs more than it gains."""

ENVIRONMENT: Mapping[Device, Mapping[str, str]] = {
    # NumPy's and HDF5's threads would only take the cores from the other workers.
    Device.CPU: {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    Device.PARALLEL: {},
    Device.CUDA: {},
}
"""Variables of the processes that simulate."""


@dataclass(frozen=True, kw_only=True)
class Crew:
    """Who does the work."""

    workers: int  # worker processes of this machine
    scheduler: str | None = None  # address of a Dask scheduler whose workers do it instead

    def simulating(self, tasks: int, device: Device, folder: Path) -> Pool | Cluster:
        """Return those who simulate."""
        if self.scheduler is None:
            return Pool(min(self.workers, tasks), ENVIRONMENT[device])
        return Cluster(self.scheduler, ENVIRONMENT[device], folder=folder)

    def read(
        self,
        function: Callable[[Job, Report], Result],
        jobs: Mapping[str, Job],
        files: Iterable[Path],
        report: Report,
    ) -> list[Result]:
        """Run a function that reads files, here where they hold little."""
        if sum(path.stat().st_size for path in files if path.exists()) < WORTH_WORKERS:
            return run_all(function, jobs, report=report)
        return run_all(function, jobs, workers=self.workers, scheduler=self.scheduler, report=report)
