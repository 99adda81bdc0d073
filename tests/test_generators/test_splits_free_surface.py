"""Fluid and multimaterial: bodies, their places and velocities against the thesis."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scenario_draws import (
    SIZES,
    all_of,
    changed,
    digest,
    draw,
    neighbours,
    shifted,
    state_of,
    usual_ids,
)
from scipy.spatial import cKDTree

from lagbench.data import registry
from lagbench.generators.split import InitialState, Material

SPLITS = ("fluid", "multimaterial")
DECLARED = [
    (split, name)
    for split in SPLITS
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
    special = {
        "gap": 0.1,
        "gap_cells": 2,
        "jacobian_max": 1.1,
    }
    if name in special:
        return special[name]
    if isinstance(value, int):
        return value + 1
    if name.endswith("_max"):
        return 0.8 * value or -0.1
    return 1.25 * value or 0.1


@pytest.mark.parametrize(("split", "name"), DECLARED)
def test_every_parameter_decides_bits(split: str, name: str) -> None:
    """Another value in datasets.yaml gives another solver constant or another initial
    state.
    """
    # only the larger sizes have scenarios of shift
    parameter = registry.load().split(split).parameters[name]
    shift_only = parameter.subset == "shift"
    size_name = "tiny"
    if shift_only:
        size_name = "mini"
    size = registry.load().size(split, size_name)
    ids = size.scenarios
    if shift_only:
        ids = size.subsets["shift"]
    new_value = other_value(name, size.value(name))
    other = changed(size, **{name: new_value})
    constants = importlib.import_module(size.generator).solver_parameters
    if repr(constants(other)) != repr(constants(size)):
        return
    before = []
    after = []
    for i in ids:
        before.append(digest(state_of(split, size_name, i)))
        after.append(digest(draw(other, i)))
    assert after != before


@pytest.mark.parametrize(
    ("split", "kind", "expected"),
    [
        ("fluid", "family", FAMILIES),
        ("multimaterial", "pair", PAIRS),
    ],
)
def test_kinds_follow_the_id(
    split: str,
    kind: str,
    expected: list[str],
) -> None:
    """The id modulo 4 or 6, in the order of Table 4.8, whose 0 and 26 are a rectangle
    and a circle.
    """
    for size in SIZES:
        entry = registry.load().size(split, size)
        kinds = {}
        for i in usual_ids(entry):
            state = state_of(split, size, i)
            kinds[i] = state.parameters[kind]
            number = i % len(expected)
            assert kinds[i] == expected[number]
        if (split, size) != ("fluid", "tiny"):
            test_kinds = {kinds[i] for i in entry.subsets["test"]}
            assert test_kinds == set(expected)


@pytest.mark.parametrize("size", SIZES)
def test_fluid_bodies_are_within_their_ranges(size: str) -> None:
    """Areas 0.04-0.06; velocities per family; a margin of 0.02 to every wall."""
    described = registry.load().size("fluid", size)
    (low, high), _ = described.bounds
    for state in all_of("fluid", size):
        assert 0.04 <= state.area <= 0.06
        assert low + 0.02 - 1e-5 <= state.position.min()
        assert state.position.max() <= high - 0.02 + 1e-5
        assert (state.material == Material.LIQUID).all()
        family = state.parameters["family"]
        velocity = state.velocity
        height = state.position[:, 1]
        if family == "thrown":
            assert (velocity >= [1.0, 0.0]).all()
            assert (velocity <= [2.0, 1.0]).all()
        elif family != "splash":
            assert np.abs(velocity).max() <= 0.3
            assert velocity[:, 1].max() <= 0.0
            assert height.min() >= 0.35
        if family != "splash":
            assert (velocity == velocity[0]).all()


@pytest.mark.parametrize("size", ["full", "mini"])
def test_shifted_liquid_lies_outside_train(size: str) -> None:
    """Half has about twice the liquid; half is a column on the floor beside a wall."""
    described = registry.load().size("fluid", size)
    (low, high), _ = described.bounds
    states = shifted("fluid", size)
    for state in states[::2]:
        assert 0.09 <= state.area <= 0.11
    for state in states[1::2]:
        assert state.parameters["family"] == "column"
        assert 0.04 <= state.area <= 0.06
        assert not state.velocity.any()
        x, y = state.position.T
        width = np.ptp(x)
        height = np.ptp(y)
        assert 1.4 <= height / width <= 2.6
        assert y.min() < low + 0.02
        left_gap = x.min() - low
        right_gap = high - x.max()
        assert 0.0 <= min(left_gap, right_gap) < 0.01
        assert low <= state.position.min()
        assert state.position.max() <= high


def test_shifted_scenes_have_three_bodies_apart() -> None:
    """Three bodies of three materials, each at least 0.04 from the others; together
    they hold all particles.
    """
    for state in shifted("multimaterial"):
        materials = np.unique(state.material)
        assert len(materials) == 3
        names = str(state.parameters["pair"]).split("-")
        assert len(names) == 3
        for kind in materials:
            is_own = state.material == kind
            own = state.position[is_own]
            others = state.position[~is_own]
            distance, _ = cKDTree(own).query(others)
            assert distance.min() >= 0.04 - 2 * 2.0**-20


def test_fluid_splash_has_blobs_and_noise() -> None:
    """Neighbours share their blob's velocity; their difference is the noise, N(0,
    0.5).
    """
    differences = []
    speeds = []
    for state in all_of("fluid")[3::4]:
        _, nearest = neighbours(state.position, 60)
        partner = nearest[:, 1]
        difference = state.velocity - state.velocity[partner]
        mean = state.velocity[nearest].mean(axis=1)
        differences.append(difference)
        speeds.append(mean - [0.0, 0.5])
    # Variance of a difference of two: 2 x 0.25, plus a little of the blend.
    deviation = np.std(np.concatenate(differences))
    expected = math.sqrt(0.5)
    assert deviation == pytest.approx(expected, rel=0.03)
    # Where discs of N(0, 0.7) meet, their velocities are blended.
    blended = np.std(np.concatenate(speeds))
    assert 0.3 < blended < 0.8


Positions = NDArray[np.float64]


def halves(
    state: InitialState,
    size: registry.Size,
) -> tuple[Positions, Positions]:
    """Split a state's particles into its two bodies by their recorded areas."""
    first = float(state.parameters["first_area"])
    share = first / state.area
    first_count = round(size.particles * share)
    position = state.position
    return position[:first_count], position[first_count:]


@pytest.mark.parametrize("size", SIZES)
def test_multimaterial_bodies_keep_apart(size: str) -> None:
    """No particle of one body within 0.038 of the other's; both inside the margin."""
    entry = registry.load().size("multimaterial", size)
    low, high = entry.bounds[0]
    for state in all_of("multimaterial", size):
        first, second = halves(state, entry)
        gaps, _ = neighbours(second, 1, among=first)
        assert gaps.min() > 0.038
        assert low + 0.02 - 1e-5 <= state.position.min()
        assert state.position.max() <= high - 0.02 + 1e-5


def test_multimaterial_shares_particles_and_areas() -> None:
    """Materials change where the first body's share ends; a rope is 0.05 wide."""
    entry = registry.load().size("multimaterial", "full")
    for state in all_of("multimaterial"):
        first, second = halves(state, entry)
        words = str(state.parameters["pair"]).split("-")
        first_material, second_material = np.split(state.material, [len(first)])
        expected = [Material[word.upper()] for word in words]
        assert (first_material == expected[0]).all()
        assert (second_material == expected[1]).all()
        first_area = float(state.parameters["first_area"])
        second_area = float(state.parameters["second_area"])
        areas = [first_area, second_area]
        bodies = [first, second]
        assert math.fsum(areas) == pytest.approx(state.area)
        for number, word in enumerate(words):
            area = areas[number]
            if word == "rope":
                covariance = np.cov(bodies[number].T, bias=True)
                moments = np.linalg.eigvalsh(covariance)
                width, length = np.sqrt(12 * moments)
                assert width == pytest.approx(0.05, rel=0.04)
                assert 0.54 < length < 0.76
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
        friction = 0.05
        if "liquid" in str(state.parameters["pair"]):
            friction = 0.0
        assert state.friction == friction
        assert state.parameters["friction"] == friction
        p = {}
        for name, value in state.parameters.items():
            if not isinstance(value, str):
                p[name] = float(value)
        for axis in ("x", "y"):
            first_velocity = p[f"first_velocity_{axis}"]
            second_velocity = p[f"second_velocity_{axis}"]
            first_centre = p[f"first_centre_{axis}"]
            second_centre = p[f"second_centre_{axis}"]
            approach = first_velocity - second_velocity
            expected = p["attraction"] * (second_centre - first_centre)
            assert approach == pytest.approx(expected, abs=4 * 2.0**-20)
        speed = np.abs(state.velocity)
        assert speed.max() < 2.5
