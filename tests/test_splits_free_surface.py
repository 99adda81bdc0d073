"""Fluid and multimaterial: bodies, their places and velocities against the design."""

from __future__ import annotations

import ast
import importlib
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from scenario_draws import SIZES, all_of, changed, digest, draw, neighbours, state_of
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lagbench.data import registry
from lagbench.errors import WorkFailedError
from lagbench.generators import fluid, multimaterial
from lagbench.generators.split import InitialState, Material

DECLARED = [
    (split, name)
    for split in ("fluid", "multimaterial")
    for name in registry.load().split(split).parameters
]


FAMILIES = ["falling-rectangle", "thrown", "falling-circle", "splash"]
PAIRS = [
    "liquid-snow",
    "rope-snow",
    "rope-liquid",
    "snow-snow",
    "rope-jelly",
    "liquid-liquid",
]


def other_value(name: str, value: float) -> float:
    """Return another value of a parameter with which bodies can still be drawn."""
    # A gap shows by another verdict on a placement only; a J of liquid below 1 is
    # refused.
    special = {"gap": 0.1, "gap_cells": 2, "jacobian_max": 1.1}
    factor, instead_of_nothing = (0.8, -0.1) if name.endswith("_max") else (1.25, 0.1)
    return special.get(
        name,
        value + 1 if isinstance(value, int) else factor * value or instead_of_nothing,
    )


@pytest.mark.parametrize(("split", "name"), DECLARED)
def test_every_parameter_decides_bits(split: str, name: str) -> None:
    """Another value in datasets.yaml gives another solver constant or another initial
    state.
    """
    size = registry.load().size(split, "tiny")
    other = changed(size, **{name: other_value(name, size.value(name))})
    constants = importlib.import_module(size.generator).solver_parameters
    assert repr(constants(other)) != repr(constants(size)) or any(
        digest(draw(other, i)) != digest(state_of(split, "tiny", i))
        for i in size.scenarios
    )


@pytest.mark.parametrize("module", [fluid, multimaterial])
def test_no_number_in_the_source_decides_bits(module: ModuleType) -> None:
    """What is drawn has its ranges in datasets.yaml: the source holds 0, 1, 2, halves
    and a limit.
    """
    tree = ast.parse(Path(str(module.__file__)).read_text())
    numbers = {
        n.value
        for n in ast.walk(tree)
        if isinstance(n, ast.Constant) and type(n.value) in (int, float)
    }
    assert numbers <= {0, 0.5, 1, 2, getattr(module, "_ATTEMPTS", 0)}


@pytest.mark.parametrize(
    ("split", "kind", "expected"),
    [("fluid", "family", FAMILIES), ("multimaterial", "pair", PAIRS)],
)
def test_kinds_follow_the_id(split: str, kind: str, expected: list[str]) -> None:
    """The id modulo 4 or 6, in the order of Table 4.8, whose 0 and 26 are a rectangle
    and a circle.
    """
    for size in SIZES:
        entry = registry.load().size(split, size)
        found = {i: state_of(split, size, i).parameters[kind] for i in entry.scenarios}
        assert found == {i: expected[i % len(expected)] for i in entry.scenarios}
        assert (split, size) == ("fluid", "tiny") or {
            found[i] for i in entry.subsets["test"]
        } == set(expected)


@pytest.mark.parametrize("size", SIZES)
def test_fluid_bodies_are_within_their_ranges(size: str) -> None:
    """Areas 0.04-0.06; velocities per family; a margin of 0.02 to every wall."""
    (low, high), _ = registry.load().size("fluid", size).bounds
    for state in all_of("fluid", size):
        assert 0.04 <= state.area <= 0.06
        assert low + 0.02 - 1e-5 <= state.position.min()
        assert state.position.max() <= high - 0.02 + 1e-5
        assert (state.material == Material.LIQUID).all()
        family = state.parameters["family"]
        velocity = state.velocity
        if family == "thrown":
            assert (velocity >= [1.0, 0.0]).all()
            assert (velocity <= [2.0, 1.0]).all()
        elif family != "splash":
            assert np.abs(velocity).max() <= 0.3
            assert velocity[:, 1].max() <= 0.0
            assert state.position[:, 1].min() >= 0.35
        if family != "splash":
            assert (velocity == velocity[0]).all()


def test_fluid_bodies_cover_their_area_in_one_piece() -> None:
    """Particles within 1.8 spacings of each other form one piece; the cells they occupy
    count right.
    """
    for state in all_of("fluid")[:16]:
        spacing = math.sqrt(state.area / len(state.position))
        pairs = cKDTree(state.position).sparse_distance_matrix(
            cKDTree(state.position), 1.8 * spacing
        )
        assert connected_components(pairs)[0] == 1
        cells = np.unique(np.floor(state.position / (1.6 * spacing)), axis=0)
        # Occupied cells overcount by about half the outline's: 5 to 30 % here.
        assert 1.0 < len(cells) * (1.6 * spacing) ** 2 / state.area < 1.3


def test_fluid_splash_has_blobs_and_noise() -> None:
    """Neighbours share their blob's velocity; their difference is the noise, N(0,
    0.5).
    """
    differences = []
    speeds = []
    for state in all_of("fluid")[3::4]:
        nearest = neighbours(state.position, 60)[1]
        differences.append(state.velocity - state.velocity[nearest[:, 1]])
        speeds.append(state.velocity[nearest].mean(axis=1) - [0.0, 0.5])
    # Variance of a difference of two: 2 x 0.25, plus a little of the blend.
    assert np.std(np.concatenate(differences)) == pytest.approx(
        math.sqrt(0.5), rel=0.03
    )
    # Where discs of N(0, 0.7) meet, their velocities are blended.
    assert 0.3 < np.std(np.concatenate(speeds)) < 0.8


def halves(
    state: InitialState, size: registry.Size
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split a state's particles into its two bodies by their recorded areas."""
    first = float(state.parameters["first_area"])
    own = round(size.particles * first / state.area)
    return state.position[:own], state.position[own:]


@pytest.mark.parametrize("size", SIZES)
def test_multimaterial_bodies_keep_apart(size: str) -> None:
    """No particle of one body within 0.038 of the other's; both inside the margin."""
    entry = registry.load().size("multimaterial", size)
    (low, high), _ = entry.bounds
    for state in all_of("multimaterial", size):
        first, second = halves(state, entry)
        assert neighbours(second, 1, among=first)[0].min() > 0.038
        assert low + 0.02 - 1e-5 <= state.position.min()
        assert state.position.max() <= high - 0.02 + 1e-5


def test_multimaterial_shares_particles_and_areas() -> None:
    """Materials change where the first body's share ends; a rope is 0.05 wide."""
    entry = registry.load().size("multimaterial", "full")
    for state in all_of("multimaterial"):
        first, second = halves(state, entry)
        words = str(state.parameters["pair"]).split("-")
        expected = [Material[word.upper()] for word in words]
        assert (state.material[: len(first)] == expected[0]).all()
        assert (state.material[len(first) :] == expected[1]).all()
        areas = [
            float(state.parameters[f"{name}_area"]) for name in ("first", "second")
        ]
        assert math.fsum(areas) == pytest.approx(state.area)
        for word, area, body in zip(words, areas, (first, second), strict=True):
            if word == "rope":
                narrow, wide = np.linalg.eigvalsh(np.cov(body.T, bias=True))
                assert math.sqrt(12 * narrow) == pytest.approx(0.05, rel=0.04)
                assert 0.54 < math.sqrt(12 * wide) < 0.76
                assert 0.55 * 0.05 <= area <= 0.75 * 0.05
            else:
                assert 0.045 <= area <= 0.06
        if "jelly" in words:
            assert state.parameters["second_shape"] == "disc"


def test_multimaterial_bodies_move_towards_one_point() -> None:
    """v_1 - v_2 = rate (c_2 - c_1): the common point drops out. Walls brake where no
    body is liquid.
    """
    for state in all_of("multimaterial"):
        dry = "liquid" not in str(state.parameters["pair"])
        assert state.friction == state.parameters["friction"] == (0.05 if dry else 0.0)
        p = {k: float(v) for k, v in state.parameters.items() if not isinstance(v, str)}
        for axis in ("x", "y"):
            approach = p[f"first_velocity_{axis}"] - p[f"second_velocity_{axis}"]
            apart = p[f"second_centre_{axis}"] - p[f"first_centre_{axis}"]
            assert approach == pytest.approx(p["attraction"] * apart, abs=4 * 2.0**-20)
        assert np.abs(state.velocity).max() < 2.5


def test_multimaterial_gives_up_when_there_is_no_room() -> None:
    """Bodies that cannot lie side by side are an error, not an endless search."""
    size = changed(
        registry.load().size("multimaterial", "tiny"), area_min=0.45, area_max=0.45
    )
    with pytest.raises(
        WorkFailedError, match=r"(?s)no room.*gap of 0\.04.*1000 attempts"
    ):
        draw(size, 5)
