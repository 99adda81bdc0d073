"""The registry: the numbers of design and thesis; mistakes, limits and packages of
others that are named.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import yaml

from lagbench.data import registry
from lagbench.data.box import Box
from lagbench.data.limits import NEEDED, SUBSETS, check_parameters
from lagbench.data.local import load_rooted_registry
from lagbench.data.registry import Registry, Size, default_path, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.generators.constants import LIMITS
from lagbench.make.generate import generate
from lagbench.make.verify import verify

SPLITS = ("fluid", "multimaterial", "cavity", "curl-noise")
LARGE_RELATIVES = (
    "decaying-vortices",
    "poiseuille",
    "curl-noise-3d",
    "cavity-3d",
    "cylinder",
    "fluid-3d",
    "multimaterial-3d",
)


@pytest.mark.parametrize(
    ("split", "interval", "expected"),
    [
        ("fluid", 1 / 60, (2500, 128, 60, 22_800, 28, 8, 16)),
        ("multimaterial", 1 / 60, (2500, 64, 108, 43_200, 48, 8, 16)),
        ("cavity", 0.1, (8192, 40, 50, 45_600, 48, 8, 20)),
        ("curl-noise", 0.1, (8096, 40, 50, 43_200, 48, 8, 16)),
        ("decaying-vortices", 0.1, (16_384, 64, 48, 14_400, 48, 8, 16)),
        ("poiseuille", 0.1, (16_384, 64, 48, 8_640, 48, 8, 16)),
        ("curl-noise-3d", 0.1, (54_872, 24, 18, 6_912, 48, 8, 16)),
        ("cavity-3d", 0.1, (54_872, 24, 36, 6_912, 48, 8, 16)),
        ("cylinder", 1 / 16, (40_512, 128, 60, 7_200, 48, 8, 16)),
        ("fluid-3d", 1 / 60, (20_736, 48, 24, 10_800, 48, 8, 16)),
        ("multimaterial-3d", 1 / 60, (13_824, 48, 54, 10_800, 48, 8, 16)),
    ],
)
def test_full_sizes_are_those_of_the_documentation(
    split: str, interval: float, expected: tuple[int, ...]
) -> None:
    """Particles, grid, substeps, frames and scenarios of train, valid and test."""
    full = load().size(split, "full")
    frame_count = 0
    scenario_counts = []
    for name in ("train", "valid", "test"):
        scenarios = full.subsets[name]
        scenario_counts.append(len(scenarios))
        frame_count += sum(map(full.frame_count, scenarios))
    numbers = (
        full.particles,
        full.grid,
        full.substeps_per_frame,
        frame_count,
        *scenario_counts,
    )
    assert numbers == expected
    assert full.frame_interval == pytest.approx(interval, rel=1e-15)
    substep = interval / full.substeps_per_frame
    assert full.dt == pytest.approx(substep, rel=1e-15)


def run_of_ids(first: int, last: int) -> tuple[int, ...]:
    """Return consecutive ids of scenarios."""
    return tuple(range(first, last + 1))


@pytest.mark.parametrize("size", ["full", "mini", "tiny"])
@pytest.mark.parametrize("split", SPLITS)
def test_every_size_is_consistent(split: str, size: str) -> None:
    """Frames cover the task, frames of interest are predicted ones, bounds lie in the
    unit box.
    """
    entry = load().size(split, size)
    task = entry.task
    last = task.input_frames + task.horizon - 1
    for scenario in entry.subsets["test"]:
        assert entry.frame_count(scenario) > last
    for frame in task.frames_of_interest:
        assert task.input_frames <= frame <= last
    for low, high in entry.bounds:
        assert 0.0 < low < high < 1.0
        assert low + high == pytest.approx(1.0, abs=1e-12)
    assert set(entry.subsets) <= set(SUBSETS)
    all_scenarios = set().union(*entry.subsets.values())
    assert entry.scenarios == tuple(sorted(all_scenarios))
    for parameter in entry.parameters.values():
        assert parameter.unit
        assert parameter.description
        assert parameter.value is not None


def particles_per_cell(size: Size) -> float:
    """Return how many particles a cell between the walls has."""
    low, high = size.bounds[0]
    cells = (high - low) * size.grid
    return size.particles / cells**2


@pytest.mark.parametrize("split", SPLITS)
def test_mini_and_tiny_are_small_relatives(split: str) -> None:
    """As many particles per cell, the same frame interval, substeps as cells; tiny for
    tests.
    """
    registry = load()
    full = registry.size(split, "full")
    mini = registry.size(split, "mini")
    tiny = registry.size(split, "tiny")
    if split in ("cavity", "curl-noise"):
        expected = particles_per_cell(full)
        assert particles_per_cell(mini) == pytest.approx(expected, rel=0.06)
    else:
        assert mini.particles == full.particles / 4
    assert mini.frame_interval == full.frame_interval
    assert tiny.frame_interval == full.frame_interval
    substeps_per_cell = full.substeps_per_frame / full.grid
    assert mini.substeps_per_frame / mini.grid == substeps_per_cell
    assert 256 <= tiny.particles <= 640
    assert len(mini.subsets["train"]) == 24
    assert mini.scenarios == run_of_ids(0, len(mini.scenarios) - 1)


@pytest.mark.parametrize("split", LARGE_RELATIVES)
def test_full_is_a_large_relative_of_mini(split: str) -> None:
    """Particles per cell, substeps per cell and the task are those of mini."""
    registry = load()
    full = registry.size(split, "full")
    mini = registry.size(split, "mini")
    dimension = full.box.dimension
    assert full.particles / full.grid**dimension == pytest.approx(
        mini.particles / mini.grid**dimension, rel=0.06
    )
    substeps_per_cell = full.substeps_per_frame / full.grid
    assert substeps_per_cell == mini.substeps_per_frame / mini.grid
    assert full.task.radius * full.grid == pytest.approx(
        mini.task.radius * mini.grid, rel=0.02
    )
    changes = {"score_grid": mini.task.score_grid, "radius": mini.task.radius}
    assert full.task.model_copy(update=changes) == mini.task
    assert full.task.score_grid.cells == full.grid
    assert full.frame_interval == mini.frame_interval
    assert full.subsets["test"] == run_of_ids(56, 71)


Change = Callable[[dict[str, Any]], object]


@functools.cache
def our_registry() -> Any:
    """Return what datasets.yaml says."""
    return read_yaml(default_path())


def edited(tmp_path: Path, change: Change) -> Path:
    """Write a copy of our registry after a function has changed it."""
    data = copy.deepcopy(our_registry())
    data.pop("measured", None)
    change(data["splits"])
    path = tmp_path / "datasets.yaml"
    path.write_text(yaml.dump(data, Dumper=yaml.CSafeDumper))
    return path


def within(*below: str, **values: object) -> Change:
    """Return a change of a mapping in a registry; None takes a key away."""

    def change(splits: dict[str, Any]) -> None:
        entry = splits
        for key in below:
            entry = entry[key]
        entry.update(values)
        for key, value in values.items():
            if value is None:
                del entry[key]

    return change


cavity = partial(within, "cavity", "sizes", "full")
tiny = partial(within, "fluid", "sizes", "tiny", "parameters")
always = partial(within, "fluid", "parameters")  # what fluid declares for all sizes


def test_a_box_has_walls_unless_axes_are_periodic(tmp_path: Path) -> None:
    walled = load().size("cavity", "full")
    assert walled.box.walls == ("left", "right", "bottom", "top")
    bounds = [[0.1, 0.9], [0.0, 1.0]]
    path = edited(tmp_path, cavity(periodic=["y"], bounds=bounds))
    size = load(path).size("cavity", "full")
    assert size.box == Box.from_bounds(bounds, [False, True])
    assert size.field_grid.box == size.box


def test_a_registry_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LAGBENCH_REGISTRY replaces ours; a change of the file is seen in the same
    process.
    """
    ours = set(load(default_path()).splits)
    path = edited(tmp_path, lambda splits: splits.pop("fluid"))
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(path))
    without_fluid = load()
    assert set(without_fluid.splits) == ours - {"fluid"}
    edited(tmp_path, lambda splits: splits.pop("cavity"))
    without_cavity = load()
    assert set(without_cavity.splits) == ours - {"cavity"}
    none = tmp_path / "none.yaml"
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(none))
    with pytest.raises(UnreadableFileError) as caught:
        load()
    assert caught.value.where.endswith("none.yaml")


def renamed(split: str, old: str, new: str) -> Change:
    """Return a change of a parameter's name, wherever it stands."""

    def change(splits: dict[str, Any]) -> None:
        entry = splits[split]
        mappings = [entry["parameters"]]
        for size in entry["sizes"].values():
            mappings.append(size["parameters"])
        for mapping in mappings:
            if old in mapping:
                mapping[new] = mapping.pop(old)

    return change


Parts = tuple[str, ...]


def refused(path: Path, parts: Parts, call: Callable[[], object]) -> None:
    """Assert that a call names file and key."""
    with pytest.raises(UnreadableFileError) as caught:
        call()
    assert str(caught.value.where).startswith(str(path))
    assert parts[0] in str(caught.value)


def lead_out(splits: dict[str, Any]) -> None:
    """Name a size like a folder above."""
    sizes = splits["cavity"]["sizes"]
    sizes["../x"] = sizes.pop("tiny")


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (within("cavity", splts={}), ("cavity", "unknown key 'splts'")),
        (cavity(taks={}), ("splits.cavity.sizes.full", "did you mean 'task'?")),
        (cavity("task", radios=1.0), ("task", "did you mean 'radius'?")),
        (cavity("task", horizon="ninety"), ("task.horizon", "a whole number")),
        (cavity("parameters", gird=40), ("cavity", "did you mean 'grid'?")),
        (cavity("parameters", grid=None), ("cavity", "no value for grid")),
        (cavity("subsets", test="54-x"), ("subsets.test", "no id and no range")),
        (cavity("subsets", tset="90"), ("cavity", "did you mean 'test'?")),
        (cavity("subsets", extra="0"), ("cavity", "stands in two subsets")),
        (cavity("subsets", test=None), ("cavity", "no subset 'test'")),
        (within("cavity", sizes={}), ("cavity.sizes",)),
        (cavity(frames={600: "0-58"}), ("cavity", "name every scenario once")),
        (cavity(periodic=["q"]), ("cavity", "periodic", "got q")),
        (cavity(periodic=["x", "x"]), ("cavity", "periodic", "got x, x")),
        (cavity(bounds=[[1.0, 0.0], [0.0, 1.0]]), ("cavity.sizes.full", "1.0 and 0.0")),
        (cavity(bounds=[[0.5, 0.5], [0.0, 1.0]]), ("cavity.sizes.full", "0.5 and 0.5")),
        (cavity(bounds=[[0.0, 1e-200], [0.0, 1e-200]]), ("bounds", "1e-200")),
        (cavity(bounds=[[-1e308, 1e308], [0.0, 1.0]]), ("bounds", "1e+308")),
        (
            within(
                "cavity",
                *("sizes", "full", "task", "score_grid"),
                cells=5000,
                placement="nodes",
            ),
            ("task.score_grid.cells", "got 5000"),
        ),
        (within("cavity", "sizes", "full", "task", frames_of_interest=[]), ("task",)),
        (
            within("decaying-vortices", "sizes", "tiny", "task", radius=0.51),
            ("task.radius", "half of each period", "got 0.51"),
        ),
        (within("cavity", version="1.0"), ("cavity.version", "a version, as in 1.0.0")),
        (lead_out, ("cavity.sizes", "../x", "a letter first")),
        (
            tiny(substeps_per_frame="many"),
            ("tiny.parameters.substeps_per_frame", ">= 1", "'many'"),
        ),
        (
            tiny(substeps_per_frame=2.5),
            ("tiny.parameters.substeps_per_frame", "an integer", "2.5"),
        ),
        (
            tiny(substeps_per_frame=0),
            ("tiny.parameters.substeps_per_frame", ">= 1", "0"),
        ),
        (
            tiny(particles=True),
            ("tiny.parameters.particles", "an integer, >= 1", "True"),
        ),
        (
            tiny(particles=99999999999),
            ("tiny.parameters.particles", "<= 10000000", "99999999999"),
        ),
        (tiny(grid=10**6), ("tiny.parameters.grid", "<= 4096", "1000000")),
        (
            always("frame_rate", value=0),
            ("parameters.frame_rate.value", "a finite number, > 0", "got 0"),
        ),
        (
            always("gravity", value=math.nan),
            ("parameters.gravity.value", "a finite number", "nan"),
        ),
        (
            always("gravity", value=math.inf),
            ("parameters.gravity.value", "a finite number", "inf"),
        ),
        (
            within("fluid", "sizes", "tiny", frames=0),
            ("sizes.tiny.frames", "an integer, >= 1", "got 0"),
        ),
        (
            within("fluid", "sizes", "tiny", frames={31: "0-3", 32: "4"}),
            ("sizes.tiny.frames", "horizon = 32 for test scenario 3", "got 31"),
        ),
        (
            renamed("fluid", "particles", "particels"),
            ("'particles'", "did you mean 'particels'?"),
        ),
        (
            renamed("cavity", "density", "denstiy"),
            ("'density'", "did you mean 'denstiy'?", "needs"),
        ),
        (
            always("gravity", value="down"),
            ("parameters.gravity", "a finite number", "'down'"),
        ),
    ],
)
def test_mistakes_are_named_on_load(
    change: Change, parts: Parts, tmp_path: Path
) -> None:
    """An unknown key or a value that cannot be: file, key, what is expected, what was
    got.
    """
    path = edited(tmp_path, change)
    refused(path, parts, lambda: load(path))


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (
            renamed("fluid", "gravity", "gravty"),
            ("parameter gravity", "did you mean 'gravty'?"),
        ),
        (
            always("liquid_modulus", value="soft"),
            ("parameter liquid_modulus", "a finite number", "'soft'"),
        ),
        (
            always("liquid_modulus", value=-1.0),
            ("parameter liquid_modulus", "a finite number, > 0", "-1.0"),
        ),
        (
            always("jacobian_relaxation", value=2),
            ("parameter jacobian_relaxation", ">= 0 and <= 1", "2"),
        ),
        (tiny(wall=16), ("parameter wall", "an integer, >= 0 and <= 14", "16")),
    ],
)
def test_a_solver_that_cannot_be_fed_is_refused_before_work(
    change: Change, parts: Parts, tmp_path: Path
) -> None:
    """By ``generate``, dry or not, and by ``verify --regenerate``; nothing is
    written.
    """
    path = edited(tmp_path, change)
    root = tmp_path / "data"
    options: dict[str, Any] = {
        "root": root,
        "registry": load(path),
        "workers": 1,
    }
    plan = partial(generate, "fluid", "tiny", dry_run=True, **options)
    refused(path, parts, plan)
    simulate = partial(generate, "fluid", "tiny", **options)
    refused(path, parts, simulate)
    for file in root.rglob("*"):
        assert file.is_dir() or file.name.startswith(".lock")
    regenerate = partial(verify, "fluid", "tiny", regenerate=1, **options)
    refused(path, parts, regenerate)


def test_our_own_values_hold_with_room() -> None:
    """Every number of ours lies within its limit, at every size, or the limits are
    wrong.
    """
    registry = load()
    all_limits = {**LIMITS, **NEEDED}
    for split, entry in registry.splits.items():
        for name in entry.sizes:
            size = registry.size(split, name)
            for parameter, limit in all_limits.items():
                if parameter in size.parameters:
                    value = size.value(parameter)
                    assert limit.holds(value), (split, name, parameter)


Plug = Callable[..., Registry]


@pytest.fixture
def plugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Plug]:
    """A function that loads our registry with other packages' modules, given as
    name=source.
    """
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv(registry.REGISTRY_VARIABLE, raising=False)

    def plug(**sources: str) -> Registry:
        own = EntryPoint("cavity", "lagbench.generators.cavity", registry.GROUP)
        points = [own]
        for name, source in sources.items():
            module = f"{name}_split"
            (tmp_path / f"{module}.py").write_text(source)
            point = EntryPoint(name, module, registry.GROUP)
            points += [point, point]  # found on two paths
        monkeypatch.setattr(registry, "list_entry_points", lambda group: points)
        registry._load.cache_clear()
        return load()

    yield plug
    registry._load.cache_clear()


@pytest.fixture
def theirs(tmp_path: Path) -> str:
    """A datasets.yaml of a split of one's own that also rewrites the cavity and its
    hash.
    """
    ours = copy.deepcopy(our_registry())["splits"]
    splits = {
        "sloshing": ours["fluid"],
        "cavity": ours["cavity"],
    }
    splits["cavity"]["title"] = "Hijacked"
    measured = {
        "dataset_sha256": "0" * 64,
        "subset_sha256": {},
        "scenario_sha256": {},
        "statistics": {},
        "twin_floor": [],
    }
    content = {
        "format": 1,
        "splits": splits,
        "measured": {"cavity": {"tiny": measured}},
    }
    path = tmp_path / "theirs.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_other_packages_add_splits_and_change_none(plugged: Plug, theirs: str) -> None:
    """Only the split that an entry point names is taken: our split and its hash stay
    ours.
    """
    before = load(default_path())
    after = plugged(sloshing=f"REGISTRY = {theirs!r}")
    assert set(after.splits) == {*before.splits, "sloshing"}
    assert after.size("sloshing", "tiny").particles == 256
    assert after.size("cavity", "tiny") == before.size("cavity", "tiny")
    assert after.split("cavity") == before.split("cavity")

    # messages name the file that describes a split
    assert after.size("cavity", "tiny").record_name == "datasets.yaml"
    place = Path(theirs)
    their_size = load_rooted_registry(place.parent, after).size("sloshing", "tiny")
    assert their_size.record_name == f"{place.parent.name}/theirs.yaml"
    with pytest.raises(UsageError) as caught:
        their_size.value("mass")
    assert caught.value.where == f"{their_size.record_name}, sloshing tiny"


@pytest.mark.parametrize(
    ("name", "source", "reason"),
    [
        ("careless", "", "REGISTRY"),
        (
            "broken",
            "import no_such_module_at_all",
            "ModuleNotFoundError.*no_such_module_at_all",
        ),
        ("lost", "REGISTRY = '/nowhere/datasets.yaml'", "/nowhere/datasets.yaml"),
        ("silent", "REGISTRY = {theirs!r}", "no split 'silent'"),
        ("cavity", "REGISTRY = {theirs!r}", "its name is taken"),
    ],
)
def test_a_broken_package_is_left_out(
    name: str,
    source: str,
    reason: str,
    plugged: Plug,
    theirs: str,
) -> None:
    """A package that cannot be imported or read costs one warning that names it, and
    none of our splits.
    """
    words = f"(?s)package {name}_split .*{reason}"
    sources = {name: source.format(theirs=theirs)}
    with pytest.warns(registry.PluginWarning, match=words) as warnings:
        found = plugged(**sources)
    assert len(warnings) == 1
    assert found.splits == load(default_path()).splits


@pytest.mark.parametrize(
    ("split", "expected"),
    [
        ("cavity", (0.002191, 0.002195)),
        ("curl-noise", (1.600e-03, 1.600e-03)),
    ],
)
def test_statistics_of_train_are_those_of_the_thesis(
    split: str, expected: tuple[float, float]
) -> None:
    """Standard deviations of per-frame velocities within 5 % of Tables 5.1 and 5.3, by
    component.

    Positions of curl noise spread as in Table 5.1 (0.272): a uniform box of this width
    gives it within 2 %.
    """
    size = load().size(split, "full")
    statistics = size.measured.statistics
    assert statistics["velocity_std"] == pytest.approx(expected, rel=0.05)
    if split == "curl-noise":
        low, high = size.bounds[0]
        uniform = (high - low) / 12**0.5
        spread = (uniform, uniform)
        assert statistics["position_std"] == pytest.approx(spread, rel=1e-3)
        assert uniform == pytest.approx(0.272, rel=0.02)


@pytest.mark.parametrize("name", ["gravity", "liquid_viscosity"])
@pytest.mark.parametrize("value", ["strong", True, float("nan")])
def test_parameters_that_readers_compute_with_are_numbers(
    name: str, value: object
) -> None:
    """Texts and switches are a split's own choice elsewhere only."""
    values = dict.fromkeys(NEEDED, 4)
    declared = dict.fromkeys([*values, name, "shape"])
    check_parameters("tiny", {**values, name: 0.5, "shape": "disc"}, declared)
    with pytest.raises(ValueError, match=name):
        check_parameters("tiny", {**values, name: value, "shape": "disc"}, declared)


@pytest.mark.parametrize(
    ("version", "is_compared"),
    [("1.0.0", True), ("1.9.0", True), ("2.0.0", False), ("7.0.0", False)],
)
def test_hashes_of_an_older_major_version_do_not_count(
    version: str, is_compared: bool, tmp_path: Path
) -> None:
    """The author of a split has raised MAJOR, and has not recorded new hashes yet."""
    text = default_path().read_text()
    head, rest = text.split("  cavity-3d:\n    version: 1.0.0\n", 1)
    path = tmp_path / "mine.yaml"
    path.write_text(f"{head}  cavity-3d:\n    version: {version}\n{rest}")
    loaded = load(path)
    assert (loaded.size("cavity-3d", "tiny").measured is not None) == is_compared
    assert loaded.size("fluid", "tiny").measured is not None
