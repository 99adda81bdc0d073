"""Every entry of the table of metrics: told, perfect on the truth, worse when the error grows."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

import numpy as np
import pytest
from metric_flows import Floats, pairs_of, rollout, scenario_of

from lagbench.data.grid import Grid, Placement
from lagbench.errors import UsageError
from lagbench.metrics import FAMILIES, METRICS, Direction, Metric, Score, aggregate, available, select, tally
from lagbench.metrics import table as table_module

NAMES = sorted(METRICS)
MEASURED = select(known=METRICS)  # Sinkhorn, optional and slow, has tests of its own
LENGTHS = re.compile(r"(1|%|nat|frame|(mass )?length(\^2)?(/frame(\^2)?)?|1/frame(\^2)?)")
STATES = ("liquid", "jelly", "snow", "rope")


@functools.cache
def scores(size: float) -> dict[str, Score]:
    """Score a rollout of all four materials whose error has this size."""
    frames = 54
    truth = rollout(frames=frames, side=40, speed=0.002)
    rng = np.random.default_rng(7)
    scattered = rng.standard_normal(truth.shape[1:])
    drift = np.array([0.004, 0.002])
    step = truth[1:] - truth[:-1]
    wrong = 0.4 * step + 0.0001 * scattered + 0.05 * drift + 0.01 * (truth[:-1] - 0.4)
    error = np.concatenate([np.zeros((2, *truth.shape[1:])), np.cumsum(wrong[1:], axis=0)])
    material = np.repeat(range(4), 400)
    found: dict[str, Score] = {}
    for placement in Placement:  # no one box is full and has a surface
        scenario = scenario_of(
            truth,
            material=material,
            materials=STATES,
            horizon=frames - 2,
            grid=Grid(20, placement),
            radius=0.04,
        )
        pairs = pairs_of(scenario, truth, truth + size * error)
        found = aggregate(MEASURED, {0: tally(pairs, MEASURED, scenario.setting.predicted_frames)}) | found
    return found


def judged() -> list[str]:
    """Return the names of the metrics that rank something."""
    return [m.name for m in MEASURED if m.direction is not Direction.NONE]


@pytest.mark.parametrize("name", NAMES)
def test_every_metric_is_told(name: str) -> None:
    """Name, family, unit, direction, source and summary are all there and well formed."""
    metric = METRICS[name]
    assert metric.name == name
    assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name)
    assert metric in FAMILIES[metric.family]
    assert LENGTHS.fullmatch(metric.unit), metric.unit
    assert re.match(
        r"Eqs?\. \d|Figs?\. \d|section \d|design section|design 2, section|LagrangeBench", metric.source
    )
    assert 8 < len(metric.summary) <= 100
    assert all(needed in METRICS for needed in metric.of)
    assert (metric.direction is Direction.NONE) <= (metric.perfect is None)


@pytest.mark.parametrize("name", NAMES)
def test_every_summary_reads_as_one(name: str) -> None:
    """Each summary is one line that starts with a capital and does not end in a full stop."""
    summary = METRICS[name].summary
    assert summary[0].isupper() or summary[0].isdigit()
    assert not summary.endswith(".")
    assert "\n" not in summary


@pytest.mark.parametrize("name", judged())
def test_truth_against_itself_is_perfect(name: str) -> None:
    """The truth as its own prediction gets exactly the perfect value: 0 or 1, and no frame undefined."""
    found = scores(0.0)[name]
    expected = METRICS[name].perfect if name != "stable_frames" else 52.0
    assert found.mean == expected
    assert found.undefined == (0,)


@pytest.mark.parametrize("name", judged())
def test_a_growing_error_is_a_growing_loss(name: str) -> None:
    """The loss never falls while the error grows tenfold and more, and rises over all."""
    metric = METRICS[name]
    losses = [metric.loss(scores(size)[name].mean) for size in (0.0, 0.1, 0.5, 2.5)]
    assert losses == sorted(losses)
    assert losses[-1] > losses[0]


def test_every_metric_was_measured_here() -> None:
    """The rollout of these tests has every metric, so that none escapes them."""
    assert set(scores(0.1)) == {m.name for m in MEASURED}
    assert not any(math.isnan(found.mean) for found in scores(0.1).values())


def test_the_tables_of_the_design_are_complete() -> None:
    """Everything that design section 8 lists has an entry."""
    errors = [f"{of}_{law}" for of in ("position", "velocity", "vorticity") for law in ("mse", "mae", "rmse")]
    fields = [
        "vorticity_pearson",
        "vorticity_kl",
        "vorticity_kl_hist",
        "vorticity_kl_hist_abs",
        "vorticity_w1",
    ]
    energies = ["energy_ratio", "energy_retention", "energy_error"]
    conserved = ["momentum_error", "angular_momentum_error", "density_rmse", "divergence_rms"]
    rest = ["attribute_mse", "mse_avg", "mse_end", "stable_frames", "shape_error", "connectivity"]
    assert {*errors, *fields, *energies, *conserved, *rest, "sliced_w2", "sinkhorn_pot"} <= set(METRICS)
    assert {f"mse_avg_{h}" for h in (1, 5, 10, 20, 50)} <= set(METRICS)
    residual = {n.removeprefix("vorticity_residual_") for n in METRICS if n.startswith("vorticity_residual_")}
    assert residual == {"mean", "std", "max", "slope", "p05", "p25", "p50", "p75", "p95"}


def test_our_metrics_are_registered_as_those_of_others_are() -> None:
    """Each family stands in the entry-point group, and loading it gives the same objects."""
    ours = {
        p.name: p.load() for p in entry_points(group="lagbench.metrics") if p.value.startswith("lagbench.")
    }
    assert ours == dict(FAMILIES)
    assert {name: available()[name] for name in METRICS} == dict(METRICS)


def enstrophy_error(pair: object) -> float:
    """Return a constant; stands for another package's statistic."""
    return 1.0


OTHERS = Metric(
    name="enstrophy_error",
    family="vorticity",
    unit="1/frame^2",
    direction=Direction.LOWER,
    perfect=0.0,
    source="elsewhere",
    summary="a metric of another package",
    statistic=enstrophy_error,
)
CLASHING = (replace(OTHERS, name="vorticity_mse", of=()),)
NO_METRIC = ("vorticity",)


def with_entry_point(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Pretend that another package registers a name of this module."""
    point = EntryPoint(name="others", value=f"{__name__}:{name}", group=table_module.GROUP)
    monkeypatch.setattr(table_module, "entry_points", lambda group: [point])


def test_another_package_adds_a_metric(monkeypatch: pytest.MonkeyPatch) -> None:
    """A single metric behind an entry point is scored like ours."""
    with_entry_point(monkeypatch, "OTHERS")
    assert available()["enstrophy_error"] is OTHERS
    truth = rollout()
    scenario = scenario_of(truth)
    metrics = select(["enstrophy_error"])
    pieces = tally(pairs_of(scenario, truth, truth), metrics, scenario.setting.predicted_frames)
    assert aggregate(metrics, {0: pieces})["enstrophy_error"].mean == 1.0


@pytest.mark.parametrize(("name", "message"), [("CLASHING", "two metrics"), ("NO_METRIC", "no metric")])
def test_a_bad_entry_point_is_named(monkeypatch: pytest.MonkeyPatch, name: str, message: str) -> None:
    """A taken name or a thing that is no metric is refused with the entry point's name."""
    with_entry_point(monkeypatch, name)
    with pytest.raises(UsageError, match=message) as caught:
        available()
    assert "others" in str(caught.value)


def test_selection_brings_what_a_metric_follows_from() -> None:
    """RMSE needs MSE, the energy ratio both energies; unknown names list the nearest."""
    assert {m.name for m in select(["vorticity_rmse", "energy_ratio"])} == {
        "vorticity_mse",
        "vorticity_rmse",
        "energy_predicted",
        "energy_true",
        "energy_ratio",
    }
    with pytest.raises(UsageError, match="did you mean 'vorticity_rmse'"):
        select(["vorticity_rmsee"])


def test_metrics_that_say_nothing_are_refused() -> None:
    """Neither a statistic nor a source of one, or a target without a value, is a mistake."""
    with pytest.raises(UsageError, match="neither"):
        replace(OTHERS, statistic=None, of=())
    with pytest.raises(UsageError, match="target"):
        replace(OTHERS, direction=Direction.TARGET, perfect=None)


def test_scores_hold_frames_as_arrays() -> None:
    """The value per frame has one row per scenario and one column per predicted frame."""
    found = scores(0.1)["vorticity_mse"]
    per_frame: Floats = found.per_frame
    assert per_frame.shape == (1, 52)
    assert found.frames == tuple(range(2, 54))
