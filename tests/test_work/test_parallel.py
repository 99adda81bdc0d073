"""Jobs here, in processes and on a real Dask cluster: the same results, workers killed
or not.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cluster_bench import gone, local_cluster, scheduler_process
from parallel_jobs import (
    Deadly,
    double,
    refuse,
    sit_after_dying_once,
    take_worker_along,
    time_out,
)
from score_bench import ScoreBench, bench_of, straight

from lagbench.data.registry import Registry
from lagbench.errors import DataError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.scoring import score
from lagbench.scoring.score import ScenarioJob, ScenarioScores
from lagbench.work import run
from lagbench.work.executor import WorkItem, run_items

HERE = str(Path(__file__).parents[1])
JOBS = {f"job {i}": i for i in range(6)}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A Dask cluster of two worker processes that can import the test modules."""
    with local_cluster() as running:
        yield running


@pytest.fixture(scope="module")
def bench(generated: GenerationResult, unmeasured: Registry) -> ScoreBench:
    """Tiny curl noise."""
    return bench_of(generated, unmeasured)


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order(workers: int) -> None:
    """Though later ones end first; every unit is counted."""
    units: list[int] = []
    results = run.run_all(double, JOBS, workers=workers, report=units.append)
    assert results == [0, 2, 4, 6, 8, 10]
    assert sum(units) == 6


def test_the_costliest_items_start_first() -> None:
    items = []
    for cost in (2, 5, 3):
        item = WorkItem(name=f"{cost}", function=double, argument=cost, cost=cost)
        items.append(item)
    assert [finished.value for finished in run_items(items)] == [10, 6, 4]


def test_items_that_kill_their_workers_are_given_up() -> None:
    with pytest.raises(WorkFailedError) as caught:
        list(run_items([WorkItem(name="a", function=take_worker_along, argument=0)]))
    assert caught.value.where == "a"


def test_an_error_of_an_item_arrives_as_it_is() -> None:
    with pytest.raises(DataError) as caught:
        list(run_items([WorkItem(name="a", function=refuse, argument=0)]))
    assert caught.value.where == "here"


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import parallel_jobs
from lagbench.work.executor import WorkItem, run_items
function = getattr(parallel_jobs, sys.argv[2])
argument = eval(sys.argv[3])
item = WorkItem(name="a", function=function, argument=argument)
print([finished.value for finished in run_items([item])])
"""


def test_the_calling_script_is_not_imported_again() -> None:
    """A script from standard input without a main guard may use workers."""
    command = [sys.executable, "-", HERE, "double", "6"]
    done = subprocess.run(
        command, input=SCRIPT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[12]\n"


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a function returns true, or fail."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def test_workers_die_with_their_parent(tmp_path: Path) -> None:
    """Even in the midst of an item."""
    marker = tmp_path / "pid"
    argument = f"Path({str(marker)!r})"
    command = [sys.executable, "-c", SCRIPT, HERE, "sleep_long", argument]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as parent:
        wait_until(lambda: marker.exists() and marker.read_text() != "")
        worker = int(marker.read_text())
        assert not gone(worker)
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
    wait_until(lambda: gone(worker))


@pytest.mark.slow
@pytest.mark.parametrize("place", ["processes", "cluster"])
def test_scores_are_those_of_one_process_though_a_worker_is_killed(
    place: str,
    bench: ScoreBench,
    cluster: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """scores.json and scores.nc are equal to the byte."""
    source = bench.submit(tmp_path / "predictions.nc", straight)
    here = bench.score(source, output_dir=tmp_path / "here")
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
    options: dict[str, Any] = {"workers": 2}
    if place == "cluster":
        options = {"scheduler": cluster.scheduler_address}
    there = bench.score(source, output_dir=tmp_path / "there", **options)
    assert marker.exists()
    for mine, other in zip(here.files, there.files, strict=True):
        assert mine.read_bytes() == other.read_bytes()


def test_a_lost_scheduler_is_failed_work() -> None:
    with (
        scheduler_process() as (address, _),
        pytest.raises(WorkFailedError) as caught,
    ):
        run.run_all(take_worker_along, {"job 0": 0}, scheduler=address)
    assert caught.value.where == "--scheduler"


@pytest.mark.slow
def test_an_error_of_a_job_is_not_a_lost_cluster(cluster: Any) -> None:
    with pytest.raises(TimeoutError):
        run.run_all(time_out, {"job 0": 0}, scheduler=cluster.scheduler_address)
