"""Tables and bars: solver times, MLPs, rollouts, statistics of train, vorticity.

Tables 4.2 to 4.5 are activations, widths, depths and more data for an MLP from frame to
frame. Errors are Eq. 4.16 after one step from true frames, over train and over valid.
At size ``full`` every row has its own recipe, with the thesis's epochs and batch.
Smaller sizes take a share of the epochs, and smaller batches so that an epoch has some
steps; both are the same for all rows of a table. More data (``extra``, Table 4.5) exist
at full only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.local import suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.errors import DataError
from lagbench.figures.tables import Table
from lagbench.metrics.distributions import kl, normalise
from lagbench.metrics.table import METRICS

from .cases import key_frame, scenario_of
from .drawing import (
    charts,
    charts_png,
    loss_over_steps,
    open_rollouts,
    plot_losses,
    tidy_axes,
)
from .formatting import number
from .items import Sheet, ThesisItem
from .plan import (
    SHARES,
    TABLES,
    Plan,
    read_study_results,
    study_folder,
    study_name,
    study_rows,
)
from .published import (
    FRAME_MODELS,
    OPERATORS,
    STATISTICS,
    TABLE_4_7,
    TABLE_4_8,
    TABLE_5_4,
    MLPStudy,
    RolloutErrors,
)
from .roster import colour, label
from .split_results import SplitResults, format_budget

Floats = NDArray[np.float64]


MEASURED = {
    "table_3_1": ("table_3_1.py --rows 1-4 --device cpu", "table_3_1_*.md"),
    "section_3_2_2": ("inference_cost.py --rows 1-4", "inference_cost.md"),
}
"""Script in benchmarks/ and the files that it writes, by item."""


def times(plan: Plan, item: ThesisItem) -> Sheet:
    """Return the command that measures times, and the committed measurement."""
    del plan
    script, pattern = MEASURED[item.name]
    command = f"python benchmarks/{script} --output docs/figures"
    notes = [f"From a clone of the repository: `{command}`. {item.remark}"]
    for path in sorted(Path("docs/figures").glob(pattern)):
        notes.append(path.read_text(encoding="utf-8"))
    return Sheet(notes=tuple(notes))


def rollouts(plan: Plan, item: ThesisItem) -> Sheet:
    """Return Table 4.7 or 4.8 with our errors beside it."""
    printed = {"fluid": (TABLE_4_7,)} if item.name == "table_4_7" else TABLE_4_8
    tables = []
    for split, rows in printed.items():
        tables.append(rollout_table(plan.results(split), rows))
    return Sheet(notes=(item.remark,), tables=tuple(tables))


def rollout_table(results: SplitResults, printed: Sequence[RolloutErrors]) -> Table:
    """Return average and end error by scene; a cell is ours / the thesis's."""
    names = list(FRAME_MODELS)
    for name in ("var", "var-stable"):
        if name in results.methods:
            names.append(name)

    rows = []
    for scene in printed:
        scenario = scenario_of(results.size, scene.scenario)
        cells = [str(scene.scenario), scene.scene, _or_dash(scenario)]
        columns = ((scene.average, "mse_avg"), (scene.end, "mse_end"))
        for thesis_values, metric in columns:
            thesis_errors = dict(zip(FRAME_MODELS, thesis_values, strict=True))
            for name in names:
                error = None
                if name in results.methods and scenario is not None:
                    error = results.methods[name].over_horizon(metric, scenario)
                thesis_error = thesis_errors.get(name)
                cells.append(f"{number(error)} / {number(thesis_error, 4)}")
        rows.append(tuple(cells))

    heads = ["thesis's id", "scene", "id of our scenario"]
    for column in ("average", "end"):
        for name in names:
            heads.append(f"{column}, {label(name)}")
    return Table(results.where, tuple(heads), tuple(rows))


def _or_dash(value: int | None) -> str:
    return "-" if value is None else str(value)


def statistics(plan: Plan, item: ThesisItem) -> Sheet:
    """Return the statistics of a split's train per frame, beside the thesis's."""
    split = item.split
    tier = plan.tier(split)
    manifest = read_manifest(plan.root, split, plan.size, tier.major)
    measured: Mapping[str, Any] = {}
    if tier.measured:
        measured = tier.measured.statistics
    elif manifest:
        measured = manifest.statistics
    if not measured:
        raise DataError(
            "the statistics of train are recorded nowhere",
            where=str(tier.folder(plan.root)),
            expected="statistics in the manifest, or in datasets.yaml",
            got="none",
            fix=suggest_repair(tier, root=plan.root),
        )

    rows = []
    for quantity, printed in STATISTICS[split].items():
        values = [*printed, *measured[quantity]]
        cells = [number(value, 4) for value in values]
        rows.append((quantity, *cells))
    heads = ("per frame", "thesis x", "thesis y", "ours x", "ours y")
    table = Table(f"{split} {plan.size}, train", heads, tuple(rows))
    return Sheet(notes=(item.remark,), tables=(table,))


def vorticity(plan: Plan, item: ThesisItem) -> Sheet:
    """Return Table 5.4 or 5.5: thesis, T0 and mean over scenarios.

    One table has vorticity as the scorer forms it, the other as the thesis does.
    """
    results = plan.results(item.split)
    frame = key_frame(results.size)
    first_scenario = scenario_of(results.size, 0)
    names = [name for name in item.models if name in results.methods]
    cubic_by_scenario = _cubic_errors_of_models(plan, item, frame)

    def scored(name: str, measure: str, scenario: int | None) -> float:
        return results.methods[name].at(f"vorticity_{measure}", frame, scenario)

    def interpolated(name: str, measure: str, scenario: int | None) -> float:
        errors = []
        for i, errors_by_model in cubic_by_scenario.items():
            is_chosen = scenario is None or i == scenario
            if is_chosen and name in errors_by_model:
                errors.append(errors_by_model[name][measure])
        if not errors:
            return math.nan
        return sum(errors) / len(errors)

    cells = results.size.task.score_grid.cells
    ways: dict[str, Callable[[str, str, int | None], float]] = {
        f"Score grid ({cells} cells across, B-spline)": scored,
        "SciPy griddata, cubic, 40 x 40, as in the thesis": interpolated,
    }
    heads = ["model"]
    for measure in item.metrics:
        for source in ("thesis", "ours T0", "ours mean"):
            heads.append(f"{measure.upper()} {source}")

    tables = []
    for title, error_of in ways.items():
        rows = []
        for name in names:
            row = [label(name)]
            for measure in item.metrics:
                printed = TABLE_5_4.get(name, {}).get(measure)
                row.append(number(printed, 4))
                row.append(number(error_of(name, measure, first_scenario)))
                row.append(number(error_of(name, measure, None)))
            rows.append(tuple(row))
        tables.append(Table(title, tuple(heads), tuple(rows)))
    note = f"Frame {frame}; T0 is our test scenario {first_scenario}. {item.remark}"
    return Sheet(notes=(note,), tables=tuple(tables))


def _cubic_errors_of_models(
    plan: Plan, item: ThesisItem, frame: int
) -> dict[int, dict[str, Mapping[str, float]]]:
    """Return the errors of cubic vorticity, by test scenario and model."""
    errors: dict[int, dict[str, Mapping[str, float]]] = {}
    for scenario in plan.test_subset(item.split).scenarios:
        with open_rollouts(
            plan, item.split, scenario=scenario, names=item.models
        ) as shown:
            bounds = shown.recording.size.bounds
            truth = shown.snapshot(None, frame)
            true_field = cubic_vorticity(truth.position, truth.velocity, bounds)
            errors[scenario] = {}
            for name in shown.predictions:
                snapshot = shown.snapshot(name, frame)
                field = cubic_vorticity(snapshot.position, snapshot.velocity, bounds)
                errors[scenario][name] = cubic_errors(true_field, field)
    return errors


def cubic_vorticity(
    position: Floats,
    velocity: Floats,
    bounds: Sequence[tuple[float, float]],
    *,
    cells: int = 40,
) -> Floats:
    """Return the vorticity as the thesis forms it [1/frame], shape [x, y].

        u_ij = griddata(x_p, u_p, x_ij, method="cubic")
        omega = dv/dx - du/dy    (second order)

    over nodes that span the box from wall to wall (Fig. 5.20); NaN outside the
    particles' hull. Unlike the scorer's transfer it does not average over particles: it
    follows the velocity [length/frame] of every particle, so it shows noise between
    neighbours.
    """
    from scipy.interpolate import griddata

    x, y = (np.linspace(low, high, cells) for low, high in bounds)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    # velocity at the nodes, shape [x, y, 2]
    node_velocity: Floats = griddata(position, velocity, nodes, method="cubic")
    dv_dx = np.gradient(node_velocity[..., 1], x, axis=0)
    du_dy = np.gradient(node_velocity[..., 0], y, axis=1)
    return np.asarray(dv_dx - du_dy, np.float64)


def cubic_errors(truth: Floats, prediction: Floats) -> Mapping[str, float]:
    """Return MAE, MSE, RMSE, KL (Eq. 5.23) and Pearson (Eq. 5.21).

    The errors are those over the nodes at which both fields have a value.
    """
    have_both = np.isfinite(truth) & np.isfinite(prediction)
    true = truth[have_both]
    predicted = prediction[have_both]
    residual = predicted - true
    mse = float(np.mean(residual**2))
    correlation = math.nan
    if np.ptp(true) and np.ptp(predicted):
        correlation = float(np.corrcoef(true, predicted)[0, 1])
    return {
        "mae": float(np.mean(np.abs(residual))),
        "mse": mse,
        "rmse": mse**0.5,
        "kl": kl(normalise(true), normalise(predicted)),
        "pearson": correlation,
    }


def vorticity_bars(plan: Plan, item: ThesisItem) -> Sheet:
    """Return one measure of six operators at frame 54, beside the thesis's."""
    results = plan.results(item.split)
    (metric,) = item.metrics
    measure = metric.removeprefix("vorticity_")
    frame = key_frame(results.size)
    first_scenario = scenario_of(results.size, 0)
    methods = {}
    for name in item.models:
        if name in results.methods:
            methods[name] = results.methods[name]
    series: dict[str, dict[str, float]] = {
        "thesis, T0": {name: row[measure] for name, row in TABLE_5_4.items()},
        "ours, T0": {
            name: method.at(metric, frame, first_scenario)
            for name, method in methods.items()
        },
        "ours, mean": {
            name: method.at(metric, frame) for name, method in methods.items()
        },
    }

    x_label = f"{metric} [{METRICS[metric].unit}]"
    with charts(3, 3, width=2.9, height=2.6) as all_axes:
        for axes, (title, values) in zip(all_axes, series.items(), strict=True):
            names = [name for name in OPERATORS if name in values]
            axes.barh(
                [label(name) for name in names],
                [values[name] for name in names],
                color=[colour(name) for name in names],
            )
            axes.invert_yaxis()
            tidy_axes(axes, title, x=x_label, y="", legend=False)
        picture = charts_png(all_axes)

    rows = []
    for name in OPERATORS:
        cells = [number(values.get(name), 4) for values in series.values()]
        rows.append((label(name), *cells))
    return Sheet(
        notes=(f"Vorticity at frame {frame} on the score grid.",),
        tables=(Table("", ("model", *series), tuple(rows)),),
        pictures={"": picture},
    )


def _study_results(plan: Plan, item: ThesisItem) -> dict[str, Any]:
    """Return the results of an item's rows with the plan's first seed.

    Results in the folder ``studies`` are by plain recipes, so a changed recipe does not
    use them.
    """
    _, split = TABLES[item.studies]
    homes = [plan.home(split)]
    is_plain = not plan.settings and plan.recipe is None
    if plan.studies is not None and is_plain:
        homes.insert(0, plan.studies / split / plan.size)
    studies = read_study_results(homes, plan.hash(split))
    return {name: row for name, row in studies.items() if row["seed"] == plan.seeds[0]}


def studies(plan: Plan, item: ThesisItem) -> Sheet:
    """Return Table 4.2, 4.3, 4.4 or 4.5 with our results beside it."""
    return studies_beside_thesis(item.studies, plan.size, _study_results(plan, item))


def studies_beside_thesis(name: str, size: str, results: Mapping[str, Any]) -> Sheet:
    """Return a table of MLPs, from the results of :func:`~.plan.read_study_results`."""
    table_number, split = TABLES[name]
    rows = []
    for study in study_rows(name):
        result = results.get(study_name(study), {})
        rows.append(_study_cells(study, result))
    heads = (
        "no",
        "hidden layers",
        "activation",
        "parameters at full, thesis",
        "parameters, ours",
        "epochs x batch, thesis",
        "steps x batch, ours",
        "CPU hours",
        "train, thesis",
        "train, ours",
        "valid, thesis",
        "valid, ours",
    )
    share, _ = SHARES.get(size, (1.0, 1))
    note = (
        f"Table {table_number} on {split} {size}: mean squared error of one step "
        f"[standardised^2]. The training takes {share:g} of the thesis's epochs at a "
        "constant rate of 1e-3. The thesis has other data and another standardisation, "
        "so compare the order only. Our valid scenarios are never seen by the training."
    )
    return Sheet(notes=(note,), tables=(Table("", heads, tuple(rows)),))


def _study_cells(study: MLPStudy, result: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the cells of a row: the thesis's numbers and ours."""
    record = result.get("training", {})
    budget = f"{study.epochs} x {study.batch}"
    if study.table == "4.2":  # the thesis does not state its batch
        budget = f"{study.epochs}"
    parameters = "-"
    cpu_hours = None
    if record:
        parameters = f"{record['parameters']:,}"
        cpu_hours = record["cpu_seconds"] / 3600.0
    return (
        str(study.row),
        " x ".join(map(str, study.widths)),
        study.activation,
        f"{study.parameters:,}",
        parameters,
        budget,
        format_budget(record),
        number(cpu_hours),
        number(study.train, 4),
        number(result.get("train")),
        number(study.valid, 4),
        number(result.get("valid")),
    )


def study_losses(plan: Plan, item: ThesisItem) -> Sheet:
    """Return the losses of the rows of Table 4.2 or 4.3, and their final errors."""
    results = _study_results(plan, item)
    rows = []
    names = []
    curves = {}
    errors = []
    for study in study_rows(item.studies):
        name = f"3 x {study.widths[0]}"
        if study.table == "4.2":
            name = study.activation
        names.append(name)
        curves[name] = loss_over_steps(study_folder(plan, item.studies, study))
        error = results.get(study_name(study), {})
        errors.append(error)
        rows.append(
            (
                name,
                number(study.train, 4),
                number(error.get("train")),
                number(study.valid, 4),
                number(error.get("valid")),
            )
        )

    with charts(2, 2) as all_axes:
        loss_axes, error_axes = all_axes
        plot_losses(loss_axes, curves, {})
        place = np.arange(len(names))
        for shift, subset in ((-0.2, "train"), (0.2, "valid")):
            heights = [float(error.get(subset, np.nan)) for error in errors]
            error_axes.bar(place + shift, heights, 0.4, label=subset)
        error_axes.set_xticks(place, names)
        unit = "MSE of one step [standardised^2]"
        tidy_axes(error_axes, "after training", x="", y=unit)
        picture = charts_png(all_axes)
    heads = ("network", "train, thesis", "train, ours", "valid, thesis", "valid, ours")
    return Sheet(
        notes=(item.remark,),
        tables=(Table("", heads, tuple(rows)),),
        pictures={"": picture},
    )
