"""The registry: the numbers of the design, and mistakes that are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from lagbench.data.limits import SUBSETS
from lagbench.data.registry import Size, default_path, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UnreadableFileError, UsageError

TIERS = [
    (split, size)
    for split in ("fluid", "multimaterial", "cavity", "curl-noise")
    for size in ("full", "mini", "tiny")
]


def tier(split: str, size: str) -> Size:
    """Return a size of our registry."""
    return load().size(split, size)


@pytest.mark.parametrize(
    ("split", "particles", "grid", "interval", "substeps", "frames", "counts"),
    [
        ("fluid", 2500, 128, 1 / 60, 20, 22_800, (28, 8, 16)),
        ("multimaterial", 2500, 64, 1 / 60, 20, 43_200, (48, 8, 16)),
        ("cavity", 8192, 40, 0.1, 50, 45_600, (48, 8, 20)),
        ("curl-noise", 8096, 40, 0.1, 50, 43_200, (48, 8, 16)),
    ],
)
def test_full_sizes_are_those_of_the_design(
    split: str,
    particles: int,
    grid: int,
    interval: float,
    substeps: int,
    frames: int,
    counts: tuple[int, ...],
) -> None:
    """Particles, grid and substeps of section 3; subsets of version 2; frames over train, valid and test."""
    full = tier(split, "full")
    official = [i for name in ("train", "valid", "test") for i in full.subsets[name]]
    assert (full.particles, full.grid, full.substeps_per_frame) == (particles, grid, substeps)
    assert full.frame_interval == pytest.approx(interval, rel=1e-15)
    assert full.dt == pytest.approx(interval / substeps, rel=1e-15)
    assert sum(full.frame_count(i) for i in official) == frames
    assert tuple(len(full.subsets[name]) for name in ("train", "valid", "test")) == counts


def test_special_ids_of_the_design() -> None:
    """Subsets are runs of ids; extra and the frames of fluid 0 and 26 are as section 3 names them."""
    fluid, pairs = tier("fluid", "full"), tier("multimaterial", "full")
    assert fluid.subsets["test"] == tuple(range(36, 52))
    assert fluid.subsets["valid"] == tuple(range(28, 36))
    assert fluid.frame_count(0) == fluid.frame_count(26) == 600
    assert pairs.subsets["extra"] == tuple(range(72, 87))
    assert {pairs.frame_count(i) for i in pairs.subsets["extra"]} == {1200}
    assert tier("cavity", "full").subsets["test"] == tuple(range(56, 76))
    assert tier("curl-noise", "full").subsets["test"] == tuple(range(56, 72))


@pytest.mark.parametrize(("split", "size"), TIERS)
def test_every_size_is_consistent(split: str, size: str) -> None:
    """Frames cover the task, frames of interest are predicted ones, bounds lie in the unit box."""
    entry = tier(split, size)
    task = entry.task
    last = task.input_frames + task.horizon - 1
    assert all(entry.frame_count(i) > last for i in entry.subsets["test"])
    assert all(task.input_frames <= frame <= last for frame in task.frames_of_interest)
    assert all(0.0 < low < high < 1.0 for low, high in entry.bounds)
    assert all(low + high == pytest.approx(1.0, abs=1e-12) for low, high in entry.bounds)
    assert set(entry.subsets) <= set(SUBSETS)
    assert entry.scenarios == tuple(sorted({i for ids in entry.subsets.values() for i in ids}))
    assert all(p.unit and p.description and p.value is not None for p in entry.parameters.values())


@pytest.mark.parametrize("split", ["fluid", "multimaterial", "cavity", "curl-noise"])
def test_mini_and_tiny_are_small_relatives(split: str) -> None:
    """As many particles per cell, the same frame interval, substeps as cells; tiny for tests."""
    full, mini, tiny = (tier(split, size) for size in ("full", "mini", "tiny"))
    inside = [(size.bounds[0][1] - size.bounds[0][0]) * size.grid for size in (full, mini)]
    if split in ("cavity", "curl-noise"):
        per_cell = [size.particles / cells**2 for size, cells in zip((full, mini), inside, strict=True)]
        assert per_cell[1] == pytest.approx(per_cell[0], rel=0.06)
    else:
        assert mini.particles == full.particles / 4
    assert mini.frame_interval == tiny.frame_interval == full.frame_interval
    assert mini.substeps_per_frame / mini.grid == full.substeps_per_frame / full.grid
    assert 256 <= tiny.particles <= 640
    assert len(mini.subsets["train"]) == 24
    assert mini.scenarios == tuple(range(len(mini.scenarios)))


def edited(tmp_path: Path, change: object) -> Path:
    """Write a copy of our registry after a function has changed it."""
    data = read_yaml(default_path())
    data.pop("measured", None)
    change(data)  # type: ignore[operator]
    path = tmp_path / "datasets.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def cavity(data: dict[str, Any]) -> dict[str, Any]:
    """Return the full size of cavity as written."""
    full: dict[str, Any] = data["splits"]["cavity"]["sizes"]["full"]
    return full


@pytest.mark.parametrize(
    ("change", "place", "message"),
    [
        (lambda d: d.update(splts={}), "registry", "unknown key 'splts': did you mean 'splits'?"),
        (lambda d: cavity(d).update(taks={}), "splits.cavity.sizes.full", "did you mean 'task'?"),
        (lambda d: cavity(d)["task"].update(radios=1.0), "task", "did you mean 'radius'?"),
        (lambda d: cavity(d)["task"].update(horizon="ninety"), "task.horizon", "valid integer"),
        (lambda d: cavity(d).update(frames=1.5), "frames", "valid integer"),
        (lambda d: cavity(d)["parameters"].update(gird=40), "cavity", "did you mean 'grid'?"),
        (lambda d: cavity(d)["parameters"].pop("grid"), "cavity", "no value for grid"),
        (lambda d: cavity(d)["subsets"].update(test="54-x"), "subsets.test", "no id and no range"),
        (lambda d: cavity(d)["subsets"].update(tset="90"), "cavity", "did you mean 'test'?"),
        (lambda d: cavity(d)["subsets"].update(extra="0"), "cavity", "stands in two subsets"),
        (lambda d: cavity(d).update(frames={600: "0-58"}), "cavity", "name every scenario once"),
        (lambda d: d["splits"]["cavity"].update(version="1.0"), "cavity.version", "match pattern"),
    ],
)
def test_mistakes_are_named(change: object, place: str, message: str, tmp_path: Path) -> None:
    """An unknown key or a value of the wrong type: file, key and the nearest known word, exit code 3."""
    path = edited(tmp_path, change)
    with pytest.raises(UnreadableFileError) as caught:
        load(path)
    text = str(caught.value)
    assert str(path) in text
    assert place in text
    assert message in text
    assert caught.value.exit_code == 3


def test_unknown_names_offer_the_nearest() -> None:
    """Split, size, parameter and scenario, each with what is known."""
    with pytest.raises(UsageError, match="did you mean 'multimaterial'"):
        load().size("multimatrial", "full")
    with pytest.raises(UsageError, match="did you mean 'full'"):
        load().size("fluid", "ful")
    with pytest.raises(UsageError, match="did you mean 'liquid_modulus'"):
        tier("fluid", "full").value("liqid_modulus")
    with pytest.raises(UsageError, match="extra 72-86"):
        tier("multimaterial", "full").subset_of(87)


def test_a_registry_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LAGBENCH_REGISTRY replaces ours; a change of the file is seen in the same process."""
    path = edited(tmp_path, lambda d: d["splits"].pop("fluid"))
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(path))
    assert set(load().splits) == {"cavity", "curl-noise", "multimaterial"}
    edited(tmp_path, lambda d: d["splits"].pop("cavity"))
    assert set(load().splits) == {"fluid", "curl-noise", "multimaterial"}
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(tmp_path / "none.yaml"))
    with pytest.raises(UnreadableFileError, match="cannot read"):
        load()
