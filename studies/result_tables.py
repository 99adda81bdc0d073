"""The tables of docs/results.md, as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

from lagbench.board.entry import MeasuredCost
from lagbench.figures.tables import markdown
from lagbench.metrics.metric import Direction, Metric
from lagbench.metrics.table import CHOSEN
from lagbench.references.predictor import Kind
from lagbench.scoring.tables import ARROWS

from .thesis.cases import key_frame, scenario_of
from .thesis.claims import Claim, ComparedModels, answer, leading_references
from .thesis.formatting import interval, number
from .thesis.published import MEASURES, OPERATORS, TABLE_5_4
from .thesis.roster import label
from .thesis.split_results import (
    Method,
    ScoredTraining,
    SplitResults,
    count_start_steps,
    format_budget,
    format_hardware,
)


def summary_table(all_results: Sequence[SplitResults]) -> str:
    """Return a row for the best learned and for the best hybrid model of a data set."""
    heads = (
        "data set",
        "metric",
        "best naive",
        "best classical",
        "kind of model",
        "best model of this kind",
        "skill",
        "against_classical",
    )
    rows = []
    for results in all_results:
        solver = results.best(Kind.CLASSICAL)
        for kind in (Kind.LEARNED, Kind.HYBRID):
            model = results.best(kind)
            if model is None:
                continue
            rows.append(
                (
                    results.where,
                    results.ranking,
                    _name_and_score(results, results.best_naive),
                    _name_score_and_cost(results, solver, beside=model),
                    str(kind),
                    _name_score_and_cost(results, model, beside=model),
                    number(results.skill(model)),
                    _format_against(results, model),
                )
            )
    return markdown(heads, rows)


def _format_against(results: SplitResults, model: str) -> str:
    against = results.against_classical(model)
    if against is None:
        return "-"
    low, high = against.interval
    ratio = f"{number(against.value)} ({number(low)} to {number(high)})"
    solver = label(against.reference)
    if against.solver_costs_more:
        solver += ", which costs more"
    return f"{ratio}, {solver}"


def _name_score_and_cost(results: SplitResults, name: str | None, beside: str) -> str:
    """Return name, score and time per frame, as measured in the run of a model."""
    text = _name_and_score(results, name)
    if name is None:
        return text
    seconds = _seconds_in_run(results, name, beside)
    if seconds is None:
        return text
    return f"{text} ({format_time(seconds)})"


def format_time(seconds: float | None) -> str:
    """Return a time with its unit, a dash where there is none.

    >>> format_time(0.0123), format_time(2.5), format_time(None)
    ('12.3 ms', '2.5 s', '-')
    """
    if seconds is None:
        return "-"
    if seconds >= 1.0:
        return f"{number(seconds)} s"
    return f"{number(1000.0 * seconds)} ms"


def _seconds_in_run(results: SplitResults, name: str, model: str) -> float | None:
    """Return the time of a frame in the run that measured a model and the solvers [s].

    None without such a run: times of other machines do not stand in one row.

    Args:
        results: of a data set.
        name: the model, or a classical solver.
        model: the model whose run it is.
    """
    measured = results.methods[model].measured
    if measured is None or not measured.classical:
        return None
    if name == model:
        return measured.seconds_per_frame
    return measured.classical.get(name)


def _name_and_score(results: SplitResults, name: str | None) -> str:
    if name is None:
        return "-"
    score = results.methods[name].scores[results.ranking]
    return f"{label(name)}: {number(score.mean)}"


def claims_overview(
    rows_by_claim: Mapping[Claim, Mapping[str, Sequence[ComparedModels]]],
    places: Sequence[str],
) -> str:
    """Return the answers to every claim that has one, a column per split and size."""
    rows = []
    for claim, rows_by_place in rows_by_claim.items():
        rival_count = len(claim.rivals)
        answers = []
        for place in places:
            answers.append(answer(rows_by_place[place], rival_count) or "-")
        if any(rows_by_place[place] for place in places):
            rows.append([claim.question, *answers])
    return markdown(["", *places], rows)


def training_table(all_results: Sequence[SplitResults]) -> str:
    """Return the budget of each training and its gains, best model first.

    Epochs are those of the whole chain of trainings, where a training started from the
    weights of another one. A record has the steps of the earlier ones, not their batch.
    So all of them are assumed to have had the batch of the last one.
    """
    heads = (
        "where",
        "model",
        "steps x windows",
        "epochs",
        "validated",
        "validation at 1/4",
        "validation at 1/2",
        "validation at the end",
        "decrease in the second half",
    )
    rows = []
    for results in all_results:
        for name in results.order(results.models):
            rows.append(_training_row(results, name))
    return markdown(heads, rows)


def _training_row(results: SplitResults, name: str) -> list[str]:
    method = results.models[name]
    record = method.trainings[0].record

    # hours and steps are those of the whole chain of trainings
    start_steps = count_start_steps(record)
    all_steps = start_steps + record.get("step", 0)

    validated_metric = "-"
    values_by_step = []
    for entry in record.get("validation", ()):
        # beside the step an entry holds one number, the metric that was validated
        for metric, value in entry.items():
            if metric != "step":
                values_by_step.append((start_steps + entry["step"], value))
                if validated_metric == "-":
                    validated_metric = metric

    least_values = []
    for share in (0.25, 0.5, 1.0):
        least = None
        for step, value in values_by_step:
            if step <= share * all_steps:
                least = value if least is None else min(least, value)
        least_values.append(least)
    _, half, whole = least_values
    gain = "-"
    if half and whole is not None:
        gain = f"{100.0 * (1.0 - whole / half):.2g} %"

    epochs = None
    if "windows" in record:
        windows_seen = all_steps * record["recipe"]["training"]["batch"]
        if windows_seen:
            epochs = windows_seen / record["windows"]
    return [
        results.where,
        label(name),
        format_budget(record),
        number(epochs),
        validated_metric,
        *map(number, least_values),
        gain,
    ]


def ranking_table(results: SplitResults) -> str:
    """Return the ranking: score, skill, time of a frame, ratio to a solver of its cost.

    Methods without a score of the ranking metric have no row.
    """
    run = run_of(results)
    heads = (
        "model",
        "kind",
        "seeds",
        f"{results.ranking} (95 %)",
        "skill",
        "time of a frame",
        "against_classical",
    )
    rows = []
    for name in results.order():
        method = results.methods[name]
        is_model = method.kind in (Kind.LEARNED, Kind.HYBRID)
        seconds = None if run is None else _seconds_of_run(method, run)
        against = "-"
        if is_model and seconds is not None:
            against = _format_against(results, name)
        rows.append(
            (
                label(name),
                str(method.kind),
                str(len(method.trainings)) if is_model else "-",
                _score_cell(method, results.ranking),
                number(results.skill(name)),
                format_time(seconds),
                against,
            )
        )
    return markdown(heads, rows)


def run_of(results: SplitResults) -> MeasuredCost | None:
    """Return the run that measured the best model of known cost; None without one."""
    for name in results.order(results.models):
        measured = results.methods[name].measured
        if measured is not None:
            return measured
    return None


def _seconds_of_run(method: Method, run: MeasuredCost) -> float | None:
    """Return the time of a frame of a method in a run [s]; None if it took no part."""
    if method.measured is not None and method.measured.is_of_same_run(run):
        return method.measured.seconds_per_frame
    return run.classical.get(method.name, run.naive.get(method.name))


def metrics_table(results: SplitResults) -> str:
    """Return the means of the metrics that do not rank, the best method first."""
    metrics = []
    for metric in shown_metrics(results):
        if metric.name != results.ranking:
            metrics.append(metric)
    heads = ["model"]
    for metric in metrics:  # as in "position_rmse [length], ↓"
        goal = ARROWS[metric.direction]
        if metric.direction is Direction.TARGET:
            goal = f"{goal} {metric.perfect:g}"
        heads.append(f"{metric.name} [{metric.unit}], {goal}")

    rows = []
    for name in results.order():
        method = results.methods[name]
        cells = [_mean_cell(method, metric.name) for metric in metrics]
        rows.append([label(name), *cells])
    return markdown(heads, rows)


def shown_metrics(results: SplitResults) -> list[Metric]:
    """Return the ranking metric and the chosen ones that were scored."""
    scored: dict[str, Metric] = {}
    for method in results.methods.values():
        for name, score in method.scores.items():
            scored[name] = score.metric

    # vorticity says little where the material does not fill the box
    hidden_families: tuple[str, ...] = ()
    if results.ranking == "cloud_distance":
        hidden_families = ("vorticity", "distributions")

    metrics = []
    for name in dict.fromkeys((results.ranking, *CHOSEN)):
        metric = scored.get(name)
        if metric is None or metric.direction is Direction.NONE:
            continue
        if metric.family not in hidden_families:
            metrics.append(metric)
    return metrics


def _score_cell(method: Method, metric: str) -> str:
    """Return mean, interval and deviation over seeds; a star marks undefined values."""
    score = method.scores[metric]
    cell = interval(score.mean, score.interval)
    if len(method.trainings) > 1:
        cell += f" ± {number(method.spread(metric), 2)}"
    if any(score.undefined):
        cell += "*"
    return cell


def _mean_cell(method: Method, metric: str) -> str:
    """Return the mean; a star marks one that leaves out undefined values."""
    if metric not in method.scores:
        return "-"
    score = method.scores[metric]
    cell = number(score.mean)
    if cell != "-" and any(score.undefined):
        cell += "*"
    return cell


def leading_table(all_results: Sequence[SplitResults]) -> str:
    """Return by data set the metrics in which a reference predictor leads.

    Only metrics that stand in the tables of the data set count.
    """
    metrics_by_place: dict[str, list[str]] = {}
    for results in all_results:
        shown = {metric.name for metric in shown_metrics(results)}
        for where, metric, *_ in leading_references([results]).rows:
            if metric in shown:
                metrics_by_place.setdefault(where, []).append(metric)
    rows = []
    for where, metrics in metrics_by_place.items():
        rows.append((where, ", ".join(metrics)))
    if not rows:
        return ""
    return markdown(("data set", "metrics in which a reference predictor leads"), rows)


def vorticity_table(results: SplitResults) -> str:
    """Return Table 5.4 of the thesis with our mean and T0; "" without its models."""
    frame = key_frame(results.size)
    first_scenario = scenario_of(results.size, 0)
    heads = ["model"]
    for measure in MEASURES:
        heads += [measure.upper(), f"{measure.upper()}, thesis"]

    rows = []
    for name in OPERATORS:
        method = results.models.get(results.stand_in(name))
        if method is None:
            continue
        row = [label(method.name)]
        for measure in MEASURES:
            metric = f"vorticity_{measure}"
            mean_value = method.at(metric, frame)
            first_value = method.at(metric, frame, first_scenario)
            row.append(f"{number(mean_value)} ({number(first_value)})")
            row.append(number(TABLE_5_4[name][measure], 4))
        rows.append(row)
    return markdown(heads, rows) if rows else ""


def order_agreement(results: SplitResults) -> str | None:
    """Return Kendall's tau of our order by MSE and the thesis's.

    None without a table of the thesis, or without two of its models.
    """
    if results.size.split != "cavity":
        return None
    frame = key_frame(results.size)
    thesis_values = []
    our_values = []
    for name, row in TABLE_5_4.items():
        model = results.models.get(results.stand_in(name))
        if model is not None:
            thesis_values.append(row["mse"])
            our_values.append(model.at("vorticity_mse", frame))
    if len(thesis_values) < 2:
        return None
    return number(kendall_tau(thesis_values, our_values), 2)


def kendall_tau(first: Sequence[float], second: Sequence[float]) -> float:
    """Return Kendall's tau of two rankings without ties.

    It is 1 for the same order, -1 for the reversed one, 0 for unrelated ones.
    """
    pairs = list(zip(first, second, strict=True))
    pair_count = 0
    reversed_count = 0
    for (a, x), (b, y) in combinations(pairs, 2):
        pair_count += 1
        reversed_count += (a - b) * (x - y) < 0.0
    return 1.0 - 2.0 * reversed_count / pair_count


def cost_table(results: SplitResults) -> str:
    """Return recipe, parameters, seeds and training hours of each model."""
    heads = (
        "model",
        "recipe",
        "changed",
        "parameters",
        "seeds",
        "CPU hours per seed",
        "trained on",
    )
    rows = []
    for name in results.order(results.models):
        method = results.methods[name]
        recipes = [training.record.get("recipe", {}) for training in method.trainings]
        recipe_names = [recipe.get("name", "-") for recipe in recipes]
        changes = [_changes(training) for training in method.trainings]
        parameters = "-"
        if method.parameters is not None:
            parameters = f"{method.parameters:,}"
        seeds = []
        machines = []
        for training in method.trainings:
            seeds.append("-" if training.seed is None else str(training.seed))
            machines.append(format_hardware(training.record))
        rows.append(
            [
                label(name),
                " / ".join(dict.fromkeys(recipe_names)),
                " / ".join(dict.fromkeys(changes)),
                parameters,
                ", ".join(seeds),
                number(method.hours_per_seed),
                " / ".join(dict.fromkeys(machines)),
            ]
        )
    return markdown(heads, rows)


def _changes(training: ScoredTraining) -> str:
    """Return the options that a training and its prediction changed.

    A dash stands for a training without a recipe.
    """
    recipe = training.record.get("recipe")
    if not recipe:
        return "; ".join(training.predicted_with) or "-"
    changes = []
    if recipe.get("changed"):
        changes.append(recipe["changed"])
    else:
        changes += recipe.get("settings", [])
    changes += training.predicted_with
    return "; ".join(changes) or "none"
