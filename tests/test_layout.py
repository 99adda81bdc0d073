"""Roots and paths."""

from __future__ import annotations

from pathlib import Path

import platformdirs
import pytest
from scenario_factory import make_key

from lagbench.data.layout import resolve_root, scenario_path
from lagbench.errors import UsageError


def test_root_given_then_environment_then_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An option beats LAGBENCH_ROOT, which beats the user data folder; an empty one counts as unset."""
    monkeypatch.setenv("LAGBENCH_ROOT", str(tmp_path / "b"))
    assert resolve_root(tmp_path / "a") == tmp_path / "a"
    assert resolve_root() == tmp_path / "b"
    monkeypatch.setenv("LAGBENCH_ROOT", "")
    assert resolve_root() == platformdirs.user_data_path("lagbench", appauthor=False)


def test_a_relative_root_is_made_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Commands print the root, so it must mean the same elsewhere; ~ is the home folder."""
    monkeypatch.chdir(tmp_path)
    assert resolve_root("data") == tmp_path / "data"
    assert resolve_root("~/data") == Path.home() / "data"


def test_scenario_path_of_the_design() -> None:
    """<root>/<split>/<size>/v<MAJOR>/<subset>/<id:04d>.nc."""
    assert scenario_path(Path("r"), make_key(7)).as_posix() == "r/cavity/tiny/v2/test/0007.nc"


@pytest.mark.parametrize("root", ["x" * 300, "a/" * 3000, "nul\0"])
def test_a_root_that_no_folder_can_be_named_is_ours_to_refuse(root: str) -> None:
    """A component of 300 characters, a path of 6000, a NUL: exit code 2."""
    with pytest.raises(UsageError) as caught:
        resolve_root(root)
    assert "--root" in str(caught.value.where)
