"""Splits of other packages: ours stay as they are, and a broken package costs a warning only."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from lagbench.data import registry
from lagbench.data import registry as plugins
from lagbench.data.registry import Registry, default_path, load
from lagbench.data.yamlfile import read_yaml

Plug = Callable[..., Registry]


@pytest.fixture
def plugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Plug]:
    """A function that loads our registry with other packages' modules, given as name=source."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv(registry.REGISTRY_VARIABLE, raising=False)

    def plug(**sources: str) -> Registry:
        points = [EntryPoint("cavity", "lagbench.generators.cavity", plugins.GROUP)]
        for name, source in sources.items():
            (tmp_path / f"{name}_split.py").write_text(source)
            points += 2 * [EntryPoint(name, f"{name}_split", plugins.GROUP)]  # found on two paths
        monkeypatch.setattr(plugins, "entry_points", lambda group: points)
        registry._load.cache_clear()
        return load()

    yield plug
    registry._load.cache_clear()


@pytest.fixture
def theirs(tmp_path: Path) -> str:
    """A datasets.yaml of a split of one's own that also rewrites the cavity and its hash."""
    data = read_yaml(default_path())
    splits = {"sloshing": data["splits"]["fluid"], "cavity": data["splits"]["cavity"]}
    splits["cavity"]["title"] = "Hijacked"
    nothing = {"subset_sha256": {}, "scenario_sha256": {}, "statistics": {}, "twin_floor": []}
    measured = {"cavity": {"tiny": {"dataset_sha256": "0" * 64, **nothing}}}
    path = tmp_path / "theirs.yaml"
    path.write_text(yaml.safe_dump({"format": 1, "splits": splits, "measured": measured}))
    return str(path)


def test_other_packages_add_splits_and_change_none(plugged: Plug, theirs: str) -> None:
    """Only the split that an entry point names is taken: our split and its hash stay ours."""
    before = load(default_path())
    found = plugged(sloshing=f"REGISTRY = {theirs!r}")
    assert set(found.splits) == {*before.splits, "sloshing"}
    assert found.size("sloshing", "tiny").particles == 256
    assert found.size("cavity", "tiny") == before.size("cavity", "tiny")
    assert found.split("cavity") == before.split("cavity")


@pytest.mark.parametrize(
    ("name", "source", "reason"),
    [
        ("careless", "", "REGISTRY"),
        ("broken", "import no_such_module_at_all", "ModuleNotFoundError.*no_such_module_at_all"),
        ("lost", "REGISTRY = '/nowhere/datasets.yaml'", "cannot read"),
        ("silent", "REGISTRY = {theirs!r}", "no split 'silent'"),
        ("cavity", "REGISTRY = {theirs!r}", "its name is taken"),
    ],
)
def test_a_broken_package_is_left_out(
    name: str, source: str, reason: str, plugged: Plug, theirs: str
) -> None:
    """A package that cannot be imported or read costs one warning that names it, and none of our splits."""
    with pytest.warns(plugins.PluginWarning, match=f"(?s)package {name}_split .*{reason}") as told:
        found = plugged(**{name: source.format(theirs=theirs)})
    assert len(told) == 1
    assert found.splits == load(default_path()).splits


def test_a_broken_package_breaks_no_command(tmp_path: Path) -> None:
    """An installed package whose module is gone: the command works, one line on stderr names the package."""
    folder = tmp_path / "wave_splits-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: wave-splits\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[{plugins.GROUP}]\nwaves = wave_splits.gone\n")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from lagbench.cli import main; main()"
    command = [sys.executable, "-c", code, "cite", "cavity", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert '"split": "cavity"' in done.stdout
    assert done.stderr.startswith("warning: package wave-splits adds no split 'waves'")
    assert len(done.stderr.splitlines()) == 1
