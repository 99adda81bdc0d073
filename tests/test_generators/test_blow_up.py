"""A blow-up names its scenario, the first broken substep, the broken bound and its
value.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from box_scenarios import compiled
from conftest import SIZE, SPLIT

from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import WorkFailedError
from lagbench.generators import batch
from lagbench.generators.batch import SimulationJob
from lagbench.generators.constants import split_module
from lagbench.generators.simulate import simulate
from lagbench.generators.split import Device
from lagbench.make.generate import generate

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def compile_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every batch take the solver that is there."""
    monkeypatch.setattr(batch, "build", compiled)


@pytest.fixture
def stiff_registry(unmeasured_path: Path, tmp_path: Path) -> Registry:
    """Curl noise that is too stiff for its dt: all scenarios blow up, some later than
    others.
    """
    text = unmeasured_path.read_text()
    own = tmp_path / "stiff.yaml"
    assert "modulus: {value: 5.0e-4" in text
    own.write_text(text.replace("modulus: {value: 5.0e-4", "modulus: {value: 0.1"))
    return load(own)


@pytest.fixture
def stiff(stiff_registry: Registry) -> Size:
    """The same as a size."""
    return stiff_registry.size(SPLIT, SIZE)


def first_bad(size: Size, scenarios: tuple[int, ...]) -> tuple[int, int]:
    """Return (scenario, substep) of the first failure, one substep and one solver at a
    time.
    """
    ends = {}
    solver = compiled(
        split_module(size).solver_parameters(size),
        device=Device.CPU,
        scenarios=1,
        threads=1,
    )
    for scenario in scenarios:
        solver.load([batch.draw_initial_state(size, scenario)])
        for substep in range(1, 313):
            try:
                solver.advance(1)
            except WorkFailedError:
                ends[scenario] = substep
                break
    return min((substep, scenario) for scenario, substep in ends.items())[::-1]


def failure(
    size: Size,
    scenarios: tuple[int, ...],
    root: Path,
    device: Device = Device.CPU,
) -> WorkFailedError:
    """Return the error that simulating some scenarios ends with."""
    with pytest.raises(WorkFailedError) as caught:
        simulate(
            SimulationJob(size=size, scenarios=scenarios, root=root, device=device),
            lambda units: None,
        )
    return caught.value


@pytest.mark.parametrize(
    ("scenario", "expected", "got"),
    [
        (1, r"J > 0", r"J = -0\.\d+"),
        (2, r"CFL: abs\(v\) <= dx/dt = 12; J > 0", r"abs\(v\) = 12\.\d+; J = -1\.\d+"),
    ],
)
def test_substep_and_bounds_are_those_that_broke_first(
    scenario: int,
    expected: str,
    got: str,
    stiff: Size,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A solver that is asked after every substep agrees."""
    _, substep = first_bad(stiff, (scenario,))
    assert substep > 1
    monkeypatch.setattr(batch, "STRIDE", 1)
    error = failure(stiff, (scenario,), tmp_path)
    assert error.where == f"{SPLIT} {SIZE}, scenario {scenario}, substep {substep}"
    assert re.search(f"got {got}, expected {expected};", str(error))
    assert not list(tmp_path.rglob("*.nc*"))


def test_the_first_scenario_of_a_batch_is_named(
    stiff: Size, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of scenarios that advance together, the one that breaks first; not the first of
    the batch.
    """
    monkeypatch.setattr(batch, "STRIDE", 1)
    together = (2, 1, 3)
    scenario, substep = first_bad(stiff, together)
    error = failure(stiff, together, tmp_path, Device.PARALLEL)
    assert error.where == f"{SPLIT} {SIZE}, scenario {scenario}, substep {substep}"


def test_a_failed_scenario_leaves_what_was_there(
    copied: Callable[[], Path],
    stiff_registry: Registry,
    tmp_path: Path,
) -> None:
    """Neither file nor manifest of it; files of an earlier generation and their
    manifest stay.
    """
    before = copied()
    (before / SPLIT / SIZE / "v2" / "valid" / "0002.nc").unlink()
    for root in (tmp_path / "data", before):
        with pytest.raises(WorkFailedError) as caught:
            generate(
                SPLIT,
                SIZE,
                scenarios="2",
                root=root,
                workers=1,
                registry=stiff_registry,
            )
        assert str(caught.value.where).startswith("curl-noise tiny, scenario 2, ")
    found = [p.name for p in (tmp_path / "data").rglob("*") if p.is_file()]
    assert all(name.startswith(".lock") for name in found)
    after = read_manifest(before, SPLIT, SIZE, 2)
    assert after is not None
    assert [e.scenario for e in after.files] == [0, 1, 3, 4]
