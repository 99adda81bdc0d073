"""The worker pool: order, errors, deaths of workers and of their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import pool_tasks
import pytest
from cluster_bench import gone

from lagbench.data.registry import PluginWarning
from lagbench.errors import LagbenchError, WorkFailedError
from lagbench.work.pool import ATTEMPTS, Pool, WorkItem

HERE = str(Path(__file__).parents[1])


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a function returns true, or fail."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def failure(name: str, function: Callable[..., object]) -> LagbenchError:
    """Return the error that a task ends a pool with."""
    with Pool(1) as pool:
        pool.submit(WorkItem(name=name, function=function))
        with pytest.raises(LagbenchError) as caught:
            list(pool.events())
    return caught.value


def test_results_come_back_costliest_first() -> None:
    """One worker takes the tasks by falling cost and returns every result and
    report.
    """
    tasks = [
        WorkItem(name=f"{n}", function=pool_tasks.square, arguments=(n,), cost=float(n))
        for n in (2, 5, 3)
    ]
    with Pool(1) as pool:
        for task in tasks:
            pool.submit(task)
        events = [(event.kind, event.value) for event in pool.events()]
    assert events == [
        *(("progress", 1), ("done", 25)),
        *(("progress", 1), ("done", 9)),
        *(("progress", 1), ("done", 4)),
    ]


def test_tasks_may_be_added_while_others_run() -> None:
    """A task submitted from within the loop runs in the same loop, in a worker that is
    there.
    """
    with Pool(2) as pool:
        pool.submit(WorkItem(name="a", function=pool_tasks.square, arguments=(2,)))
        results = []
        for event in pool.events():
            if event.kind == "done":
                results.append(event.value)
                if event.value == 4:
                    pool.submit(
                        WorkItem(name="b", function=pool_tasks.square, arguments=(7,))
                    )
        assert results == [4, 49]
        assert len(pool.process_ids()) == 1


def test_a_killed_worker_costs_one_attempt(tmp_path: Path) -> None:
    """The task of a worker killed by SIGKILL runs again in a fresh one; the lost units
    are reported.
    """
    with Pool(1) as pool:
        pool.submit(
            WorkItem(
                name="a", function=pool_tasks.die_once, arguments=(tmp_path / "seen",)
            )
        )
        events = [(event.kind, event.value) for event in pool.events()]
    assert events == [
        ("progress", 5),
        ("lost", 5),
        ("progress", 5),
        ("done", "survived"),
    ]


def test_a_task_that_always_kills_its_worker_is_given_up() -> None:
    """After three deaths the error says which task and how its workers died."""
    error = failure("cavity tiny, scenario 3", pool_tasks.die)
    text = str(error)
    assert type(error) is WorkFailedError
    assert f"died {ATTEMPTS} times" in text
    assert "cavity tiny, scenario 3" in text
    assert "SIGKILL" in text


def test_a_warning_of_ours_is_given_once_by_the_parent(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The filters of the parent count for it. Each worker would print its own."""
    with Pool(2) as pool:
        for name in ("a", "b"):
            pool.submit(WorkItem(name=name, function=pool_tasks.warn))
        with warnings.catch_warnings(record=True, action="default") as caught:
            assert [event.kind for event in pool.events()] == ["done", "done"]
    (warning,) = caught
    assert warning.category is PluginWarning
    stderr = capfd.readouterr().err
    assert "PluginWarning" not in stderr
    assert "a mean of nothing" in stderr


def test_attempts_are_counted_for_each_submission(tmp_path: Path) -> None:
    """A task that loses one worker each time it is submitted is never given up; nothing
    adds up.
    """
    marker = tmp_path / "seen"
    task = WorkItem(name="a", function=pool_tasks.die_once, arguments=(marker,))
    with Pool(1) as pool:
        for _ in range(ATTEMPTS):
            pool.submit(task)
            assert [event.kind for event in pool.events()][-1] == "done"
            marker.unlink()


def test_a_result_that_cannot_be_sent_is_an_error_of_the_task() -> None:
    """It is not taken for the death of a worker, and the worker goes on."""
    with Pool(1) as pool:
        pool.submit(WorkItem(name="a", function=pool_tasks.lock))
        with pytest.raises(WorkFailedError) as caught:
            list(pool.events())
        assert "lock" in str(caught.value)
        item = WorkItem(name="b", function=pool_tasks.square, arguments=(3,))
        pool.submit(item)
        assert [event.value for event in pool.events()] == [1, 9]


def test_leaving_the_pool_kills_its_workers(tmp_path: Path) -> None:
    """No worker outlives the with block, however busy."""
    marker = tmp_path / "pid"
    with Pool(1) as pool:
        pool.submit(
            WorkItem(name="a", function=pool_tasks.sleep_long, arguments=(marker,))
        )
        events = pool.events()
        next(events)
        process = pool.process_ids()[0]
        assert not gone(process)
    assert gone(process)


def test_workers_that_are_done_exit_by_themselves(tmp_path: Path) -> None:
    """Compiled kernels are kept as a worker ends, so one without work is not killed."""
    with Pool(1) as pool:
        pool.submit(
            WorkItem(
                name="a",
                function=pool_tasks.leave_a_note,
                arguments=(tmp_path / "note",),
            )
        )
        list(pool.events())
        process = pool.process_ids()[0]
    assert (tmp_path / "note").read_text() == "left in peace"
    assert gone(process)


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import pool_tasks
from lagbench.work.pool import Pool, WorkItem
with Pool(1) as pool:
    function = getattr(pool_tasks, sys.argv[2])
    arguments = (eval(sys.argv[3]),)
    pool.submit(WorkItem(name="a", function=function, arguments=arguments))
    print([event.value for event in pool.events()])
"""


def test_workers_die_with_their_parent(tmp_path: Path) -> None:
    """A worker whose parent is killed by SIGKILL ends by itself, even in the midst of a
    task.
    """
    marker = tmp_path / "pid"
    command = [
        sys.executable,
        "-c",
        SCRIPT,
        HERE,
        "sleep_long",
        f"Path({str(marker)!r})",
    ]
    with subprocess.Popen(command) as parent:
        wait_until(lambda: marker.exists() and marker.read_text() != "")
        worker = int(marker.read_text())
        assert not gone(worker)
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
    wait_until(lambda: gone(worker))


def test_the_calling_script_is_not_imported_again() -> None:
    """A script from standard input without a main guard may use a pool."""
    command = [sys.executable, "-", HERE, "square", "6"]
    done = subprocess.run(
        command, input=SCRIPT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[1, 36]\n"
