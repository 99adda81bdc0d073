"""Which engine is taken."""

import importlib.machinery
import importlib.util

import pytest

from lagbench.errors import NotInstalledError, UsageError
from lagbench.work.engine import ENGINE_VARIABLE, find_engine


def install(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Let only these packages be found."""

    def find_spec(name: str) -> importlib.machinery.ModuleSpec | None:
        if name in packages:
            return importlib.machinery.ModuleSpec(name, None)
        return None

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    monkeypatch.delenv(ENGINE_VARIABLE, raising=False)


def test_the_installed_engine_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "quadrants")
    assert find_engine() == "quadrants"
    install(monkeypatch, "quadrants", "taichi")
    assert find_engine() == "taichi"
    monkeypatch.setenv(ENGINE_VARIABLE, "quadrants")
    assert find_engine() == "quadrants"


def test_what_is_not_installed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    with pytest.raises(NotInstalledError):
        find_engine()
    install(monkeypatch, "taichi")
    monkeypatch.setenv(ENGINE_VARIABLE, "quadrants")
    with pytest.raises(NotInstalledError):
        find_engine()


def test_an_unknown_engine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "taichi")
    monkeypatch.setenv(ENGINE_VARIABLE, "taichy")
    with pytest.raises(UsageError) as caught:
        find_engine()
    assert caught.value.where == ENGINE_VARIABLE
