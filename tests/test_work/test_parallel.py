"""Jobs here, in processes and on a real Dask cluster: the same results, workers killed
or not.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cluster_bench import local_cluster, scheduler_process
from parallel_jobs import (
    Deadly,
    double,
    sit_after_dying_once,
    take_worker_along,
    time_out,
)
from score_bench import ScoreBench, bench_of, straight

from lagbench.data.registry import Registry
from lagbench.errors import WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.scoring import score
from lagbench.scoring.score import ScenarioJob, ScenarioScores
from lagbench.work import run
from lagbench.work.pool import Report

distributed = pytest.importorskip(
    "distributed", reason="the extra 'cluster' is not installed"
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A Dask cluster of two worker processes that can import the test modules."""
    with local_cluster() as running:
        yield running


@pytest.fixture(scope="module")
def bench(generated: GenerationResult, unmeasured: Registry) -> ScoreBench:
    """Tiny curl noise."""
    return bench_of(generated, unmeasured)


@pytest.fixture
def losable() -> Iterator[str]:
    """The address of a scheduler that dies with its worker."""
    with scheduler_process() as (address, _):
        yield address


JOBS = {f"job {i}": i for i in range(6)}


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order(workers: int) -> None:
    """Results stand in the order of the jobs although later ones end first; every unit
    is counted.
    """
    units: list[int] = []
    assert run.run_all(double, JOBS, workers=workers, report=units.append) == [
        0,
        2,
        4,
        6,
        8,
        10,
    ]
    assert sum(units) == 6


@pytest.mark.slow
def test_cluster_gives_the_same_bytes_though_a_worker_is_killed(
    bench: ScoreBench, cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """scores.json and scores.nc from two cluster workers, one killed in the middle,
    equal those from here.
    """
    source = bench.submit(tmp_path / "predictions.nc", straight)
    here = bench.score(source, output_dir=tmp_path / "here")
    address = cluster.scheduler_address
    there = bench.score(source, output_dir=tmp_path / "there", scheduler=address)
    marker = tmp_path / "killed"

    def killing(
        function: Any, jobs: dict[str, ScenarioJob], **options: Any
    ) -> list[ScenarioScores]:
        first = next(iter(jobs))
        held = {
            name: Deadly(job, marker if name == first else None)
            for name, job in jobs.items()
        }
        return run.run_all(sit_after_dying_once, held, **options)

    monkeypatch.setattr(score, "run_all", killing)
    survived = bench.score(source, output_dir=tmp_path / "survived", scheduler=address)
    assert marker.exists()
    for card in (there, survived):
        for mine, other in zip(here.files, card.files, strict=True):
            assert mine.read_bytes() == other.read_bytes()


def test_a_lost_scheduler(losable: str, capfd: pytest.CaptureFixture[str]) -> None:
    """A scheduler that dies in the middle ends as failed work that says so, without
    Dask's traces.
    """
    with pytest.raises(WorkFailedError) as caught:
        run.run_all(take_worker_along, {"job 0": 0}, scheduler=losable)
    assert caught.value.where == "--scheduler"
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


@pytest.mark.slow
def test_a_killed_process_changes_nothing(
    bench: ScoreBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two worker processes, one killed in the middle: the same bytes as from one."""
    source = bench.submit(tmp_path / "predictions.nc", straight)
    here = bench.score(source, output_dir=tmp_path / "here", workers=1)
    marker = tmp_path / "killed"
    counted = []

    def killing(
        function: Any, jobs: dict[str, ScenarioJob], *, report: Report, **options: Any
    ) -> list[ScenarioScores]:
        held = {name: Deadly(job, marker) for name, job in jobs.items()}

        def count(units: int) -> None:
            counted.append(units)
            report(units)

        return run.run_all(sit_after_dying_once, held, report=count, **options)

    monkeypatch.setattr(score, "run_all", killing)
    there = bench.score(source, output_dir=tmp_path / "there", workers=2)
    assert marker.exists()
    assert sum(counted) == 2 * bench.size.task.horizon
    for mine, other in zip(here.files, there.files, strict=True):
        assert mine.read_bytes() == other.read_bytes()


@pytest.mark.slow
def test_an_error_of_a_job_is_not_a_lost_cluster(cluster: Any) -> None:
    """The time-out of a job itself arrives as it is."""
    with pytest.raises(WorkFailedError):
        run.run_all(time_out, {"job 0": 0}, scheduler=cluster.scheduler_address)
