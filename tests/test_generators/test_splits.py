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
from lagbench.generators.full_box_parameters import FullBoxParameters

GENERATORS = Path(draws.__file__).parent
KINDS = [
    ("cavity", "wall"),
    ("curl-noise", "frequency"),
    ("fluid", "family"),
    ("multimaterial", "pair"),
]
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
    particles = entry.particles
    for state in all_of(split, size)[:12]:
        assert state.position.shape == (particles, 2)
        assert state.velocity.shape == (particles, 2)
        assert state.affine.shape == (particles, 2, 2)
        assert state.material.shape == (particles,)
        assert state.material.dtype == np.int8
        for values in (
            state.position,
            state.velocity,
            state.affine,
            state.wall_velocity,
        ):
            assert values.dtype == np.float64
            rounded = values.astype(np.float32)
            multiples = values * 2**20
            assert (rounded == values).all()
            assert (multiples == np.rint(multiples)).all()
        assert low < state.position.min()
        assert state.position.max() < high
        for value in state.parameters.values():
            assert isinstance(value, int | float | str)


@pytest.mark.parametrize("split", SPLITS)
def test_scenarios_differ_and_repeat(split: str) -> None:
    """Drawn twice a scenario is the same; no two of a split's scenarios are."""
    states = all_of(split)
    digests = {digest(state) for state in states}
    assert len(digests) == len(states)
    size = registry.load().size(split, "full")
    again = draw(size, 3)
    expected = state_of(split, "full", 3)
    assert digest(again) == digest(expected)


@pytest.mark.parametrize("size", ["full", "mini"])
@pytest.mark.parametrize(("split", "kind"), KINDS)
def test_kinds_are_spread_evenly_over_test(
    split: str,
    kind: str,
    size: str,
) -> None:
    """Every kind of scenario occurs in test, none more than once more often than
    another.
    """
    entry = registry.load().size(split, size)
    count = 16
    if split == "cavity":
        count = 20
    assert len(entry.subsets["test"]) == count
    assert len(entry.subsets["valid"]) == 8
    everywhere = {state.parameters[kind] for state in all_of(split, size)}
    found: Counter[object] = Counter()
    for scenario in entry.subsets["test"]:
        state = state_of(split, size, scenario)
        found[state.parameters[kind]] += 1
    assert found.keys() == everywhere
    most = max(found.values())
    least = min(found.values())
    assert most - least <= 1


@pytest.mark.parametrize("split", SPLITS)
def test_boxes_of_all_sizes_are_one(split: str) -> None:
    """Walls lie at 1/16 in the cavity and on the free surface, whatever the grid, and
    bounds say so.
    """
    for name in SIZES:
        entry = registry.load().size(split, name)
        offset = 0.5
        if split in ("fluid", "multimaterial"):
            offset = 0.0
        low = (entry.value("wall") + offset) / entry.grid
        side = (low, 1 - low)
        assert entry.bounds == (side, side)
        if split != "curl-noise":
            assert low == 1 / 16


@pytest.mark.parametrize(("split", "size"), EVERY)
def test_solver_constants_come_from_the_registry(split: str, size: str) -> None:
    """Every constant that datasets.yaml names reaches the solver unchanged."""
    entry = registry.load().size(split, size)
    generator = importlib.import_module(entry.generator)
    constants = generator.solver_parameters(entry)
    for field in dataclasses.fields(constants):
        if field.name in entry.parameters:
            value = getattr(constants, field.name)
            assert value == entry.value(field.name)
    dt = entry.frame_interval / entry.substeps_per_frame
    assert constants.dt == pytest.approx(dt)
    if isinstance(constants, FullBoxParameters):
        assert constants.no_slip == (split == "cavity")


def test_bits_do_not_depend_on_vector_instructions() -> None:
    """A process without NumPy's vector kernels draws the same bits."""
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); import scenario_draws as t;"
        "print(*(t.digest(t.state_of(s, z, 3)) for s, z in t.EVERY))"
    )
    extensions = np.show_config(mode="dicts")["SIMD Extensions"]
    found = extensions["found"]
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
    expected = []
    for split, size in EVERY:
        state = state_of(split, size, 3)
        expected.append(digest(state))
    assert result.stdout.split() == expected


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
    source = (GENERATORS / f"{module}.py").read_text()
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp):
            is_product = isinstance(node.op, ast.MatMult)
            assert not is_product, ast.unparse(node)
            if isinstance(node.op, ast.Pow):
                # A constant power of two is folded by the compiler and exact.
                assert ast.literal_eval(node.left) == 2.0
        if not isinstance(node, ast.Attribute):
            continue
        if ast.unparse(node.value) != "_PRECISE":
            assert node.attr not in unsafe, ast.unparse(node)
