"""Real Dask clusters on this machine, and what befalls their workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lagbench.data.layout import NOTES_NAME

TESTS = Path(__file__).parent

ALONE = """
from distributed import LocalCluster
options = dict(n_workers=1, threads_per_worker=1, processes=False)
options |= dict(dashboard_address=None, protocol="tcp://")
with LocalCluster(**options) as cluster:
    print(cluster.scheduler_address, flush=True)
    input()
"""
"""A scheduler and its worker in one process."""


@contextmanager
def local_cluster(threads: int = 1) -> Iterator[Any]:
    """Run a scheduler here and two worker processes that can import the test
    modules.
    """
    import distributed

    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = str(TESTS)
    options = {
        "n_workers": 2,
        "threads_per_worker": threads,
        "processes": True,
        "dashboard_address": ":0",
    }
    try:
        with distributed.LocalCluster(**options, silence_logs=50) as running:
            yield running
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


@contextmanager
def scheduler_process() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run a scheduler with its worker in a process that a test may kill; yield its
    address and it.
    """
    there = {**os.environ, "PYTHONPATH": str(TESTS)}
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", ALONE]
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=there
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().decode().strip(), process
        process.kill()


def everything(folder: Path) -> dict[str, bytes]:
    """Return path and bytes of every file of a data set but its lock and notes of this
    machine.
    """
    found = {
        str(path.relative_to(folder)): path
        for path in folder.rglob("*")
        if path.is_file()
    }
    return {
        name: path.read_bytes()
        for name, path in found.items()
        if name not in (".lock", NOTES_NAME)
    }


def writers(root: Path) -> dict[int, Path]:
    """Return the unfinished scenario files below a folder by the process that writes
    them.
    """
    files = root.rglob(".*.nc.*.partial")
    return {int(path.name.split(".nc.")[1].split("-")[0]): path for path in files}


class Sabotage(threading.Thread):
    """Kill the first Dask worker that is seen to write a scenario, and slow all others.

    Args:
        root: folder of all data sets.
        witness: called once just before the kill.

    Attributes:
        killed: process id of the worker killed, and the file that it wrote.
        slowed: process ids of the workers that were slowed.
    """

    def __init__(self, root: Path, witness: Callable[[], None] = lambda: None) -> None:
        super().__init__(daemon=True)
        self.root = root
        self.witness = witness
        self.killed: tuple[int, Path] | None = None
        self.slowed: set[int] = set()
        self._over = threading.Event()

    def __enter__(self) -> Sabotage:
        """Begin."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End."""
        self._over.set()
        self.join()

    def run(self) -> None:
        """Kill once, then stop and continue the writers of other workers."""
        while not self._over.wait(0.005):
            for process, path in writers(self.root).items():
                with suppress(OSError):
                    self._harm(process, path)

    def _harm(self, process: int, path: Path) -> None:
        if self.killed is None:
            self.witness()
            os.kill(process, signal.SIGKILL)
            self.killed = process, path
        else:
            os.kill(process, signal.SIGSTOP)
            time.sleep(0.05)
            os.kill(process, signal.SIGCONT)
            self.slowed.add(process)


def gone(process: int) -> bool:
    """Return whether a process has ended, be it that nobody has asked for its last
    words.
    """
    try:
        return (
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
            == "Z"
        )
    except OSError:
        return True
