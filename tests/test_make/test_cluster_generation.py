"""Generation on a real Dask cluster: the bytes of one machine, workers killed and
slowed or not.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
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

from lagbench.data.lock import HOLDER_NAME
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry
from lagbench.errors import WorkFailedError
from lagbench.make.generate import GenerationResult, generate
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
) -> None:
    """SIGKILL in mid-scenario and a slow worker: every file, the manifest too, is that
    of one machine.
    """
    folder = tmp_path / SPLIT / SIZE / "v2"
    holders: list[str] = []
    news: list[Progress] = []

    def note_holder() -> None:
        holders.append((folder / HOLDER_NAME).read_text())

    with Sabotage(tmp_path, note_holder) as sabotage:
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
    assert f"process {os.getpid()} " in holders[0]
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


@pytest.mark.slow
def test_unfit_workers_are_refused(tmp_path: Path, unmeasured: Registry) -> None:
    """Taichi and HDF5 want a process for themselves."""
    with local_cluster(threads=2) as running, pytest.raises(WorkFailedError) as caught:
        generate(
            SPLIT,
            SIZE,
            root=tmp_path,
            scheduler=running.scheduler_address,
            registry=unmeasured,
        )
    assert str(caught.value.where).startswith("worker ")
    assert not list(tmp_path.rglob("*.nc"))
