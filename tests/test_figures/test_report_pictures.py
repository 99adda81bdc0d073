"""Pictures of the report: right colours at right places, right shares of nodes."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from PIL import Image

from lagbench.data.box import Box
from lagbench.data.grid import Grid, Placement, fields
from lagbench.figures.html import Markup, draw_image_panel, draw_line_panel
from lagbench.figures.report.arrows import arrow_data, draw_obstacle
from lagbench.figures.report.distributions import histogram_shares
from lagbench.figures.report.maps import (
    LEVELS,
    aspect_of,
    draw_diverging_map,
    draw_sequential_map,
)
from lagbench.figures.report.particles import SIDE, draw_materials

BLUE = [0x00, 0x72, 0xB2]
VERMILION = [0xD5, 0x5E, 0x00]
ORANGE = [0xE6, 0x9F, 0x00]
GREY = [128, 128, 128, 34]
OPAQUE = 255


def read_pixels(png: bytes) -> NDArray[np.uint8]:
    """Return a PNG as red, green, blue and opacity, read by Pillow."""
    image = Image.open(io.BytesIO(png))
    return np.asarray(image.convert("RGBA"))


def test_signed_maps_are_blue_below_zero_and_vermilion_above() -> None:
    """Zero is clear, no value is grey; x goes right, y up."""
    # [x, y]
    field = np.array(
        [
            [-1.0, 0.0],
            [0.5, np.nan],
        ]
    )
    shown = read_pixels(draw_diverging_map(field, 1.0))
    assert shown.shape == (2, 2, 4)
    half_opaque = round(OPAQUE * 0.5)
    top_left, top_right = shown[0]
    lower_left, lower_right = shown[1]
    assert top_left[3] == 0
    assert top_right.tolist() == GREY
    assert lower_left.tolist() == [*BLUE, OPAQUE]
    assert lower_right.tolist() == [*VERMILION, half_opaque]


def test_panels_have_the_aspect_of_the_box() -> None:
    """A square says nothing; the panel of a channel is as wide as the channel."""
    assert aspect_of(np.zeros((64, 40))) == 1.6
    square = draw_image_panel(b"", "panel", "a field")
    assert "aspect-ratio" not in square
    channel = draw_image_panel(b"", "panel", "a field", aspect=1.6)
    assert 'style="aspect-ratio:1.6"' in channel
    lines = draw_line_panel(Markup(""), "panel", "arrows", aspect=1.6)
    assert 'style="aspect-ratio:1.6"' in lines
    assert 'viewBox="0 0 200 125"' in lines


def test_arrows_stand_around_the_obstacle() -> None:
    """The disc lies at its place in a channel of 1 by 0.625; boxes may have none."""
    box = Box(low=(0.0, 0.1875), high=(1.0, 0.8125), periodic=(True, False))
    grid = Grid(16, Placement.CELL_CENTRES, box)
    position = np.array([[0.5, 0.5], [0.6, 0.5]])
    flow = fields(position, np.zeros((2, 2)), grid, full=1.0)
    disc = draw_obstacle(flow, np.float32([0.25, 0.5, 0.0625]))
    for attribute in ('cx="50.00"', 'cy="62.50"', 'r="12.50"'):
        assert attribute in disc
    assert draw_obstacle(flow, None) == ""
    assert draw_obstacle(flow, np.float32([0.25, 0.5, 0.5, 0.0625])) == ""


def test_values_beyond_the_limit_have_its_colour() -> None:
    """Even an infinite value does."""
    field = np.full((1, 1), np.inf)
    shown = read_pixels(draw_diverging_map(field, 1.0))
    pixel = shown[0, 0]
    assert pixel.tolist() == [*VERMILION, OPAQUE]


def test_opacity_of_magnitudes_grows_up_to_the_limit() -> None:
    """Beyond the limit it stays full."""
    magnitudes = np.linspace(0.0, 2.0, LEVELS + 1)[:, None]
    shown = read_pixels(draw_sequential_map(magnitudes, 1.0))
    opacity = shown[0, :, 3].astype(int)
    assert opacity[0] == 0
    steps = np.diff(opacity)
    assert (steps >= 0).all()
    beyond_the_limit = opacity[LEVELS // 2 :]
    assert (beyond_the_limit == OPAQUE).all()


def test_particles_are_discs_of_their_material() -> None:
    """Discs lie at the places of the particles; those outside are not drawn."""
    in_first_quarter = [0.25, 0.75]
    in_last_quarter = [0.75, 0.25]
    outside = [1.5, 0.5]
    position = np.array([in_first_quarter, in_last_quarter, outside])
    material = np.array([0, 3, 1])
    unit_square = ((0.0, 1.0), (0.0, 1.0))
    png = draw_materials(position, material, view=unit_square, spacing=0.1)
    shown = read_pixels(png)
    assert shown.shape == (SIDE, SIDE, 4)
    near = SIDE // 4
    far = 3 * SIDE // 4
    liquid = shown[near, near]
    assert liquid.tolist() == [*BLUE, OPAQUE]
    rope = shown[far, far]
    assert rope.tolist() == [*ORANGE, OPAQUE]
    radius = 0.5 * 1.25 * 0.1 * SIDE
    disc_area = math.pi * radius**2
    covered = shown[..., 3].sum() / OPAQUE
    assert covered == pytest.approx(2 * disc_area, rel=0.03)


def test_arrows_point_along_their_velocity() -> None:
    """The shaft is centred on its node; a short arrow is a dot."""
    _, shaft, head = arrow_data(50.0, 50.0, 20.0, 0.0).split("M")
    assert shaft == "40 50L60 50"
    _, tip, *_ = head.split("L")
    assert tip == "60 50"
    dot = arrow_data(50.0, 50.0, 0.1, 0.0)
    assert dot == "M50 50h0"


def test_histogram_shares_within_the_truths_range_are_those_of_numpy() -> None:
    """The first and the last bin hold the values beyond that range."""
    rng = np.random.Generator(np.random.PCG64(3))
    truth = rng.random(500)
    guess = 3.0 * rng.random(500) - 1.0
    edges, shares = histogram_shares(guess, truth)
    assert edges[0] == truth.min()
    assert edges[-1] == truth.max()
    assert shares.sum() == pytest.approx(100.0)
    counts, _ = np.histogram(guess, edges)
    expected = 100.0 * counts / 500
    inside = shares[1:-1]
    assert_allclose(inside, expected[1:-1])
    assert shares[0] > expected[0]
    assert shares[-1] > expected[-1]


def test_no_values_have_no_shares() -> None:
    """Without nodes every bin is empty."""
    nothing = np.array([])
    _, shares = histogram_shares(nothing, nothing)
    assert shares.sum() == 0.0
