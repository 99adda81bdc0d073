"""What this machine's generations measured decides estimates of time, and nothing else
does.
"""

from __future__ import annotations

import itertools
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from conftest import SIZE, SPLIT

from lagbench.data.registry import Registry, load
from lagbench.generators.batch import SimulationJob, SimulationPace, substep_count
from lagbench.generators.simulate import (
    perturbed_substep_count,
    simulate,
)
from lagbench.make.generate import generate
from lagbench.make.plan import estimate, measured_ratio, note_pace, reference_seconds

Run = Callable[..., Result]

HERE = {"machine": platform.node()}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own, in which nothing is measured yet."""
    monkeypatch.setenv("LAGBENCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def noted(cache: Path, **kinds: Any) -> None:
    """Write what was measured, as a generation would."""
    cache.mkdir(exist_ok=True)
    (cache / "rates.json").write_text(json.dumps(HERE | kinds))


WORK = (1_000_000, 100)
PLAIN = reference_seconds(*WORK)
GOOD = {"256": [2 * PLAIN, *WORK]}


def pace(slowness: float) -> SimulationPace:
    """Return what so slow a machine measures."""
    return SimulationPace(
        seconds=slowness * PLAIN, particle_substeps=WORK[0], frames=WORK[1]
    )


def test_a_measured_rate_decides(cache: Path, unmeasured: Registry) -> None:
    """Whoever took 300 s for three times the work takes 100 s: 2 * 465 * 256 particle
    substeps, 64 frames.
    """
    size = unmeasured.size("fluid", "tiny")
    assert not estimate(size, (0, 1)).measured
    noted(cache, free_surface={"256": [300.0, 3 * 2 * 465 * 256, 3 * 64]})
    expected = estimate(size, (0, 1))
    assert expected.measured
    assert expected.core_seconds == pytest.approx(100.0)


def test_perturbed_runs_of_test_scenarios_are_counted() -> None:
    """What generating simulates: every substep of scenarios and of perturbed runs,
    which end with the horizon.
    """
    size = load().size("cavity", "mini")
    test = size.subsets["test"]
    perturbed = sum(perturbed_substep_count(size, i) for i in test)
    plain = sum(substep_count(size, i) for i in test)
    assert perturbed < plain
    perturbed_frames = len(test) * (size.task.input_frames + size.task.horizon)
    frames = sum(map(size.frame_count, test)) + perturbed_frames
    expected = reference_seconds((plain + perturbed) * size.particles, frames)
    assert estimate(size, test).core_seconds == pytest.approx(expected)


def test_the_nearest_number_of_particles_stands_in(
    cache: Path, unmeasured: Registry
) -> None:
    """By ratio, of the same kind of solver alone; another machine's rates count for
    nothing.
    """
    size = unmeasured.size("fluid", "tiny")
    assert size.particles == 256
    slow = [2 * PLAIN, *WORK]
    slower = [3 * PLAIN, *WORK]
    noted(cache, free_surface={"100": slow, "600": slower}, closed_box={"256": slow})
    assert measured_ratio(size) == pytest.approx(3.0)
    noted(cache, closed_box={"256": slow})
    assert measured_ratio(size) is None
    noted(cache, free_surface=GOOD, machine="another " + platform.node())
    assert measured_ratio(size) is None


DAMAGED: dict[str, Any] = {
    "empty": "",
    "list": [],
    "binary": "\udc80",
    "deep": "[" * 100_000,
    "long": {**HERE, "free_surface": GOOD, "x": "y" * 1_000_000},
    "machine": {"free_surface": GOOD},
    "rows": {**HERE, "free_surface": GOOD["256"]},
    "nobody": {**HERE, "free_surface": {"-256": GOOD["256"]}},
    "words": {**HERE, "free_surface": {"many": GOOD["256"]}},
    "digits": {**HERE, "free_surface": {"9" * 5000: GOOD["256"]}},
    "void": {**HERE, "free_surface": {"256": []}},
    "half": {**HERE, "free_surface": {"256": [1.0, 1000]}},
    "text": {**HERE, "free_surface": {"256": [1.0, 1000, "100"]}},
    "zero": {**HERE, "free_surface": {"256": [0.0, *WORK]}},
    "negative": {**HERE, "free_surface": {"256": [1.0, -1000, 100]}},
    "centuries": {**HERE, "free_surface": {"256": [1e8, *WORK]}},
    "nan": {**HERE, "free_surface": {"256": [float("nan"), *WORK]}},
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_rates_are_passed_over(
    damage: str, cache: Path, unmeasured: Registry
) -> None:
    """A file that is no rate, or that no machine could have, leaves the estimate; the
    next note mends it.
    """
    size = unmeasured.size("fluid", "tiny")
    expected = estimate(size, (0,))
    cache.mkdir()
    text = DAMAGED[damage]
    if not isinstance(text, str):
        text = json.dumps(text)
    (cache / "rates.json").write_bytes(text.encode(errors="surrogateescape"))
    assert estimate(size, (0,)) == expected
    note_pace(size, [pace(5.0)])
    assert measured_ratio(size) == pytest.approx(5.0)


def test_notes_add_up_and_stay_few(cache: Path, unmeasured: Registry) -> None:
    """What counts is the sum of seconds over the sum of work; the file stays small
    whatever is simulated.
    """
    size = unmeasured.size("fluid", "tiny")
    paces = [pace(1.0), pace(3.0)]
    note_pace(size, paces)
    assert measured_ratio(size) == pytest.approx(2.0)
    noted(cache, free_surface={str(n): GOOD["256"] for n in range(1000, 1200)})
    note_pace(size, paces)
    rates_file = cache / "rates.json"
    rates = json.loads(rates_file.read_text())
    assert len(rates["free_surface"]) <= 32
    expected = [4 * PLAIN, 2 * WORK[0], 2 * WORK[1]]
    assert rates["free_surface"]["256"] == pytest.approx(expected)
    note_pace(size, [])
    assert json.loads(rates_file.read_text()) == rates


def test_a_worker_measures_what_it_does(tmp_path: Path, unmeasured: Registry) -> None:
    """The time from the second frame on, when everything is compiled, to the end of the
    file.
    """
    size = unmeasured.size(SPLIT, SIZE)
    job = SimulationJob(size=size, scenarios=(0,), root=tmp_path)
    times = itertools.accumulate(itertools.count(10, 10))
    (scenario,) = simulate(job, lambda _: None, clock=lambda: float(next(times)))
    steps = size.frame_count(0) - 2
    substeps = steps * size.substeps_per_frame * size.particles
    # The clock says 10, 30, 60: before the first frame, after the second, in the end.
    expected = SimulationPace(seconds=30.0, particle_substeps=substeps, frames=steps)
    assert scenario.pace == expected


def test_generations_measure(run: Run, cache: Path, tmp_path: Path) -> None:
    """Before the first one tables say that times are estimated, after it that they are
    measured here.
    """
    root = ("--root", tmp_path)
    plan = ("generate", SPLIT, "--size", SIZE, *root, "--scenarios", "1", "--dry-run")
    assert "measured after the first generate" in run(*plan).stdout
    assert "measured after the first generate" in run("list", *root).stdout
    assert json.loads(run(*plan, "--json").stdout)["measured"] is False
    assert not cache.exists()
    assert run(*plan[:4], *root, "--scenarios", "0").exit_code == 0
    rates = json.loads((cache / "rates.json").read_text())
    assert rates.keys() == {"machine", "closed_box"}
    ((particles, row),) = rates["closed_box"].items()
    seconds, particle_substeps, frames = row
    assert json.loads(run(*plan, "--json").stdout)["measured"] is True
    assert "measured after the first generate" not in run(*plan).stdout

    sizes = json.loads(run("list", *root, "--json").stdout)["sizes"]
    measured_splits = {size["split"] for size in sizes if size["measured"]}
    assert measured_splits == {"cavity", SPLIT}
    information = json.loads(run("info", SPLIT, *root, "--json").stdout)
    tiny = information["sizes"][SIZE]["overview"]
    assert tiny["measured"]
    assert int(particles) == tiny["particles"]
    assert seconds > 0.0
    assert particle_substeps == frames * 12 * 506


def test_a_cache_that_cannot_be_written_is_no_loss(
    cache: Path, tmp_path: Path, unmeasured: Registry
) -> None:
    """The data set is made all the same, and another device's rate is not taken for
    this one's.
    """
    cache.write_text("a file")
    result = generate(
        SPLIT,
        SIZE,
        scenarios="0",
        root=tmp_path / "root",
        registry=unmeasured,
    )
    assert result.simulated == (0,)
    cache.unlink()
    noted(cache, closed_box=GOOD)
    options: dict[str, Any] = {
        "root": tmp_path / "new",
        "registry": unmeasured,
        "dry_run": True,
    }
    assert generate(SPLIT, SIZE, **options).measured
    assert not generate(SPLIT, SIZE, device="cuda", **options).measured
