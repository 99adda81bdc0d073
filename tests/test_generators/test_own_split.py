"""What a user is told about the module of a split of their own that fails."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.generators.batch import (
    SimulationJob,
    draw_initial_state,
)
from lagbench.generators.constants import solver_constants, split_module
from lagbench.generators.simulate import simulate

Install = Callable[..., Path]

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "dam_break" / "dam_break"
SOURCE = (EXAMPLE / "__init__.py").read_text()

WIDTH = "uniform(rng, 0.2, 0.4)"
CONSTANTS = "constants(FreeSurfaceParameters, size)"


def own_size(package: Install, old: str, new: str) -> tuple[Size, Path]:
    """Install the example of the docs with one change; return its size and module."""
    assert old in SOURCE
    module_file = package("generators", "mine", SOURCE.replace(old, new))
    registry = module_file.with_name("dam_break.yaml")
    text = (EXAMPLE / registry.name).read_text()
    registry.write_text(text.replace("generator: dam_break", "generator: mine"))
    return load(registry).size("dam-break", "tiny"), module_file


def line_of(module_file: Path, text: str) -> str:
    """Return how a message names the line of a module that has a text."""
    for number, line in enumerate(module_file.read_text().splitlines(), start=1):
        if text in line:
            return f"{module_file}, line {number}"
    raise AssertionError(text)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("undefined_name", "NameError"),
        ("uniform(rng, 0.2)", "TypeError"),
        ("np.linalg.solve(np.zeros((3, 2)), np.ones(3))", "LinAlgError"),
        ("open('/no/such/file')", "FileNotFoundError"),
    ],
)
def test_an_exception_of_initial_state_names_file_and_line(
    change: str, kind: str, package: Install
) -> None:
    """The line is the last one of the user's module, not one of NumPy or of ours."""
    size, module_file = own_size(package, WIDTH, change)
    with pytest.raises(WorkFailedError) as caught:
        draw_initial_state(size, 3)
    assert caught.value.where == line_of(module_file, change)
    assert f"{kind}: " in str(caught.value)
    assert "Traceback" not in str(caught.value)


def test_a_module_that_fails_at_import_names_file_and_line(
    package: Install,
) -> None:
    size, module_file = own_size(package, "GAP = 0.01", "GAP = 0.01 / 0")
    with pytest.raises(UsageError) as caught:
        split_module(size)
    assert line_of(module_file, "GAP = 0.01 / 0") in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        "{}",
        "None",
        'type("Own", (FreeSurfaceParameters,), {})(**vars(constants('
        "FreeSurfaceParameters, size)))",
    ],
    ids=["a mapping", "None", "a subclass"],
)
def test_constants_of_no_solver_are_refused(change: str, package: Install) -> None:
    """The type of the constants chooses the solver."""
    size, _ = own_size(package, CONSTANTS, change)
    with pytest.raises(UsageError) as caught:
        solver_constants(size)
    assert caught.value.where == "mine.solver_parameters"


@pytest.mark.slow
def test_a_scenario_of_one_frame_is_its_initial_state(
    package: Install, tmp_path: Path
) -> None:
    """No substep is simulated, but the facts of the file are numbers."""
    size, _ = own_size(package, SOURCE, SOURCE)
    short = size.model_copy(update={"frames": {1: (0,), 62: (1, 2, 3, 4)}})
    job = SimulationJob(size=short, scenarios=(0,), root=tmp_path)
    simulate(job, lambda _: None)
    with read_scenario(short.path(tmp_path, 0)) as file:
        position = file.read("position", 0)
        facts = file.header.facts
    drawn_position = draw_initial_state(short, 0).position
    np.testing.assert_array_equal(position, drawn_position.astype(np.float32))
    assert facts["max_speed"] == 0.0
    assert facts["jacobian_min"] == 1.0
    assert facts["jacobian_max"] == 1.0


def test_parameters_of_our_own_splits_are_blamed_on_the_registry(
    tmp_path: Path,
) -> None:
    """There is no module of a user to mend."""
    size = load().size("cavity", "tiny")
    parameters = dict(size.parameters)
    name = next(name for name in parameters if name.startswith("reynolds"))
    parameters[name] = parameters[name].model_copy(update={"value": "fast"})
    with pytest.raises(LagbenchError) as caught:
        draw_initial_state(size.model_copy(update={"parameters": parameters}), 0)
    assert isinstance(caught.value, UnreadableFileError)
