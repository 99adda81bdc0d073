"""Write docs/results.md from committed files: claims, scores beside the thesis's
numbers, costs.

    python -m lagbench.baselines.reproduce.results -o docs/results.md [--board
        leaderboard] [--weights FOLDER] [--runs RUNS] [--studies FOLDER] [--check]

Score files and entries of the leaderboard and what trainings recorded suffice: no data
set is read. ``--runs`` adds what is not committed yet. The same files give the same
bytes; ``--check`` writes nothing and fails where the page is stale.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.errors import LagbenchError
from lagbench.figures.tables import Table, markdown
from lagbench.metrics.metric import Direction, Metric
from lagbench.metrics.table import CHOSEN
from lagbench.references.table import REFERENCES
from lagbench.scoring.tables import ARROWS

from .claims import CLAIMS, answer, claim_rows, comparison_table, floors_ahead
from .evidence import (
    BOARD,
    STUDIES,
    WEIGHTS,
    Evidence,
    Method,
    Sources,
    budget,
    hardware,
    read_json,
)
from .plan import TABLES, known_studies, study_name, study_rows
from .tables import rollout_table, studies_beside_thesis
from .thesis import (
    EXPECTED,
    OPERATORS,
    ROSTER,
    SIZES,
    TABLE_4_8,
    TABLE_5_4,
    interval,
    key_frame,
    label,
    number,
    scenario_of,
)
from .var_protocol import FILE, beside_thesis

HEAD = """# Results

The reference models, their variants and floors on the test scenarios of each data set, beside the numbers
of the thesis (D. Dharma, PhD thesis, University of Leeds, 2025). Written by
`python -m lagbench.baselines.reproduce.results -o docs/results.md` from the entries and score files in
`leaderboard/` and the records of their trainings; do not edit.

How to read it. `skill` is 1 - score / score of the best floor: 1 perfect, 0 nothing learned, below 0 worse
than what costs no learning. Cells are means over test scenarios with 95 % bootstrap intervals, and ± the
deviation over seeds where there are several; intervals here are those over scenarios, those of the board
resample seeds too and are wider where there are few. Differences are tested by the exact sign-flip test
over scenarios where both have one seed, else by the two-way bootstrap over scenarios and seeds (of one
training used in two ways: of the differences seed by seed), two-sided, corrected for the number of rivals
(Holm); with fewer than six scenarios nothing is claimed. The thesis trained on its own data, at what is
here size `full`, for hours on GPUs, and prints one scenario per table: its absolute numbers are beside ours
for orientation, and only orders can be compared at size `mini` (a quarter of the particles, half the grid).
`docs/scoring.md` defines every metric."""

COMMANDS = """## How to make these again

```
lagbench generate --split cavity --size mini
lagbench train --baseline supergat --split cavity --size mini --seed 0
lagbench predict runs/cavity/mini/supergat-0/weights.pt -o runs/cavity/mini/supergat-0/predictions.nc
lagbench score runs/cavity/mini/supergat-0/predictions.nc
lagbench submit runs/cavity/mini/supergat-0/predictions.nc --from meta.yaml
```

All models, tables and figures of a size, resumable: `python -m lagbench.baselines.reproduce --size mini
--root DATA --runs runs`; `lagbench submit` makes entries of them. What is no entry is
read from `docs/studies/<split>/<size>/`: `mlp_studies.json`, as in the folder of runs, and
`var_protocol.json`, as `python -m lagbench.baselines.reproduce.var_protocol --size mini --json` prints it.
Variants change an option or two:"""


def render(sources: Sources, sizes: Sequence[str] = SIZES) -> str:
    """Return the page."""
    found = [Evidence(sources, split, size) for size in sizes for split in EXPECTED]
    known = [evidence for evidence in found if evidence.methods]
    learned = [evidence for evidence in known if evidence.models]
    parts = [
        HEAD,
        *_claims(learned),
        *(part for evidence in known for part in _chapter(evidence)),
    ]
    homes = [home for home in (sources.studies, sources.runs) if home]
    protocols = []
    studies = []
    for size in sizes:
        measured = next(
            (p for home in homes if (p := home / "fluid" / size / FILE).is_file()), None
        )
        protocols += [beside_thesis(read_json(measured)).text] if measured else []
        for name, (_, split) in TABLES.items():
            data = sources.size(split, size).measured
            trained = known_studies(
                [h / split / size for h in homes], data.dataset_sha256 if data else None
            )
            if any(study_name(study) in trained for study in study_rows(name)):
                studies.append(studies_beside_thesis(name, size, trained).text)
    parts += (
        ["## VAR by the thesis's protocol (section 4.8.3)", *protocols]
        if protocols
        else []
    )
    parts += ["## MLPs from frame to frame", *studies] if studies else []
    variants = []
    for model in (model for model in ROSTER.values() if model.varied):
        settings = "".join(f" --set {setting}" for setting in model.settings)
        if model.recipe:
            recipe = f" --recipe {model.recipe}"
        else:
            recipe = ""
        how = f"`--baseline {model.baseline}{recipe}{settings}`"
        if model.weights:
            how = f"`lagbench predict{settings}` with weights of `{model.weights}`"
        variants.append(f"- `{model.name}`: {how}")
    parts += [
        COMMANDS,
        "\n".join(variants),
        "## Missing",
        "\n".join(_missing(found)) or "Nothing.",
    ]
    return "\n\n".join(parts) + "\n"


def _claims(learned: Sequence[Evidence]) -> Iterator[str]:
    """Yield an overview of all claims, then the comparisons behind each."""
    yield "## Claims"
    if not learned:
        yield "No model has been scored yet; the end of this page has the commands."
        return
    rows = {claim: {e.where: claim_rows(claim, e) for e in learned} for claim in CLAIMS}
    yield (
        "By the ranking metric over the horizon: ahead in the mean; better (yes) and "
        "worse (no) at 5 %, open"
        " otherwise. Two methods are compared by the seeds that both have, by all "
        "where they share none. A"
        " dash where an entry is missing."
    )
    yield markdown(
        ["", *(e.where for e in learned)],
        [
            [claim.question, *(answer(found) or "-" for found in held.values())]
            for claim, held in rows.items()
        ],
    )
    for claim, held in rows.items():
        compared = [row for found in held.values() for row in found]
        yield f"### {claim.question}"
        if compared:
            yield _markdown(comparison_table(compared))
        else:
            yield f"Nothing to compare: it takes entries of {label(claim.first)} and of a rival on one split."
    ahead = floors_ahead(learned)
    if ahead.rows:
        yield "### In which metrics is a floor better than every model, in the mean?"
        yield _markdown(ahead)
    yield "### What does a CPU hour buy?"
    yield (
        "Validation: the least value up to a quarter, half and all of the steps, and "
        "what the last doubling"
        " gained, of the first seed, in the metric that was validated. Models whose "
        "last doubling gained more"
        " than 2 % have not converged. Hours are without validations, as in entries "
        "(the first"
        " trainings of NeuralMPM did not time them apart)."
    )
    heads = (
        "model",
        "steps x windows",
        "epochs",
        "CPU hours per seed",
        "skill",
        "validated",
    )
    learning = ("validation at 1/4", "1/2", "1", "last doubling")
    yield markdown(
        ("where", *heads, *learning),
        [row for e in learned for row in _training_rows(e)],
    )


def _training_rows(evidence: Evidence) -> Iterator[list[str]]:
    """Yield what each model was trained for and what that brought, best first."""
    for name in evidence.order(evidence.models):
        method = evidence.models[name]
        record = method.seeds[0].record
        # beside the step an entry holds one number, the metric that was validated
        held = [
            (e["step"], n, v)
            for e in record.get("validation", ())
            for n, v in e.items()
            if n != "step"
        ]
        best = [
            min(
                (value for step, _, value in held if step <= share * record["step"]),
                default=None,
            )
            for share in (0.25, 0.5, 1.0)
        ]
        if "windows" in record:
            seen = record["step"] * record["recipe"]["training"]["batch"]
        else:
            seen = None
        if best[1] and best[2] is not None:
            gain = 1.0 - best[2] / best[1]
        else:
            gain = None
        yield [
            evidence.where,
            label(name),
            budget(record),
            number(seen / record["windows"] if seen else None),
            number(method.hours_per_seed),
            number(evidence.skill(name)),
            held[0][1] if held else "-",
            *map(number, best),
            "-" if gain is None else f"{100.0 * gain:.2g} %",
        ]


def _chapter(evidence: Evidence) -> Iterator[str]:
    """Yield what was scored on one split and size: over the horizon, beside the thesis,
    costs.
    """
    from lagbench.baselines.job import (
        changes_of,
    )  # loads torch, which the imports of this page do not

    task = evidence.size.task
    size = evidence.size
    yield f"## {evidence.where}"
    yield (
        f"{size.particles} particles, {task.input_frames} frames given, "
        f"{task.horizon} predicted,"
        f" {len(size.subsets['test'])} test scenarios, {len(size.subsets['train'])} "
        f"to train on; data set"
        f" {size.version}. Best first by `{evidence.ranking}`."
    )
    yield _horizon(evidence)
    if not evidence.models:
        return
    if size.split in TABLE_4_8:
        yield "Table 4.8: errors of a rollout by scene, ours / the thesis's."
        yield _markdown(rollout_table(evidence, TABLE_4_8[size.split]))
    else:
        yield from _vorticity_at(evidence)
    yield (
        "Cost. Recipe, and what training or prediction changed of it (`none`: "
        "nothing), seeds in their order"
        " where they differ, from the entry's words where no record of the training "
        "lies beside it. Speed-up:"
        " our solver's time for a frame on one core over the model's, same machine. "
        "Hours are without"
        " validations."
    )
    heads = (
        "model",
        "recipe",
        "changed",
        "parameters",
        "seeds",
        "CPU hours per seed",
        "hardware",
    )
    rows = []
    for name, method in evidence.models.items():
        record = method.seeds[0].record
        cost = method.cost
        recipes = [held.record.get("recipe", {}) for held in method.seeds]
        changed = [
            recipe.get("changed")
            or "; ".join(changes_of(recipe))
            or ("none" if recipe else "-")
            for recipe in recipes
        ]
        paid = (
            (cost.seconds_per_frame, cost.solver_seconds_per_frame, cost.speed_up)
            if cost
            else (None,) * 3
        )
        rows.append(
            [
                label(name),
                " / ".join(
                    dict.fromkeys(recipe.get("name", "-") for recipe in recipes)
                ),
                " / ".join(dict.fromkeys(changed)),
                "-" if method.parameters is None else f"{method.parameters:,}",
                ", ".join(
                    "-" if held.seed is None else str(held.seed)
                    for held in method.seeds
                ),
                number(method.hours_per_seed),
                hardware(record),
                *map(number, paid),
            ]
        )
    yield markdown((*heads, "s/frame", "solver s/frame", "speed-up"), rows)


def _horizon(evidence: Evidence) -> str:
    """Return the scores over the horizon of models and floors: skill, ranking metric,
    the chosen ones.
    """
    free = evidence.size.split in TABLE_4_8
    held: dict[str, Metric] = {}
    for method in evidence.methods.values():
        held |= {name: score.metric for name, score in method.scores.items()}
    chosen = [
        held[name]
        for name in dict.fromkeys((evidence.ranking, *CHOSEN))
        if name in held
    ]
    # vorticity says little where the material does not fill the box
    hidden = ("vorticity", "distributions") if free else ()
    shown = [
        m
        for m in chosen
        if m.direction is not Direction.NONE and m.family not in hidden
    ]

    def cell(method: Method, metric: str) -> str:
        if metric not in method.scores:
            return "-"
        score = method.scores[metric]
        if len(method.seeds) > 1:
            spread = f" ± {number(method.spread(metric), 2)}"
        else:
            spread = ""
        if count := sum(score.undefined):
            undefined = f", {count} undefined"
        else:
            undefined = ""
        return interval(score.mean, score.interval) + spread + undefined

    rows = []
    for name in evidence.order():
        method = evidence.methods[name]
        if name in REFERENCES:
            seeds = "floor"
        else:
            seeds = str(len(method.seeds))
        cells = [cell(method, metric.name) for metric in shown]
        rows.append([label(name), number(evidence.skill(name)), seeds, *cells])
    heads = ["model", "skill", "seeds"]
    for m in shown:  # as in "position_rmse [length], lower"
        if m.direction is Direction.TARGET:
            goal = f" {m.perfect:g}"
        else:
            goal = ""
        heads.append(f"{m.name} [{m.unit}], {ARROWS[m.direction]}{goal}")
    return markdown(heads, rows)


def _vorticity_at(evidence: Evidence) -> Iterator[str]:
    """Yield Tables 5.4 and 5.5 and Fig. 5.13's correlations: ours, T0 in brackets, the
    thesis's beside.
    """
    frame = key_frame(evidence.size)
    first = scenario_of(evidence.size, 0)
    if evidence.size.split == "cavity":
        thesis = TABLE_5_4
    else:
        thesis = {}
    measures = ("mae", "mse", "rmse", "kl", "pearson")
    yield (
        f"Tables 5.4, 5.5 and Fig. 5.13: vorticity at frame {frame}, mean over "
        f"scenarios, in brackets the"
        f" first test scenario (T0){'; the thesis has T0' if thesis else ''}."
    )
    heads = [
        f"{m.upper()}{who}"
        for m in measures
        for who in (("", ", thesis") if thesis else ("",))
    ]
    models = evidence.models
    rows = []
    for name in dict.fromkeys(n for n in (*OPERATORS, *models) if n in models):
        row = [label(name)]
        for measure in measures:
            values = [
                models[name].at(f"vorticity_{measure}", frame, where)
                for where in (None, first)
            ]
            row.append(f"{number(values[0])} ({number(values[1])})")
            row += [number(thesis.get(name, {}).get(measure), 4)] if thesis else []
        rows.append(row)
    yield markdown(["model", *heads], rows)
    both = [name for name in thesis if name in models]
    if len(both) > 1:
        ours = {name: models[name].at("vorticity_mse", frame) for name in both}
        tau = agreement([thesis[name]["mse"] for name in both], list(ours.values()))
        yield f"Kendall's tau of the two orders by MSE: {number(tau, 2)} (1: the same order, -1: reversed)."


def agreement(first: Sequence[float], second: Sequence[float]) -> float:
    """Return Kendall's tau of two rankings without ties: 1 the same order, -1 reversed,
    0 unrelated.
    """
    pairs = list(combinations(zip(first, second, strict=True), 2))
    turned = sum((a - b) * (x - y) < 0.0 for (a, x), (b, y) in pairs)
    return 1.0 - 2.0 * turned / len(pairs)


def _missing(found: Sequence[Evidence]) -> Iterator[str]:
    """Yield what has no entry on each split and size, and the command that makes it."""
    for evidence in found:
        split = evidence.size.split
        size = evidence.size.name
        absent = [name for name in EXPECTED[split] if name not in evidence.methods]
        refused = [label(name) for name in absent if evidence.trained(name)]
        missing = [label(name) for name in absent if not evidence.trained(name)]
        if refused:
            yield f"- {evidence.where}: {', '.join(refused)}: trained, no score (docs/baselines.md says why)."
        if missing:
            if len(missing) == len(EXPECTED[split]):
                what = "all models"
            else:
                what = ", ".join(missing)
            command = (
                f"python -m lagbench.baselines.reproduce --size {size} --split {split}"
            )
            yield f"- {evidence.where}: {what}: `{command}`, then `lagbench submit`."
        if evidence.stale:
            yield f"- {evidence.where}: {len(evidence.stale)} score files of other data, left out."


def _markdown(held: Table) -> str:
    return markdown(held.columns, held.rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(
        prog="python -m lagbench.baselines.reproduce.results",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", "-o", type=Path, default=Path("docs/results.md"))
    parser.add_argument("--board", type=Path, default=BOARD)
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument(
        "--runs", type=Path, help="folder of runs that are not committed yet"
    )
    parser.add_argument(
        "--studies",
        type=Path,
        default=STUDIES,
        help="committed results that are no entries",
    )
    parser.add_argument("--root", type=Path, help="not needed: no data set is read")
    parser.add_argument(
        "--check", action="store_true", help="write nothing; fail where it is stale"
    )
    given = parser.parse_args(arguments)
    try:
        sources = Sources(
            board=given.board,
            weights=given.weights,
            runs=given.runs,
            studies=given.studies,
        )
        page = render(sources).encode()
        if given.check:
            stale = not given.output.is_file() or given.output.read_bytes() != page
            sys.stdout.write(f"{given.output}: {'stale' if stale else 'up to date'}\n")
            return int(stale)
        write_atomically(given.output, page)
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{given.output}: written, {len(page)} bytes\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
