"""Generation on a real Dask cluster: the bytes of one machine, workers killed and
slowed or not.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from cluster_bench import (
    Sabotage,
    everything,
    gone,
    local_cluster,
    scheduler_process,
    writers,
)
from conftest import SIZE, SPLIT

from lagbench.data.lock import Holder, read_holder
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry
from lagbench.errors import WorkFailedError
from lagbench.make import generate as campaign
from lagbench.make.generate import GenerationResult, generate
from lagbench.work import cluster
from lagbench.work.cluster import Client, FolderMark, mark_folder
from lagbench.work.run import Progress

distributed = pytest.importorskip(
    "distributed", reason="the extra 'cluster' is not installed"
)


@pytest.fixture(scope="module")
def workers() -> Iterator[Any]:
    """A Dask cluster of two worker processes."""
    with local_cluster() as running:
        yield running


@pytest.mark.slow
def test_a_worker_killed_and_one_slowed(
    workers: Any,
    tmp_path: Path,
    unmeasured: Registry,
    generated: GenerationResult,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """SIGKILL in mid-scenario and a slow worker: every file, the manifest too, is that
    of one machine.

    The client says that it is another machine: the manifest names those that simulated.
    """
    monkeypatch.setattr(
        campaign,
        "describe_machine",
        lambda device: {"machine": "aarch64", "device": device},
    )
    folder = tmp_path / SPLIT / SIZE / "v2"
    holders = list[Holder | None]()
    news: list[Progress] = []
    with Sabotage(tmp_path, lambda: holders.append(read_holder(folder))) as sabotage:
        there: dict[str, Any] = {
            "scheduler": workers.scheduler_address,
            "progress": news.append,
        }
        result = generate(SPLIT, SIZE, root=tmp_path, registry=unmeasured, **there)
    assert sabotage.killed is not None
    assert gone(sabotage.killed[0])
    assert sabotage.slowed
    assert result.dataset_sha256 == generated.dataset_sha256
    assert everything(folder) == everything(generated.folder)
    assert holders[0] is not None
    assert holders[0].pid == os.getpid()
    simulating = [state for state in news if state.stage == "simulating"]
    assert simulating[-1].done == simulating[-1].total
    assert simulating[-1].scenarios_done == 5
    assert writers(tmp_path) == {}


@pytest.mark.slow
def test_a_lost_scheduler_is_an_error_and_resumed(
    tmp_path: Path, unmeasured: Registry, generated: GenerationResult
) -> None:
    """SIGKILL of the scheduler: exit code 5 and what to do; the next call keeps what
    was finished.
    """
    with scheduler_process() as (address, process):

        def kill_after_one(state: Progress) -> None:
            if state.stage == "simulating" and state.scenarios_done == 1:
                process.kill()

        with pytest.raises(WorkFailedError) as caught:
            generate(
                SPLIT,
                SIZE,
                root=tmp_path,
                scheduler=address,
                progress=kill_after_one,
                registry=unmeasured,
            )
    assert caught.value.exit_code == 5
    assert "run the same command again" in str(caught.value)
    manifest = read_manifest(tmp_path, SPLIT, SIZE, 2)
    assert manifest is not None
    assert len(manifest.files) >= 1
    assert writers(tmp_path) == {}
    result = generate(SPLIT, SIZE, root=tmp_path, workers=1, registry=unmeasured)
    assert set(result.kept) >= {entry.scenario for entry in manifest.files}
    assert result.dataset_sha256 == generated.dataset_sha256


def test_a_folder_that_workers_do_not_share(
    workers: Any, tmp_path: Path, unmeasured: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers whose folder of that name holds another mark refuse; the client says
    which and why.
    """

    @contextmanager
    def elsewhere(folder: Path) -> Iterator[FolderMark]:
        with mark_folder(folder) as mark:
            yield FolderMark(mark.path, "the word of another folder", 0.0)

    monkeypatch.setattr(cluster, "mark_folder", elsewhere)
    with pytest.raises(WorkFailedError) as caught:
        generate(
            SPLIT,
            SIZE,
            root=tmp_path,
            scheduler=workers.scheduler_address,
            registry=unmeasured,
        )
    assert "--root" in str(caught.value)
    assert str(tmp_path) in str(caught.value.where)
    assert not list(tmp_path.rglob("*.nc"))


@pytest.mark.slow
def test_unfit_workers_are_refused(tmp_path: Path, unmeasured: Registry) -> None:
    """Taichi and HDF5 want a process for themselves: exit code 5, and the command for
    such workers.

    A worker with another lagbench might write other bits: it does nothing.
    """
    with pytest.raises(WorkFailedError) as caught:
        Client("c", version="0").check("w", threads=1)
    assert caught.value.where == "worker w"
    with local_cluster(threads=2) as running, pytest.raises(WorkFailedError) as caught:
        generate(
            SPLIT,
            SIZE,
            root=tmp_path,
            scheduler=running.scheduler_address,
            registry=unmeasured,
        )
    assert caught.value.exit_code == 5
    assert caught.value.got == "2 threads"
    assert not list(tmp_path.rglob("*.nc"))


@pytest.mark.slow
def test_the_command_on_a_cluster(workers: Any, tmp_path: Path) -> None:
    """The hash that datasets.yaml has."""
    command = [
        sys.executable,
        "-m",
        "lagbench",
        "generate",
        "--split",
        SPLIT,
        "--size",
        SIZE,
        "--json",
    ]
    options = ["--root", str(tmp_path), "--scheduler", workers.scheduler_address]
    done = subprocess.run(
        [*command, *options], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout)["verdict"] == "equal to datasets.yaml"
