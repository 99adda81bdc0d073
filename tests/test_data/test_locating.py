"""Roots; splits by name and by path: what a user names is found, what a file names is
not a path.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import platformdirs
import pytest
from scenario_factory import make_key
from trajectories import straight_runs

import lagbench
from lagbench.data.layout import dataset_folder, scenario_path
from lagbench.data.local import (
    is_split_name,
    load_rooted_registry,
    locate,
    locate_new,
    locate_split,
    resolve_root,
)
from lagbench.data.registry import load
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.verify import verify


def test_root_given_then_environment_then_platform(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Option, LAGBENCH_ROOT unless empty, user data folder; a root is made absolute, ~
    is the home folder.
    """
    monkeypatch.setenv("LAGBENCH_ROOT", str(tmp_path / "b"))
    assert resolve_root(tmp_path / "a") == tmp_path / "a"
    assert resolve_root() == tmp_path / "b"
    monkeypatch.setenv("LAGBENCH_ROOT", "")
    assert resolve_root() == platformdirs.user_data_path("lagbench", appauthor=False)
    monkeypatch.chdir(tmp_path)
    assert resolve_root("data") == tmp_path / "data"
    assert resolve_root("~/data") == Path.home() / "data"
    assert (
        scenario_path(Path("r"), make_key(7)).as_posix()
        == "r/cavity/tiny/v2/test/0007.nc"
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A local split named own."""
    folder = tmp_path_factory.mktemp("made")
    np.save(folder / "runs.npy", np.stack(straight_runs(3)))
    return adopt(
        folder / "runs.npy",
        output=folder / "own",
        radius=0.1,
        frame_interval=0.1,
        axes="trajectory,frame,particle,space",
    )


@pytest.fixture
def own(made: LocalSplit, tmp_path: Path) -> Path:
    """A copy of it that a test may change."""
    shutil.copytree(made.folder, tmp_path / "root" / "own")
    return tmp_path / "root" / "own"


def test_a_local_split_is_located_by_path_or_by_name(
    own: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """By path, or by name with a root, LAGBENCH_ROOT or the current folder; a path is
    in no other root.
    """
    monkeypatch.chdir(own.parent)
    for split, root in (
        (own, None),
        (Path("own"), None),
        (str(own), None),
        (f"{own}/", None),
        ("./own", None),
        ("own/", None),
        ("own", own.parent),
        ("own", "."),
        ("own", None),
    ):
        found = locate_split(split, root=root)
        assert found.name == "own"
        assert found.root.resolve() == own.parent.resolve()
    monkeypatch.chdir(own.parent.parent)
    monkeypatch.setenv("LAGBENCH_ROOT", str(own.parent))
    assert locate_split("own").root == own.parent
    assert locate("root/own").size.split == "own"
    by_path_and_root = locate(str(own), root=own.parent)
    assert by_path_and_root.root == own.parent
    with pytest.raises(UsageError) as caught:
        locate(str(own), root=tmp_path)
    assert "--split" in str(caught.value.where)
    assert "--root" in str(caught.value.where)


def test_built_in_splits_are_located_in_the_root(tmp_path: Path) -> None:
    """A name of the registry means that split, whatever the root holds."""
    (tmp_path / "cavity").mkdir()
    (tmp_path / "cavity" / "split.yaml").write_text("format: 1")
    found = locate("cavity", "tiny", root=tmp_path)
    assert found.size.generator == "lagbench.generators.cavity"
    assert found.root == tmp_path
    with pytest.raises(UsageError) as caught:
        locate(str(tmp_path / "cavity"), "tiny")
    assert caught.value.where.endswith("/cavity")


def test_a_subset_is_no_split() -> None:
    with pytest.raises(UsageError, match="use subset="):
        lagbench.open_split("cavity", split="train")
    with pytest.raises(UsageError, match='subset="train"'):
        lagbench.open_split(split="train")


def folder_of_tests(root: Path, size: str) -> Path:
    """Return the folder of test scenarios of a cavity."""
    major = load().size("cavity", size).major
    return dataset_folder(root, "cavity", size, major) / "test"


def test_the_only_size_there_is_the_default(own: Path, tmp_path: Path) -> None:
    """One size there: that one; of several mini. None, or several without mini: an
    error that names them. What is to be made: mini.
    """
    with pytest.raises(DataError) as none:
        lagbench.open_split("cavity", root=tmp_path)
    assert none.value.where == "--size"
    assert "--size mini" in str(none.value)
    for size in ("tiny", "full"):
        folder = folder_of_tests(tmp_path, size)
        folder.mkdir(parents=True)
        (folder / "0000.nc").touch()
        if size == "tiny":
            only = locate("cavity", root=tmp_path)
            assert only.size.name == "tiny"
    for opened in (
        lagbench.open_split,
        lagbench.windows,
        lagbench.load_manifest,
        verify,
    ):
        with pytest.raises(UsageError) as several:
            opened("cavity", root=tmp_path)
        assert several.value.where == "--size"
        assert "--size full" in str(several.value)
    new = locate_new("cavity", root=tmp_path)
    assert new.size.name == "mini"
    mini_folder = folder_of_tests(tmp_path, "mini")
    mini_folder.mkdir(parents=True)
    (mini_folder / "0000.nc").touch()
    one_of_three = locate("cavity", root=tmp_path)
    assert one_of_three.size.name == "mini"
    for reading in (lagbench.open_split, lagbench.windows):
        with pytest.raises(DataError) as damaged:
            reading("cavity", subset="test", root=tmp_path)
        assert damaged.value.where == str(mini_folder.parent)
    # Where a split has no mini, its only size is the default.
    new = locate_new("own", root=own.parent)
    old = locate("own", root=own.parent)
    assert new.size.name == old.size.name


def test_a_folder_may_be_moved_but_not_renamed(
    own: Path, made: LocalSplit, tmp_path: Path
) -> None:
    """The name is part of every hash, so the folder must keep it; where it lies is part
    of nothing.
    """
    moved = Path(shutil.move(own, tmp_path / "own"))
    result = lagbench.verify(str(moved))
    assert result.dataset_sha256 == made.dataset_sha256
    renamed = moved.rename(moved.with_name("mine"))
    with pytest.raises(UnreadableFileError) as caught:
        locate(str(renamed))
    assert caught.value.where.endswith("mine/split.yaml")


def test_a_description_harms_no_other_split_and_chooses_no_code(own: Path) -> None:
    """An error in it appears only when that split is read; a generator in it, which
    would be imported, is refused.
    """
    path = own / "split.yaml"
    text = path.read_text()
    path.write_text(text.replace("generator: none", "generator: antigravity"))
    with pytest.raises(UnreadableFileError) as caught:
        locate(str(own))
    assert caught.value.where.endswith("root/own/split.yaml, key splits.own.generator")
    path.write_text("splits: [")
    cavity = locate("cavity", "tiny", root=own.parent)
    assert cavity.size.split == "cavity"
    with pytest.raises(UnreadableFileError) as caught:
        locate("own", root=own.parent)
    assert caught.value.where.endswith("root/own/split.yaml")


@pytest.mark.parametrize(
    "name",
    [
        "../own",
        "/etc",
        "own/",
        ".",
        "..",
        "",
        "Own",
        "a b",
        "a" * 65,
        "own\0",
    ],
)
def test_paths_are_no_names(name: str) -> None:
    """Whatever could leave the root folder cannot be the name of a split."""
    assert not is_split_name(name)


def test_a_rooted_registry_leaves_its_base_alone(own: Path) -> None:
    """Looking up a local split adds it to no other registry, nor to another root's."""
    base = load()
    known = load_rooted_registry(own.parent, base)
    assert known.split("own").generator == "none"
    assert "own" not in base.splits
    elsewhere = load_rooted_registry(own.parent.parent, known)
    assert elsewhere.local_names() == ()
    with pytest.raises(UsageError):
        elsewhere.split("own")
