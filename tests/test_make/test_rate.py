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
from command_line import Result
from conftest import SIZE, SPLIT

from lagbench.data.registry import Registry, Size, load
from lagbench.generators.batch import (
    SimulationJob,
    SimulationPace,
    perturbed_substep_count,
    substep_count,
)
from lagbench.generators.simulate import simulate
from lagbench.make.generate import generate
from lagbench.make.plan import estimate, measured_ratio, note_pace, reference_seconds

Run = Callable[..., Result]

HERE = {"machine": platform.node()}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own, in which nothing is measured yet."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("LAGBENCH_CACHE", str(folder))
    return folder


def noted(cache: Path, **kinds: Any) -> None:
    """Write what was measured, as a generation would."""
    cache.mkdir(exist_ok=True)
    text = json.dumps(HERE | kinds)
    (cache / "rates.json").write_text(text)


def test_a_liquid_in_space_starts_sooner_than_solids() -> None:
    """The kernel without solids compiles in about half of the time."""
    liquid = estimate(load().size("fluid-3d", "tiny"), [0])
    solids = estimate(load().size("multimaterial-3d", "tiny"), [0])
    assert liquid.start_seconds < 0.6 * solids.start_seconds


WORK = (1_000_000, 100)
PLAIN = reference_seconds(*WORK, kind="free_surface")
GOOD = {"256": [2 * PLAIN, *WORK]}


def pace(slowness: float) -> SimulationPace:
    """Return what so slow a machine measures."""
    particle_substeps, frames = WORK
    return SimulationPace(
        seconds=slowness * PLAIN,
        particle_substeps=particle_substeps,
        frames=frames,
    )


@pytest.fixture
def size(unmeasured: Registry) -> Size:
    """A size with a free surface of 256 particles."""
    return unmeasured.size("fluid", "tiny")


def test_a_measured_rate_decides(cache: Path, size: Size) -> None:
    """Whoever took 300 s for three times the work takes 100 s: 2 * 465 * 256 particle
    substeps, 64 frames.
    """
    scenarios = (0, 1)
    assert not estimate(size, scenarios).measured
    seconds = 300.0
    particle_substeps = 2 * 465 * 256
    frames = 64
    row = [seconds, 3 * particle_substeps, 3 * frames]
    noted(cache, free_surface={"256": row})
    expected = estimate(size, scenarios)
    assert expected.measured
    assert expected.core_seconds == pytest.approx(100.0)


def test_perturbed_runs_of_test_scenarios_are_counted() -> None:
    """What generating simulates: every substep of scenarios and of perturbed runs,
    which end with the horizon.
    """
    size = load().size("cavity", "mini")
    test = size.subsets["test"]
    perturbed = 0
    plain = 0
    frames = 0
    for scenario in test:
        perturbed += perturbed_substep_count(size, scenario)
        plain += substep_count(size, scenario)
        frames += size.frame_count(scenario)
        frames += size.task.input_frames + size.task.horizon
    assert perturbed < plain
    particle_substeps = (plain + perturbed) * size.particles
    expected = reference_seconds(particle_substeps, frames, kind="closed_box")
    seconds = estimate(size, test).core_seconds
    assert seconds == pytest.approx(expected)


def test_the_nearest_number_of_particles_stands_in(cache: Path, size: Size) -> None:
    """By ratio, of the same kind of solver alone; another machine's rates count for
    nothing.
    """
    assert size.particles == 256
    slow = [2 * PLAIN, *WORK]
    slower = [3 * PLAIN, *WORK]
    noted(
        cache,
        free_surface={"100": slow, "600": slower},
        closed_box={"256": slow},
    )
    assert measured_ratio(size) == pytest.approx(3.0)
    noted(cache, closed_box={"256": slow})
    assert measured_ratio(size) is None
    another_machine = "another " + platform.node()
    noted(cache, free_surface=GOOD, machine=another_machine)
    assert measured_ratio(size) is None


GOOD_ROW = GOOD["256"]


def rates(particles: str, row: object) -> dict[str, Any]:
    """Return the content of a file with one rate."""
    return HERE | {"free_surface": {particles: row}}


DAMAGED: dict[str, Any] = {
    "empty": "",
    "list": [],
    "binary": "\udc80",
    "deep": "[" * 100_000,
    "long": rates("256", GOOD_ROW) | {"x": "y" * 1_000_000},
    "machine": {"free_surface": GOOD},
    "rows": HERE | {"free_surface": GOOD_ROW},
    "nobody": rates("-256", GOOD_ROW),
    "words": rates("many", GOOD_ROW),
    "digits": rates("9" * 5000, GOOD_ROW),
    "void": rates("256", []),
    "half": rates("256", [1.0, 1000]),
    "text": rates("256", [1.0, 1000, "100"]),
    "zero": rates("256", [0.0, *WORK]),
    "negative": rates("256", [1.0, -1000, 100]),
    "centuries": rates("256", [1e8, *WORK]),
    "nan": rates("256", [float("nan"), *WORK]),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_rates_are_passed_over(damage: str, cache: Path, size: Size) -> None:
    """A file that is no rate, or that no machine could have, leaves the estimate; the
    next note mends it.
    """
    expected = estimate(size, (0,))
    cache.mkdir()
    text = DAMAGED[damage]
    if not isinstance(text, str):
        text = json.dumps(text)
    content = text.encode(errors="surrogateescape")
    (cache / "rates.json").write_bytes(content)
    assert estimate(size, (0,)) == expected
    note_pace(size, [pace(5.0)])
    assert measured_ratio(size) == pytest.approx(5.0)


def test_notes_add_up_and_stay_few(cache: Path, size: Size) -> None:
    """What counts is the sum of seconds over the sum of work; the file stays small
    whatever is simulated.
    """
    paces = [pace(1.0), pace(3.0)]
    note_pace(size, paces)
    assert measured_ratio(size) == pytest.approx(2.0)
    many = {}
    for particles in range(1000, 1200):
        many[str(particles)] = GOOD_ROW
    noted(cache, free_surface=many)
    note_pace(size, paces)
    rates_file = cache / "rates.json"
    content = json.loads(rates_file.read_text())
    rows = content["free_surface"]
    assert len(rows) <= 32
    particle_substeps, frames = WORK
    expected = [4 * PLAIN, 2 * particle_substeps, 2 * frames]
    assert rows["256"] == pytest.approx(expected)
    note_pace(size, [])
    assert json.loads(rates_file.read_text()) == content


@pytest.mark.slow
def test_a_worker_measures_what_it_does(tmp_path: Path, unmeasured: Registry) -> None:
    """The time from the second frame on, when everything is compiled, to the end of the
    file.
    """
    size = unmeasured.size(SPLIT, SIZE)
    job = SimulationJob(size=size, scenarios=(0,), root=tmp_path)
    times = itertools.accumulate(itertools.count(10, 10))

    def clock() -> float:
        return float(next(times))

    (scenario,) = simulate(job, lambda _: None, clock=clock)
    steps = size.frame_count(0) - 2
    substeps = steps * size.substeps_per_frame * size.particles
    # The clock says 10, 30, 60: before the first frame, after the second, in the end.
    expected = SimulationPace(
        seconds=30.0,
        particle_substeps=substeps,
        frames=steps,
    )
    assert scenario.pace == expected


NOT_YET = "measured after the first generate"


@pytest.mark.slow
def test_generations_measure(run: Run, cache: Path, tmp_path: Path) -> None:
    """Before the first one tables say that times are estimated, after it that they are
    measured here.
    """
    root = ("--root", tmp_path)
    tiny_split = (SPLIT, "--size", SIZE, *root)

    def printed(*words: object) -> str:
        return run(*words).stdout

    def printed_data(*words: object) -> dict[str, Any]:
        data: dict[str, Any] = json.loads(printed(*words, "--json"))
        return data

    plan = ("generate", *tiny_split, "--scenarios", "1", "--dry-run")
    assert NOT_YET in printed(*plan)
    assert NOT_YET in printed("list", *root)
    assert printed_data(*plan)["measured"] is False
    assert not cache.exists()
    result = run("generate", *tiny_split, "--scenarios", "0")
    assert result.exit_code == 0
    content = json.loads((cache / "rates.json").read_text())
    assert content.keys() == {"machine", "closed_box"}
    ((particles, row),) = content["closed_box"].items()
    seconds, particle_substeps, frames = row
    assert printed_data(*plan)["measured"] is True
    assert NOT_YET not in printed(*plan)

    sizes = printed_data("list", *root)["sizes"]
    measured_splits = {size["split"] for size in sizes if size["measured"]}
    assert measured_splits == {"cavity", SPLIT}
    information = printed_data("info", SPLIT, *root)
    tiny = information["sizes"][SIZE]["overview"]
    assert tiny["measured"]
    assert int(particles) == tiny["particles"]
    assert seconds > 0.0
    assert particle_substeps == frames * 12 * 506


def test_a_cache_that_cannot_be_written_is_no_loss(
    cache: Path, tmp_path: Path, unmeasured: Registry
) -> None:
    """The data set is made all the same, and the rate of another device does not count
    for this one.
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
