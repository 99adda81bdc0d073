"""What the scenarios of all four splits promise, and that their bits are safe."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scenario_draws import EVERY, SIZES, SPLITS, all_of, digest, draw, state_of

from lagbench.data import registry
from lagbench.generators import draws
from lagbench.generators.split import ClosedBoxParameters

GENERATORS = Path(draws.__file__).parent
KINDS = list(zip(SPLITS, ("wall", "frequency", "family", "pair"), strict=True))
DRAWN = (
    "draws",
    "noise",
    "shapes",
    "constants",
    "cavity",
    "curl_noise",
    "fluid",
    "multimaterial",
)


@pytest.mark.parametrize(("split", "size"), EVERY)
def test_arrays_are_exact_and_inside(split: str, size: str) -> None:
    """Shapes and types hold, all numbers are multiples of 2^-20, particles are in the
    box.
    """
    entry = registry.load().size(split, size)
    (low, high), _ = entry.bounds
    for state in all_of(split, size)[:12]:
        assert state.position.shape == state.velocity.shape == (entry.particles, 2)
        assert state.affine.shape == (entry.particles, 2, 2)
        assert state.material.shape == (entry.particles,)
        assert state.material.dtype == np.int8
        for values in (
            state.position,
            state.velocity,
            state.affine,
            state.wall_velocity,
        ):
            assert values.dtype == np.float64
            assert (values.astype(np.float32) == values).all()
            assert (values * 2**20 == np.rint(values * 2**20)).all()
        assert low < state.position.min()
        assert state.position.max() < high
        assert all(isinstance(v, int | float | str) for v in state.parameters.values())


@pytest.mark.parametrize("split", SPLITS)
def test_scenarios_differ_and_repeat(split: str) -> None:
    """Drawn twice a scenario is the same; no two of a split's scenarios are."""
    states = all_of(split)
    assert len({digest(state) for state in states}) == len(states)
    again = draw(registry.load().size(split, "full"), 3)
    assert digest(again) == digest(state_of(split, "full", 3))


@pytest.mark.parametrize("size", ["full", "mini"])
@pytest.mark.parametrize(("split", "kind"), KINDS)
def test_kinds_are_spread_evenly_over_test(split: str, kind: str, size: str) -> None:
    """Every kind of scenario occurs in test, none more than once more often than
    another.
    """
    entry = registry.load().size(split, size)
    count = 20 if split == "cavity" else 16
    assert len(entry.subsets["test"]) == count
    assert len(entry.subsets["valid"]) == 8
    everywhere = {state.parameters[kind] for state in all_of(split, size)}
    found = Counter(
        state_of(split, size, i).parameters[kind] for i in entry.subsets["test"]
    )
    assert found.keys() == everywhere
    assert max(found.values()) - min(found.values()) <= 1


@pytest.mark.parametrize("split", SPLITS)
def test_boxes_of_all_sizes_are_one(split: str) -> None:
    """Walls lie at 1/16 in the cavity and on the free surface, whatever the grid, and
    bounds say so.
    """
    place = {"cavity": 1 / 16, "fluid": 1 / 16, "multimaterial": 1 / 16}.get(split)
    for name in SIZES:
        entry = registry.load().size(split, name)
        offset = 0.0 if split in ("fluid", "multimaterial") else 0.5
        low = (entry.value("wall") + offset) / entry.grid
        assert entry.bounds == ((low, 1 - low), (low, 1 - low))
        assert place in (None, low)


@pytest.mark.parametrize(("split", "size"), EVERY)
def test_solver_constants_come_from_the_registry(split: str, size: str) -> None:
    """Every constant that datasets.yaml names reaches the solver unchanged."""
    entry = registry.load().size(split, size)
    constants = importlib.import_module(entry.generator).solver_parameters(entry)
    for field in dataclasses.fields(constants):
        if field.name in entry.parameters:
            assert getattr(constants, field.name) == entry.value(field.name)
    assert constants.dt == pytest.approx(
        entry.frame_interval / entry.substeps_per_frame
    )
    if isinstance(constants, ClosedBoxParameters):
        assert constants.no_slip == (split == "cavity")


def test_bits_do_not_depend_on_vector_instructions() -> None:
    """A process without NumPy's vector kernels draws the same bits."""
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); import scenario_draws as t;"
        "print(*(t.digest(t.state_of(s, z, 3)) for s, z in t.EVERY))"
    )
    found = np.show_config(mode="dicts")["SIMD Extensions"]["found"]
    plain = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(found)}
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-c",
        script,
        str(Path(__file__).parents[1]),
    ]
    assert found, "this machine has no vector instructions to do without"
    result = subprocess.run(
        command,
        env=plain,
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.split() == [digest(state_of(s, z, 3)) for s, z in EVERY]


@pytest.mark.parametrize("module", DRAWN)
def test_sources_use_no_operation_that_rounds_by_library(module: str) -> None:
    """No libm function, power, matrix product or pairwise sum in what draws the
    data.
    """
    unsafe = {
        "sin", "cos", "tan", "arctan2", "atan2", "hypot", "exp", "log", "log2",
        "log10", "pow", "power", "cbrt", "dot", "matmul", "einsum", "inner",
        "tensordot", "linalg", "sum", "mean", "std", "var",
        "cumsum", "normal", "integers", "shuffle", "permutation", "fma",
    }  # fmt: skip
    tree = ast.parse((GENERATORS / f"{module}.py").read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp):
            assert not isinstance(node.op, ast.MatMult), ast.unparse(node)
            if isinstance(node.op, ast.Pow):
                # A constant power of two is folded by the compiler and exact.
                assert ast.literal_eval(node.left) == 2.0
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) != "_PRECISE":
            assert node.attr not in unsafe, ast.unparse(node)
