"""Names and values of parameters: wrong ones are told with file and key before any work starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lagbench.data.limits import NEEDED, Limit
from lagbench.data.registry import default_path, load
from lagbench.errors import UnreadableFileError
from lagbench.generators.constants import LIMITS
from lagbench.make.generate import generate
from lagbench.make.verify import verify

Change = Callable[[dict[str, Any]], object]


def edited(tmp_path: Path, change: Change) -> Path:
    """Write a copy of our registry after a function has changed its splits."""
    data = yaml.safe_load(default_path().read_text().split("\nmeasured:")[0])
    change(data["splits"])
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def tiny(**values: object) -> Change:
    """Return a change of parameters of tiny fluid."""
    return lambda splits: splits["fluid"]["sizes"]["tiny"]["parameters"].update(values)


def declared(name: str, value: object) -> Change:
    """Return a change of a parameter that fluid declares for all sizes."""
    return lambda splits: splits["fluid"]["parameters"][name].update(value=value)


def frames(count: object) -> Change:
    """Return a change of the frame counts of tiny fluid."""
    return lambda splits: splits["fluid"]["sizes"]["tiny"].update(frames=count)


def renamed(split: str, old: str, new: str) -> Change:
    """Return a change of a parameter's name, wherever it stands."""

    def change(splits: dict[str, Any]) -> None:
        entry = splits[split]
        for mapping in (entry["parameters"], *(s["parameters"] for s in entry["sizes"].values())):
            if old in mapping:
                mapping[new] = mapping.pop(old)

    return change


@pytest.mark.parametrize(
    ("change", "key", "expected", "got"),
    [
        (tiny(substeps_per_frame="many"), "tiny.parameters.substeps_per_frame", "an integer, >= 1", "'many'"),
        (tiny(substeps_per_frame=2.5), "tiny.parameters.substeps_per_frame", "an integer, >= 1", "2.5"),
        (tiny(substeps_per_frame=0), "tiny.parameters.substeps_per_frame", "an integer, >= 1", "0"),
        (tiny(particles=-3), "tiny.parameters.particles", "an integer, >= 1", "-3"),
        (tiny(particles=True), "tiny.parameters.particles", "an integer, >= 1", "True"),
        (tiny(particles=99999999999), "tiny.parameters.particles", "<= 10000000", "99999999999"),
        (tiny(grid=10**6), "tiny.parameters.grid", "<= 4096", "1000000"),
        (declared("frame_rate", 0), "parameters.frame_rate.value", "a finite number, > 0", "got 0"),
        (declared("gravity", math.nan), "parameters.gravity.value", "a finite number", "nan"),
        (declared("gravity", math.inf), "parameters.gravity.value", "a finite number", "inf"),
        (frames(0), "sizes.tiny.frames", "an integer, >= 1", "got 0"),
        (frames({31: "0-3", 32: "4"}), "sizes.tiny.frames", "horizon = 32 for test scenario 3", "got 31"),
        (renamed("fluid", "particles", "particels"), "'particles'", "did you mean 'particels'?", "needs"),
        (renamed("cavity", "density", "denstiy"), "'density'", "did you mean 'denstiy'?", "needs"),
    ],
)
def test_a_size_that_cannot_be_is_refused_on_load(
    change: Change, key: str, expected: str, got: str, tmp_path: Path
) -> None:
    """File, key, what is expected and what was got; exit code 3."""
    path = edited(tmp_path, change)
    with pytest.raises(UnreadableFileError) as caught:
        load(path)
    text = str(caught.value)
    assert caught.value.exit_code == 3
    assert all(part in text for part in (str(path), key, expected, got)), text


@pytest.mark.parametrize(
    ("change", "key", "expected", "got"),
    [
        (renamed("fluid", "gravity", "gravty"), "parameter gravity", "gravity", "did you mean 'gravty'?"),
        (declared("gravity", "down"), "parameter gravity", "a finite number", "'down'"),
        (declared("liquid_modulus", -1.0), "parameter liquid_modulus", "a finite number, > 0", "-1.0"),
        (declared("jacobian_relaxation", 2), "parameter jacobian_relaxation", ">= 0 and <= 1", "2"),
        (tiny(wall=16), "parameter wall", "an integer, >= 0 and <= 14", "16"),
        (
            declared("area_min", "big"),
            "splits.fluid, size tiny",
            "generators.fluid can use",
            "area_min = 'big'",
        ),
        (renamed("fluid", "area_max", "aera_max"), "size tiny", "did you mean 'aera_max'?", "'area_max'"),
    ],
)
@pytest.mark.parametrize("dry_run", [True, False])
def test_a_solver_that_cannot_be_fed_is_refused_before_work(
    change: Change, key: str, expected: str, got: str, dry_run: bool, tmp_path: Path
) -> None:
    """File, key, expected, got and the nearest name; exit code 3, and nothing is written."""
    path, root = edited(tmp_path, change), tmp_path / "data"
    with pytest.raises(UnreadableFileError) as caught:
        generate("fluid", "tiny", root=root, registry=load(path), workers=1, dry_run=dry_run)
    text = str(caught.value)
    assert caught.value.exit_code == 3
    assert all(part in text for part in (str(path), key, expected, got)), text
    assert [p for p in root.rglob("*") if p.is_file() and not p.name.startswith(".lock")] == []


def test_simulating_anew_is_refused_too(tmp_path: Path) -> None:
    """``verify --regenerate`` tells the same as ``generate``."""
    registry = load(edited(tmp_path, renamed("fluid", "gravity", "gravty")))
    with pytest.raises(UnreadableFileError, match="gravity"):
        verify("fluid", "tiny", root=tmp_path / "data", regenerate=1, registry=registry, workers=1)


def test_our_own_values_hold_with_room() -> None:
    """Every number of ours lies within its limit, at every size, or the limits are wrong."""
    for split, entry in load().splits.items():
        for name in entry.sizes:
            size = load().size(split, name)
            for parameter, limit in {**LIMITS, **NEEDED}.items():
                if parameter in size.parameters:
                    assert limit.holds(size.value(parameter)), (split, name, parameter)


@given(st.one_of(st.integers(), st.floats(), st.booleans(), st.text()))
def test_limits_agree_with_their_words(value: object) -> None:
    """An integer from -2 to 5, exclusive of 5, is what `holds` says, whatever the type."""
    whole = Limit(low=-2, high=5, whole=True, open_high=True)
    assert whole.holds(value) == (type(value) is int and value in range(-2, 5))
    real = Limit(low=0.0, open_low=True)
    assert real.holds(value) == (type(value) in (int, float) and 0 < value < math.inf)  # type: ignore[operator]
    assert str(whole) == "an integer, >= -2 and < 5"
    assert str(real) == "a finite number, > 0"
