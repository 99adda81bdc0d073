"""Tables and bars: solver times, MLPs, rollouts, statistics of train, vorticity of six
operators.

Tables 4.2 to 4.5 are activations, widths, depths and more data for an MLP from frame to
frame: errors are Eq. 4.16 after one step from true frames, over train and over valid.
At size ``full`` every row has its own recipe, with the thesis's epochs and batch;
smaller sizes take a share of the epochs, and batches that leave some steps in an epoch,
the same for all rows of a table. More data (``extra``, Table 4.5) exist at full only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.manifest import read_manifest
from lagbench.draw.tables import Table
from lagbench.errors import DataError
from lagbench.metrics.distributions import kl, normalise
from lagbench.metrics.table import METRICS

from .drawing import (
    Figure,
    Sheet,
    charts,
    loss_over_steps,
    opened,
    plot_losses,
    png,
    tidy,
)
from .evidence import Evidence, budget
from .plan import (
    SHARES,
    TABLES,
    Plan,
    known_studies,
    study_folder,
    study_name,
    study_rows,
)
from .thesis import (
    FRAME_MODELS,
    OPERATORS,
    STATISTICS,
    TABLE_4_7,
    TABLE_4_8,
    TABLE_5_4,
    Rollout,
    colour,
    key_frame,
    label,
    number,
    scenario_of,
)

Floats = NDArray[np.float64]


MEASURED = {
    "table_3_1": ("table_3_1.py --rows 1-4 --device cpu", "table_3_1_*.md"),
    "section_3_2_2": ("inference_cost.py --rows 1-4", "inference_cost.md"),
}
"""Script in benchmarks/ and the files that it writes."""


def times(plan: Plan, figure: Figure) -> Sheet:
    """Return the command that measures times, and what it last wrote where that is
    here.
    """
    del plan
    script, written = MEASURED[figure.name]
    found = [
        path.read_text(encoding="utf-8")
        for path in sorted(Path("docs/figures").glob(written))
    ]
    note = f"From a clone of the repository: `python benchmarks/{script} --output docs/figures`. {figure.said}"
    return Sheet(notes=(note, *found))


def rollouts(plan: Plan, figure: Figure) -> Sheet:
    """Return Table 4.7 or 4.8 with ours beside it."""
    printed = {"fluid": (TABLE_4_7,)} if figure.name == "table_4_7" else TABLE_4_8
    tables = tuple(
        rollout_table(plan.evidence(split), rows) for split, rows in printed.items()
    )
    return Sheet(notes=(figure.said,), tables=tables)


def rollout_table(evidence: Evidence, printed: tuple[Rollout, ...]) -> Table:
    """Return average and end error by scene, ours and the thesis's, as in "0.31 /
    0.58".
    """
    names = [
        *FRAME_MODELS,
        *(n for n in ("var", "var-stable") if n in evidence.methods),
    ]
    rows = []
    for row in printed:
        ours = scenario_of(evidence.size, row.scenario)
        cells = [str(row.scenario), row.scene, "-" if ours is None else str(ours)]
        for theirs, metric in ((row.average, "mse_avg"), (row.end, "mse_end")):
            known = dict(zip(FRAME_MODELS, theirs, strict=True))
            for name in names:
                method = evidence.methods.get(name)
                if method is None or ours is None:
                    value = None
                else:
                    value = method.over_horizon(metric, ours)
                cells.append(f"{number(value)} / {number(known.get(name), 4)}")
        rows.append(tuple(cells))
    heads = [f"{what}, {label(name)}" for what in ("average", "end") for name in names]
    return Table(
        evidence.where, ("thesis's id", "scene", "our id", *heads), tuple(rows)
    )


def statistics(plan: Plan, figure: Figure) -> Sheet:
    """Return the statistics of a split's train per frame, the thesis's beside ours."""
    split = figure.split
    tier = plan.tier(split)
    manifest = read_manifest(plan.root, split, plan.size, tier.major)
    if tier.measured:
        found = tier.measured.statistics
    else:
        found = manifest.statistics if manifest else {}
    if not found:
        raise DataError(
            "the statistics of train are recorded nowhere",
            fix=f"lagbench generate --split {split}",
        )
    rows = [
        (
            quantity,
            *(
                number(value, 4)
                for pair in (printed, found[quantity])
                for value in pair
            ),
        )
        for quantity, printed in STATISTICS[split].items()
    ]
    heads = ("per frame", "thesis x", "thesis y", "ours x", "ours y")
    return Sheet(
        notes=(figure.said,),
        tables=(Table(f"{split} {plan.size}, train", heads, tuple(rows)),),
    )


def vorticity(plan: Plan, figure: Figure) -> Sheet:
    """Return Table 5.4 or 5.5: thesis, T0 and mean over scenarios, by both ways to form
    vorticity.
    """
    evidence = plan.evidence(figure.split)
    frame = key_frame(evidence.size)
    first = scenario_of(evidence.size, 0)
    names = [name for name in figure.models if name in evidence.methods]
    # errors by scenario and model, the thesis's way
    cubic: dict[int, dict[str, Mapping[str, float]]] = {}
    for i in plan.test_subset(figure.split).scenarios:
        with opened(plan, figure.split, i, figure.models) as shown:
            found = {}
            for name in (None, *shown.predictions):
                held = shown.snapshot(name, frame)
                found[name] = cubic_vorticity(
                    held.position, held.velocity, shown.recording.size.bounds
                )
            cubic[i] = {
                name: cubic_errors(found[None], found[name])
                for name in shown.predictions
            }

    def scored(model: str, measure: str, scenario: int | None) -> float:
        return evidence.methods[model].at(f"vorticity_{measure}", frame, scenario)

    def interpolated(model: str, measure: str, scenario: int | None) -> float:
        if scenario is None:
            chosen = list(cubic)
        else:
            chosen = [scenario]
        found = [cubic[i][model][measure] for i in chosen if model in cubic[i]]
        if found:
            return sum(found) / len(found)
        return math.nan

    cells = evidence.size.task.score_grid.cells
    ways: dict[str, Callable[[str, str, int | None], float]] = {
        f"Score grid ({cells} cells across, B-spline)": scored,
        "SciPy griddata, cubic, 40 x 40, as in the thesis": interpolated,
    }
    heads = [
        f"{m.upper()} {who}"
        for m in figure.metrics
        for who in ("thesis", "ours T0", "ours mean")
    ]
    tables = []
    for title, way in ways.items():
        rows = []
        for name in names:
            row = [label(name)]
            for measure in figure.metrics:
                printed = TABLE_5_4.get(name, {}).get(measure)
                row += [
                    number(printed, 4),
                    number(way(name, measure, first)),
                    number(way(name, measure, None)),
                ]
            rows.append(tuple(row))
        tables.append(Table(title, ("model", *heads), tuple(rows)))
    note = f"Frame {frame}; T0 is our test scenario {first}. {figure.said}"
    return Sheet(notes=(note,), tables=tuple(tables))


def cubic_vorticity(
    position: Floats,
    velocity: Floats,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    *,
    cells: int = 40,
) -> Floats:
    """Return the vorticity as the thesis forms it, NaN outside the particles' hull
    [1/frame], shape [x, y].

        u_ij = griddata(x_p, u_p, x_ij, method="cubic"),   omega = dv/dx - du/dy  (second order)

    over nodes that span the box from wall to wall (Fig. 5.20). Unlike the scorer's
    transfer it does not average over particles: it follows every particle's velocity
    [length/frame], so that noise between neighbours shows.
    """
    from scipy.interpolate import griddata

    x, y = (np.linspace(low, high, cells) for low, high in bounds)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    held: Floats = griddata(position, velocity, nodes, method="cubic")
    slope = np.gradient(held[..., 1], x, axis=0) - np.gradient(held[..., 0], y, axis=1)
    return np.asarray(slope, np.float64)


def cubic_errors(truth: Floats, prediction: Floats) -> Mapping[str, float]:
    """Return MAE, MSE, RMSE, KL (Eq. 5.23) and Pearson (Eq. 5.21) over nodes that both
    have.
    """
    both = np.isfinite(truth) & np.isfinite(prediction)
    true = truth[both]
    predicted = prediction[both]
    mse = float(np.mean((predicted - true) ** 2))
    still = not (np.ptp(true) and np.ptp(predicted))
    return {
        "mae": float(np.mean(np.abs(predicted - true))),
        "mse": mse,
        "rmse": mse**0.5,
        "kl": kl(normalise(true), normalise(predicted)),
        "pearson": math.nan if still else float(np.corrcoef(true, predicted)[0, 1]),
    }


def vorticity_bars(plan: Plan, figure: Figure) -> Sheet:
    """Return one measure of six operators at frame 54, ours beside the thesis's."""
    evidence, (metric,) = plan.evidence(figure.split), figure.metrics
    frame = key_frame(evidence.size)
    first = scenario_of(evidence.size, 0)
    models = {n: evidence.methods[n] for n in figure.models if n in evidence.methods}
    series: dict[str, dict[str, float]] = {
        "thesis, T0": {
            n: row[metric.removeprefix("vorticity_")] for n, row in TABLE_5_4.items()
        },
        "ours, T0": {n: m.at(metric, frame, first) for n, m in models.items()},
        "ours, mean": {n: m.at(metric, frame) for n, m in models.items()},
    }
    with charts(3, 3, width=2.9, height=2.6) as drawn:
        for axes, (title, values) in zip(drawn, series.items(), strict=True):
            order = [n for n in OPERATORS if n in values]
            axes.barh(
                [label(n) for n in order],
                [values[n] for n in order],
                color=[colour(n) for n in order],
            )
            axes.invert_yaxis()
            tidy(axes, title, f"{metric} [{METRICS[metric].unit}]", "", legend=False)
        picture = png(drawn)
    rows = tuple(
        (label(n), *(number(values.get(n), 4) for values in series.values()))
        for n in OPERATORS
    )
    return Sheet(
        notes=(f"Vorticity at frame {frame} on the score grid.",),
        tables=(Table("", ("model", *series), rows),),
        pictures={"": picture},
    )


def _known(plan: Plan, figure: Figure) -> dict[str, Any]:
    """Return what the rows of a figure came to with the plan's seed; committed ones are
    by plain recipes.
    """
    split = TABLES[figure.studies][1]
    plain = not plan.settings and plan.recipe is None
    homes = ([plan.studies / split / plan.size] if plain else []) + [plan.home(split)]
    known = known_studies(homes, plan.hash(split))
    return {name: row for name, row in known.items() if row["seed"] == plan.seeds[0]}


def studies(plan: Plan, figure: Figure) -> Sheet:
    """Return Table 4.2, 4.3, 4.4 or 4.5 with ours beside it."""
    return studies_beside_thesis(figure.studies, plan.size, _known(plan, figure))


def studies_beside_thesis(name: str, size: str, known: Mapping[str, Any]) -> Sheet:
    """Return the rows of a table, those of :func:`known_studies` with what they came
    to.
    """
    (printed, split), rows = TABLES[name], []
    for study in study_rows(name):
        held = known.get(study_name(study), {})
        record = held.get("training", {})
        rows.append(
            (
                str(study.row),
                " x ".join(map(str, study.widths)),
                study.activation,
                f"{study.parameters:,}",
                f"{record['parameters']:,}" if record else "-",
                f"{study.epochs} x {study.batch}"
                if study.table != "4.2"
                else f"{study.epochs}",
                budget(record),
                number(record["cpu_seconds"] / 3600.0 if record else None),
                number(study.train, 4),
                number(held.get("train")),
                number(study.valid, 4),
                number(held.get("valid")),
            )
        )
    heads = (
        *(
            "no",
            "hidden layers",
            "activation",
            "parameters at full, thesis",
            "parameters, ours",
        ),
        *("epochs x batch, thesis", "steps x batch, ours", "CPU hours"),
        *("train, thesis", "train, ours", "valid, thesis", "valid, ours"),
    )
    share, _ = SHARES.get(size, (1.0, 1))
    note = (
        f"Table {printed} on {split} {size}: mean squared error of one step "
        f"[standardised^2]; {share:g}"
        " of the thesis's epochs, constant rate 1e-3. Standardisation and data differ "
        "from the thesis's:"
        " compare orders. Our valid are scenarios that training never saw."
    )
    return Sheet(notes=(note,), tables=(Table("", heads, tuple(rows)),))


def study_losses(plan: Plan, figure: Figure) -> Sheet:
    """Return the losses of the rows of Table 4.2 or 4.3, and the final errors over
    train and valid.
    """
    studies = study_rows(figure.studies)
    names = [
        s.activation if s.table == "4.2" else f"3 x {s.widths[0]}" for s in studies
    ]
    folders = [study_folder(plan, figure.studies, study) for study in studies]
    known = _known(plan, figure)
    errors = [known.get(study_name(study), {}) for study in studies]
    curves = {
        name: (None, *loss_over_steps(folder))
        for name, folder in zip(names, folders, strict=True)
    }
    with charts(2, 2) as drawn:
        over_steps, after = drawn
        plot_losses(over_steps, curves)
        place = np.arange(len(studies))
        for shift, subset in ((-0.2, "train"), (0.2, "valid")):
            values = [float(held.get(subset, np.nan)) for held in errors]
            after.bar(place + shift, values, 0.4, label=subset)
        after.set_xticks(place, names)
        tidy(after, "after training", "", "MSE of one step [standardised^2]")
        picture = png(drawn)
    rows = [
        (
            name,
            number(s.train, 4),
            number(e.get("train")),
            number(s.valid, 4),
            number(e.get("valid")),
        )
        for name, s, e in zip(names, studies, errors, strict=True)
    ]
    heads = ("network", "train, thesis", "train, ours", "valid, thesis", "valid, ours")
    return Sheet(
        notes=(figure.said,),
        tables=(Table("", heads, tuple(rows)),),
        pictures={"": picture},
    )
