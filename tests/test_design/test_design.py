"""Design tasks: bounds, bits, goals against closed forms, searches that find."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from lagbench.cli.program import app
from lagbench.design.judge import (
    MOST_BYTES,
    DesignEntry,
    judge,
    known_errors,
    read_entry,
    scale_error,
    write_entry,
)
from lagbench.design.search import cma_search, random_search
from lagbench.design.tasks import load_task, mix_norm, task_names
from lagbench.errors import UnreadableFileError, UsageError


def test_all_instances_differ_and_stay_the_same() -> None:
    goals = set()
    for name in task_names():
        task = load_task(name)
        assert load_task(name) is task
        goals.add((task.goal, tuple(task.parameters), name.partition("-")[0]))
        low = task.at(np.zeros(len(task.parameters)))
        high = task.at(np.ones(len(task.parameters)))
        assert low == [parameter.low for parameter in task.parameters]
        assert high == pytest.approx([each.high for each in task.parameters])
    assert len(task_names()) == 48


def test_the_mix_norm_of_one_mode_is_its_weight() -> None:
    """Of cos(pi k x), sampled evenly, it is 1 / sqrt(2) / (1 + (pi k)^2)^(1/4)."""
    axis = (np.arange(64) + 0.5) / 64
    x, y = np.meshgrid(axis, axis, indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=-1)
    for k in (1, 4):
        mark = np.cos(np.pi * k * places[:, 0])
        expected = math.sqrt(0.5) * (1.0 + (math.pi * k) ** 2) ** -0.25
        assert mix_norm(places, mark) == pytest.approx(expected)


def test_a_bucket_around_all_particles_has_no_error() -> None:
    task = load_task("pour-00")
    values = task.check(task.at(np.full(4, 0.5)))
    inside = np.full((20, 5, 2), (0.74, 0.2))
    assert task.measure(inside, values) == 0.0
    above = inside + np.array([0.0, 0.25])  # 0.1 above the bucket
    assert task.measure(above, values) == pytest.approx(0.1)


def test_parameters_out_of_bounds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "entry.json"
    for parameters in (
        {"pour-00": [0.3, 0.3, 99.0, 0.0]},
        {"pour-00": [0.3]},
        {"pour-99": [0.3, 0.3, 1.0, 0.0]},
    ):
        path.write_text(json.dumps({"method": "x", "parameters": parameters}))
        with pytest.raises(UsageError):
            read_entry(path)
    path.write_text("{}")
    with pytest.raises(UnreadableFileError):
        read_entry(path)


@pytest.mark.slow
def test_one_and_two_workers_judge_alike_and_a_call_goes_on(tmp_path: Path) -> None:
    """The verdict has the same hash; what is in the results is not judged again."""
    parameters = {}
    for name in ("pour-00", "identify-01"):
        task = load_task(name)
        parameters[name] = task.at(np.full(len(task.parameters), 0.4))
    entry = DesignEntry(method="fixed", parameters=parameters)
    results = tmp_path / "results.json"
    first = DesignEntry(method="fixed", parameters={"pour-00": parameters["pour-00"]})
    alone = judge(first, results=results)
    both = judge(entry, workers=2, results=results)
    assert both["pour-00"] == alone["pour-00"]
    assert judge(entry, workers=2) == both
    assert read_entry(results).verdicts == both
    task = load_task("pour-00")
    assert both["pour-00"].error == task.error(parameters["pour-00"])


@pytest.mark.slow
def test_a_killed_judgement_goes_on_to_the_same_hashes(tmp_path: Path) -> None:
    parameters = {}
    for name in ("identify-01", "identify-03", "identify-05"):
        task = load_task(name)
        parameters[name] = task.at(np.full(len(task.parameters), 0.4))
    entry = DesignEntry(method="fixed", parameters=parameters)
    path = tmp_path / "entry.json"
    write_entry(entry, path)
    results = tmp_path / "results.json"
    words = ["-m", "lagbench", "design", "judge", str(path), "--results", str(results)]
    process = subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL)
    while not results.exists():
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert judge(entry, results=results) == judge(entry)


@pytest.mark.slow
def test_a_coarser_run_is_near_that_of_the_judge() -> None:
    for name in ("pour-00", "stir-00", "identify-01"):
        task = load_task(name)
        values = task.at(np.full(len(task.parameters), 0.4))
        coarse = task.objective(values, refinement=0.5)
        assert coarse == pytest.approx(task.objective(values), rel=0.15)


@pytest.mark.slow
def test_searches_find_the_friction_that_is_looked_for() -> None:
    """CMA-ES is nearer to the unknown friction than random draws of as many runs."""
    task = load_task("identify-01")
    drawn = random_search(task, task.objective, runs=60, seed=0)
    found = cma_search(task, task.objective, runs=60, seed=0)
    assert task.objective(found) < task.objective(drawn)
    assert task.truth is not None
    assert task.error(task.truth) == 0.0


def test_a_searcher_that_goes_on_began_alike() -> None:
    """The runs of a short search are the first runs of a long one."""
    task = load_task("stir-00")
    for search in (random_search, cma_search):
        asked: dict[int, list[list[float]]] = {}
        for runs in (5, 30):
            asked[runs] = []

            def objective(
                values: Sequence[float], asked: list[list[float]] = asked[runs]
            ) -> float:
                asked.append(list(values))
                return sum(values)

            search(task, objective, runs=runs, seed=1)
        assert len(asked[30]) == 30
        assert asked[5] == asked[30][:5]


def test_the_command_exits_with_the_class_of_the_error(tmp_path: Path) -> None:
    path = tmp_path / "entry.json"
    assert app(["design", "judge", str(path)]) == UnreadableFileError.exit_code
    path.write_text('{"method": "x", "parameters": {"pour-00": [NaN, 0, 0, 0]}}')
    assert app(["design", "judge", str(path)]) == UsageError.exit_code
    path.write_text(" " * (MOST_BYTES + 1))
    assert app(["design", "judge", str(path)]) == UnreadableFileError.exit_code
    assert app(["design", "info", "pour-99"]) == UsageError.exit_code


def test_scores_are_between_the_random_draws_and_the_best_known() -> None:
    for name, known in known_errors().items():
        assert known.best <= known.random
        load_task(name).check(known.parameters)
        if known.best < known.random:
            assert scale_error(name, known.random) == 0.0
            assert scale_error(name, known.best) == 1.0
            assert scale_error(name, None) == 0.0


@pytest.mark.slow
def test_the_example_hands_in_an_entry(tmp_path: Path) -> None:
    path = tmp_path / "entry.json"
    example = Path(__file__).parents[2] / "docs" / "examples" / "design" / "search.py"
    subprocess.run([sys.executable, example, "--runs", "3", "-o", path], check=True)
    task = load_task("pour-00")
    values = read_entry(path).parameters["pour-00"]
    assert task.error(values) <= task.error(task.at([0.5, 0.5, 0.5, 0.5]))
