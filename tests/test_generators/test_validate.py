"""Ghia's tables, the diagnostics, the experiment's checks and the validate command."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scenarios import compiled
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from validation import __main__, diagnostics, experiment
from validation.experiment import Case, plan

BOX = diagnostics.SquareBox(low=0.0625, high=0.9375, cells=35)

Array = NDArray[np.float64]


def _tabulated(reynolds: int, name: str) -> tuple[Array, Array]:
    """Return ascending abscissae and values of one profile, walls included, misprints
    left out.
    """
    lines = diagnostics.centre_lines(reynolds)
    assert lines is not None
    if name == "u":
        points = np.array(diagnostics.Y)
        values = lines.u
        lid = 1.0
    else:
        points = np.array(diagnostics.X)
        values = lines.v
        lid = 0.0
    is_number = ~np.isnan(values)
    # the tables begin at the lid
    inner_points = points[is_number][::-1]
    inner_values = values[is_number][::-1]
    abscissae = np.concatenate([[0.0], inner_points, [1.0]])
    profile = np.concatenate([[0.0], inner_values, [lid]])
    return abscissae, profile


@pytest.mark.parametrize("name", ["u", "v"])
@pytest.mark.parametrize("reynolds", diagnostics.REYNOLDS)
def test_tabulated_profiles_have_no_slips(reynolds: int, name: str) -> None:
    """Mass is conserved in a closed box: each tabulated profile integrates to nearly 0.

    A wrong sign or first digit among the widely spaced points would move the integral
    by 0.01. Among the points 0.008 apart, each lies within 0.006 of a spline through
    the others.
    """
    abscissae, values = _tabulated(reynolds, name)
    whole = CubicSpline(abscissae, values)
    assert abs(whole.integrate(0.0, 1.0)) < 0.004
    gaps = abscissae[2:] - abscissae[:-2]
    crowded = np.flatnonzero(gaps < 0.017) + 1
    assert len(crowded) >= 3
    for i in crowded:
        others = np.arange(len(values)) != i
        spline = CubicSpline(abscissae[others], values[others])
        error = spline(abscissae[i]) - values[i]
        assert abs(error) < 0.006


def test_misprints_are_left_out() -> None:
    """The two misprints are NaN, everything else is a number, and Re 7 is not
    tabulated.

    Differences 3 and 4 beside a NaN: RMSE sqrt(25/2), maximum 4.
    """
    missing = set()
    for reynolds in diagnostics.REYNOLDS:
        lines = diagnostics.centre_lines(reynolds)
        for name in ("u", "v"):
            is_missing = np.isnan(getattr(lines, name))
            for index in np.flatnonzero(is_missing):
                missing.add((reynolds, name, int(index)))
    assert missing == {
        (400, "v", diagnostics.X.index(0.9063)),
        (3200, "u", diagnostics.Y.index(0.4531)),
    }
    assert diagnostics.centre_lines(7.0) is None
    measured = np.array([3.0, 9.0, -4.0])
    reference = np.array([0.0, np.nan, 0.0])
    deviation = diagnostics.deviation(measured, reference)
    assert deviation.rmse == pytest.approx(math.sqrt(12.5))
    assert deviation.maximum == 4.0


def test_occupancy_counts_every_particle_once() -> None:
    """One particle in each cell's middle gives all ones; one outside counts in the
    nearest cell.
    """
    x, y = np.meshgrid(BOX.nodes, BOX.nodes, indexing="ij")
    middles = np.stack([x.ravel(), y.ravel()], axis=-1)
    one_each = diagnostics.occupancy(middles, BOX)
    assert np.all(one_each == 1)
    outside = np.array([[0.0, 1.0]])
    counts = diagnostics.occupancy(outside, BOX)
    assert counts[0, -1] == 1
    assert counts.sum() == 1
    # of 35 x 35 cell centres 2 x 5 x 5 lie in the lid's corners
    corners = middles[diagnostics.lid_corners(middles, BOX)]
    assert len(corners) == 50
    assert corners[:, 1].min() > 0.5


def _nodal(u: Array, v: Array) -> Array:
    return np.stack([u, v], axis=-1)


def test_grid_rates_of_rotation_and_expansion() -> None:
    """Rigid rotation at rate 3 has vorticity 6 and no divergence; v = 2 x expands at
    4.
    """
    centred = BOX.nodes - 0.5
    x, y = np.meshgrid(centred, centred, indexing="ij")
    rotation = _nodal(-3.0 * y, 3.0 * x)
    turning = diagnostics.grid_rates(rotation, BOX.spacing)
    assert turning.vorticity == pytest.approx(6.0)
    assert turning.divergence == pytest.approx(0.0, abs=1e-12)
    expansion = _nodal(2.0 * x, 2.0 * y)
    expanding = diagnostics.grid_rates(expansion, BOX.spacing)
    assert expanding.divergence == pytest.approx(4.0)
    zeros = np.zeros((5, 5, 2))
    at_rest = diagnostics.grid_rates(zeros, 0.1)
    assert math.isnan(at_rest.ratio)


@pytest.mark.parametrize("cells", [34, 35])
def test_profiles_reproduce_a_polynomial_flow(cells: int) -> None:
    """Splines return u = 4 U x (1 - x) y^3 and v = 16 U y (1 - y) x (1 - x)(1 - 2 x),
    both cubic.

    The middle lies on a node for 35 cells and between nodes for 34.
    """
    box = diagnostics.SquareBox(low=0.06, high=0.94, cells=cells)
    s = (box.nodes - box.low) / box.width
    x, y = np.meshgrid(s, s, indexing="ij")
    x_arch = x * (1.0 - x)
    y_arch = y * (1.0 - y)
    u = 4.0 * x_arch * y**3
    v = 16.0 * y_arch * x_arch * (1.0 - 2.0 * x)
    velocity = 0.2 * _nodal(u, v)
    profiles = diagnostics.extract(velocity, box, 0.2)
    lines = profiles.at_reference_points()
    heights = np.array(diagnostics.Y)
    abscissae = np.array(diagnostics.X)
    arch = abscissae * (1 - abscissae)
    expected_v = 4.0 * arch * (1 - 2 * abscissae)
    assert lines.u == pytest.approx(heights**3, abs=1e-12)
    assert lines.v == pytest.approx(expected_v, abs=1e-12)


@pytest.mark.parametrize(
    ("case", "grid", "low", "particles", "dt"),
    [
        (Case.CAVITY, 40, 0.0625, 8192, 2e-3),
        (Case.CAVITY, 80, 0.05625, 32768, 1e-3),
        (Case.CAVITY, 56, 0.0625, 16056, 2e-3 * 40 / 56),
        (Case.CURL_NOISE, 40, 0.0375, 8096, 2e-3),
    ],
)
def test_plan_scales_the_full_size(
    case: Case,
    grid: int,
    low: float,
    particles: int,
    dt: float,
) -> None:
    """The box stays within half a cell, dt shrinks with dx, particles per cell stay."""
    reynolds = None
    if case is Case.CAVITY:
        reynolds = 400.0
    settings = plan(case, reynolds=reynolds, grid=grid, substeps=1)
    solver_parameters = experiment.solver_parameters(settings)
    box = diagnostics.box_of(solver_parameters)
    assert box.low == pytest.approx(low)
    assert settings.particles == particles
    assert settings.dt == pytest.approx(dt)
    assert settings.frame_substeps == round(0.1 / dt)


@pytest.fixture(autouse=True)
def compile_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every experiment take the solver that is there."""
    monkeypatch.setattr(experiment, "build", compiled)


def _arguments(folder: Path, *more: str) -> list[str]:
    """Return the options of a cavity on 16 x 16 cells, 1,311 particles."""
    result = folder / "result.json"
    return [
        "--case",
        "cavity",
        "--re",
        "100",
        "--grid",
        "16",
        "--substeps",
        "300",
        "--json",
        str(result),
        *more,
    ]


def _read_result(folder: Path) -> dict[str, Any]:
    """Return what the command wrote."""
    content = (folder / "result.json").read_text()
    result: dict[str, Any] = json.loads(content)
    return result


@pytest.mark.slow
def test_validate_reports_what_it_measured(tmp_path: Path) -> None:
    """Ghia's points with his values, errors that follow from them, checks, energy that
    grows.

    All but the timing is equal in a second run, to the byte; the picture is one.
    """
    profiles = tmp_path / "profiles.png"
    picture_options = ["--profiles", str(profiles)]
    texts = []
    for more in (picture_options, []):
        arguments = _arguments(tmp_path, *more)
        assert __main__.main(arguments) == 0
        found = _read_result(tmp_path)
        timing = found.pop("timing")
        assert timing["particle_substeps_per_second"] > 0.0
        texts.append(json.dumps(found))
    assert texts[0] == texts[1]
    assert profiles.read_bytes().startswith(b"\x89PNG")
    lines = found["centre_lines"]
    heights = [point["y"] for point in lines["u"]]
    assert heights == list(diagnostics.Y)
    assert lines["v"][0]["ghia"] == -0.05906
    squares = []
    for point in lines["u"]:
        error = point["u"] - point["ghia"]
        squares.append(error**2)
    rmse = math.sqrt(sum(squares) / 15)
    assert found["ghia"]["u_rmse"] == pytest.approx(rmse)
    assert found["empty_cells"] == 0
    jacobian = found["jacobian"]
    energy = found["kinetic_energy"]
    check_substeps = [check["substep"] for check in found["checks"]]
    assert jacobian["min"] <= jacobian["min_outside_lid_corners"]
    assert jacobian["min_outside_lid_corners"] <= 1.0
    assert energy["substep"] == list(range(0, 301, 20))
    assert energy["value"] == sorted(energy["value"])
    assert check_substeps == [300]


@pytest.mark.slow
def test_validate_stops_the_lid_where_nothing_is_tabulated(tmp_path: Path) -> None:
    """The energy falls once the lid stops; at Re 250 there is no table, so errors are
    null.
    """
    arguments = [
        *_arguments(tmp_path),
        "--re",
        "250",
        "--substeps",
        "600",
        "--lid-off-after",
        "300",
    ]
    assert __main__.main(arguments) == 0
    found = _read_result(tmp_path)
    course = found["kinetic_energy"]
    energy = dict(zip(course["substep"], course["value"], strict=True))
    assert energy[600] < 0.95 * energy[300]
    assert found["largest_rise_after_lid_off"] < 0.0
    assert found["ghia"] is None
    first_point = found["centre_lines"]["u"][0]
    assert first_point["ghia"] is None


@pytest.mark.slow
def test_validate_curl_noise(tmp_path: Path) -> None:
    """Most of the energy is left after ten frames, and divergence is small against
    vorticity.
    """
    target = tmp_path / "curl.json"
    options = [
        "--case",
        "curl-noise",
        "--grid",
        "20",
        "--frequency",
        "2",
        "--substeps",
        "500",
    ]
    arguments = [*options, "--json", str(target)]
    assert __main__.main(arguments) == 0
    found = json.loads(target.read_text())
    assert found["centre_lines"] is None
    assert 0.5 < found["energy_retention"] < 1.1
    assert found["divergence_over_vorticity"] < 0.1
