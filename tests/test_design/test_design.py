"""Design tasks: bounds, bits, goals against closed forms, searches that find."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from lagbench.design.judge import Entry, judge, read_entry
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
    """The judgement has the same hash; what is in the results is not judged again."""
    parameters = {}
    for name in ("pour-00", "identify-01"):
        task = load_task(name)
        parameters[name] = task.at(np.full(len(task.parameters), 0.4))
    entry = Entry(method="fixed", parameters=parameters)
    results = tmp_path / "results.json"
    first = Entry(method="fixed", parameters={"pour-00": parameters["pour-00"]})
    alone = judge(first, results=results)
    both = judge(entry, workers=2, results=results)
    assert both[0] == alone[0]
    assert judge(entry, workers=2) == both
    task = load_task("pour-00")
    assert both[0].error == task.error(parameters["pour-00"])


@pytest.mark.slow
def test_searches_find_the_friction_that_is_looked_for() -> None:
    """CMA-ES is nearer to the unknown friction than random draws of as many runs."""
    task = load_task("identify-01")
    drawn = random_search(task, task.objective, runs=60, seed=0)
    found = cma_search(task, task.objective, runs=60, seed=0)
    assert task.objective(found) < task.objective(drawn)
