"""Write docs/results.md from committed files: claims, scores and costs.

    python -m studies.results -o docs/results.md [--board leaderboard]
        [--weights FOLDER] [--runs RUNS] [--studies FOLDER] [--check]

The page shows our scores beside the numbers of the thesis. It needs the entries and
score files of the leaderboard and the records of trainings; no data set is read.
``--runs`` adds runs that are not committed yet. The same files give the same bytes.
``--check`` writes nothing and fails where the page is stale.
"""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.errors import LagbenchError

from .result_tables import (
    claims_overview,
    cost_table,
    horizon_table,
    order_agreement,
    summary_table,
    training_table,
    verdict_on_learning,
    vorticity_table,
)
from .thesis.cases import key_frame
from .thesis.claims import CLAIMS, claim_rows, comparison_table, leading_references
from .thesis.items import table_markdown
from .thesis.plan import TABLES, read_study_results, study_name, study_rows
from .thesis.published import TABLE_4_8
from .thesis.roster import (
    EXPECTED,
    NEWER_SPLITS,
    ROSTER,
    SIZES,
    RosterModel,
    label,
)
from .thesis.split_results import (
    BOARD,
    WEIGHTS,
    Sources,
    SplitResults,
    read_json,
)
from .thesis.tables import rollout_table, studies_beside_thesis
from .thesis.var_protocol import FILE_NAME as PROTOCOL_FILE
from .thesis.var_protocol import beside_thesis

INTRODUCTION = """\
# Results

On this page you can look up three things: how well the reference models predict each
data set, which claims of the thesis are true on our data, and the cost of the
trainings. (The thesis is D. Dharma, PhD thesis, University of Leeds, 2025.)

The first table has the best learned model and the best hybrid of each data set. (Some
data sets have no hybrid. Data sets of size tiny have no model at all, so they are not
on this page.) Then follow the claims, the trainings, and one chapter for each data set.
A chapter has all models with an active entry on its data set. The chapters of cavity,
fluid and multimaterial also have the numbers of the thesis beside ours."""

SUMMARY_NOTE = """\
Each row compares the best learned model, or the best hybrid, of a data set with the
best predictors that are not trained. A hybrid is a solver with a learned part. A lower
score is better.

- The time in brackets after a score is the processor time of one frame on one core. All
  times of a row come from one run on one machine (`leaderboard/verified.yaml`), and
  `against_classical` uses them. Other rows may come from other machines.
- `skill` is 1 - (score of the model) / (score of the best naive baseline).
- `against_classical` is (score of the model) / (score of the best classical solver that
  costs no more per frame than the model). If every classical solver costs more, the
  ratio uses the cheapest one, and the cell says so. The brackets contain the 95 %
  interval. The name of the solver follows. A dash means that the cost of the model was
  not measured beside the solvers.
- [Learning pays](glossary.md) on a data set if the whole interval of its best model,
  learned or hybrid, is below 1."""

HOW_TO_READ = """\
## How to read this page

- **Reference predictors** are not trained. A naive baseline learns nothing and
  integrates no equations. A classical solver integrates the equations
  ([references](references.md)).
- **Skill** is 1 - (score of the model) / (score of the best naive baseline). Skill 1 is
  perfect. Skill 0 is as good as this baseline. Below 0 the model is worse.
- **Tables of scores** contain models and reference predictors. A cell has the mean over
  the test scenarios, with a 95 % bootstrap interval over scenarios. If a model has
  several seeds, the number after ± is the standard deviation over the seeds. For such a
  model the leaderboard resamples the seeds too, so the intervals on the leaderboard are
  wider than those on this page.
  "1440 undefined" means that the metric is undefined in 1440 frames. The tables of
  `fluid` and `multimaterial` leave out the metrics of the vorticity. The column
  `seeds` states how many seeds a model has; for a reference predictor it states the
  kind. In the tables of costs `seeds` lists the seeds.
- **Tests** are two-sided. If both models have one seed, the test is the exact
  sign-flip test over scenarios. Otherwise it is a t-test, whose variance has two
  parts, scenarios and seeds ([scoring](scoring.md#comparing-two-methods)). Two models
  may use the same weights, for example with and without mirror averaging. Then they are
  compared seed by seed. The p-values are corrected for
  the number of models in the comparison (Holm). With fewer than six scenarios there is
  no test.
- **The thesis** trained on its own data, at the size called `full` here, for hours on
  GPUs. Each value in its tables comes from one scenario. So compare its numbers with
  ours only roughly. On the splits of the thesis, size `mini` has about a quarter of the
  particles and half the cells along an axis (on cavity 36 % and 60 %). So at `mini`
  compare only the order of the models.
- **Metrics** are defined in [scoring](scoring.md). In the column heads ↓ means that
  lower is better, ↑ that higher is better, and ◎ that the value after the sign is best.
- **readme-network** is the small network of the program in the README. It has no
  `training.json`, so the columns of its training have a dash. Its entry states one
  epoch and 0.05 processor hours.
- **Comparisons** have two models, *first* and *second*. `where` is the data set. The
  first number of `means` and of `seeds` belongs to the first model, the second number
  to the second model. `lead` is the difference of the means in the units of the
  metric. It is positive if the first model is better. `won` is the number of scenarios
  in which the first model is better. The last column states whether the first model is
  better or worse. *Open* means that the test finds no difference.

`python -m studies.results -o docs/results.md` writes this page from the entries and
score files in `leaderboard/` and from the records of the trainings. Do not edit it."""

CLAIMS_NOTE = """\
The table has one question per row, and one answer per data set. It has the data sets of
the thesis: `cavity`, `curl-noise`, `fluid` and `multimaterial`. Tables, figures and
sections in the questions are those of the thesis. The answers use the ranking metric
over the horizon. Tables under some questions also compare another metric of the thesis.
The answers do not use it. These words have a fixed meaning in the answers:

- "Yes" and "better" mean significantly better at 5 %. "No" and "worse" mean
  significantly worse. "Open" means that the test finds no difference.
- "Ahead of 3 of 5" means that the mean is better than the means of three of five
  models. "Better than 2, worse than 1" counts the significant differences.
- "3 of 5 compared" means that two of the five other models have no active entry that
  passes all [gates](baselines.md#gates).
- "These weights" means that a model has fewer than three trainings. Then the answer is
  about these weights, not about the methods. For a fit without random numbers one
  training is enough.
- A dash means that an entry is missing.

The answers compare two models over the seeds that both have. If there are no such
seeds, or if one of the models draws no random numbers, the answers use all seeds of
both. They leave out models that fail a [gate](baselines.md#gates), and superseded and
withdrawn entries.

Graph networks differ in their *operator*, and are named after it
([glossary](glossary.md)). A graph network may have a second entry, with ", pushforward"
at the end of its name. In two questions the second entry takes the place of the first:
which operator is the most accurate, and whether NeuralMPM is better than every graph
network. The question about the best naive baseline counts the two entries as two
models."""

MISSING_NOTE = """\
These models are missing on this page. Semicolons separate their names. Some lines have
a command. It trains the models of its line, except those for which lagbench has no
recipe on this data set. Then `lagbench submit` makes the entries."""

UNANSWERED_NOTE = """\
### Questions without an answer

Each of these questions compares a model with one or two others. A question has an
answer on a data set if the model and at least one of the others have an active entry
there that fails no [gate](baselines.md#gates). No data set of the thesis has such
entries, so these questions have no answer:"""

TRAINING_NOTE = """\
A training takes steps, and each step uses some windows. An epoch is one pass over all
windows of train. VAR and the hybrids are fitted instead, without steps. The three
columns *validation at* belong to the first seed. They state the lowest validation error
that it reached within the first quarter, the first half and all of the steps.
`validated` is the metric of this error. (`rmse` is the position error. Only our oldest
trainings have it.) The last column shows how much the error decreased in the second
half of the steps. If it decreased by more than 2 %, the training has not converged.
Hours do not include hours on a GPU or validations. There is one exception: the hours of
the first seed of NeuralMPM on cavity mini include validations. If a training started
from the weights of earlier trainings, its steps, epochs and hours include the earlier
trainings."""

COST_NOTE = """\
**Cost.** `changed` lists the options of the training or of the prediction that differ
from the recipe. `none` means that no option differs. If the seeds of a model have
different values, slashes separate the different values. A value that several seeds
share stands only once. If there is no record of the training, `recipe` and `changed`
come from the entry. The speed-up is the time of our solver for a frame, on one core,
divided by the time of the model on the same machine. The times are those of the entry,
mostly means over whole rollouts. The first table of this page has means over the first
ten frames, which were measured in another run. So the two can differ. `trained on` is
the machine on which the training ended. `s/frame` is the time on one core of a CPU. A
dash means that there is no record of the value. Hours do not include hours on a GPU or
validations. There is one exception: the hours of the first seed of NeuralMPM on cavity
mini include validations."""

COMMANDS = """\
## How to make these results again

```
lagbench generate --split cavity --size mini
lagbench train --baseline supergat --split cavity --size mini --seed 0
lagbench predict runs/cavity/mini/supergat-0/weights.pt -o predictions.nc
lagbench score predictions.nc
lagbench submit predictions.nc --from meta.yaml
```

`python -m studies.thesis --size mini --root DATA --runs runs` makes the tables and
figures of the thesis at a size, and trains the models that they need. With the option
`--split` it trains all models of the thesis for this split, and NeuralMPM. If you
interrupt the command, run it again: it continues where it stopped. `lagbench submit`
makes entries from the predictions of the trained models.

This page shows only results that have an entry. `python -m studies.results` can also
show the results of two files that are not in the repository: `mlp_studies.json` and
`var_protocol.json`. Its options `--studies` and `--runs` each name a folder. In both
folders the files lie in the subfolder `<split>/<size>/`. If both folders have the same
file, the one in the folder of `--studies` counts. `python -m studies.thesis` writes
`mlp_studies.json` into the folder of runs. The other file is the output of
`python -m studies.thesis.var_protocol --size mini --json`. Save it as
`fluid/mini/var_protocol.json` in one of the two folders.

Some models of `python -m studies.thesis` need more than the option `--baseline`. Each
line has the name of such a model, and the options of `lagbench train` (or the command)
that make it:"""


def render(sources: Sources, sizes: Sequence[str] = SIZES) -> str:
    """Return the page."""
    thesis_results = []
    newer_results = []
    for size in sizes:
        for split in EXPECTED:
            thesis_results.append(SplitResults(sources, split, size))
        for split in NEWER_SPLITS:
            if sources.has_size(split, size):
                newer_results.append(SplitResults(sources, split, size))
    scored = [results for results in thesis_results if results.methods]
    learned = [results for results in scored if results.models]
    newer_learned = [results for results in newer_results if results.models]

    parts = [INTRODUCTION]
    summarised = [*learned, *newer_learned]
    if summarised:
        parts += [summary_table(summarised), SUMMARY_NOTE]
        parts.append(verdict_on_learning(summarised))
    parts.append(HOW_TO_READ)
    parts += _claims(learned)
    parts += _references_and_training(summarised)
    for results in [*scored, *newer_learned]:
        parts += _chapter(results)

    protocols = list(_protocols(sources, sizes))
    if protocols:
        parts += ["## VAR by the thesis's protocol (section 4.8.3)", *protocols]
    studies = list(_studies(sources, sizes))
    if studies:
        parts += ["## MLPs from frame to frame", *studies]

    variants = [_variant_line(model) for model in ROSTER.values() if model.variant_of]
    missing = [line for results in thesis_results for line in _missing_lines(results)]
    parts += [COMMANDS, "\n".join(variants), "## Missing"]
    if missing:
        parts += [MISSING_NOTE, "\n".join(missing)]
    else:
        parts.append("Nothing.")
    return "\n\n".join(parts) + "\n"


def _claims(learned: Sequence[SplitResults]) -> Iterator[str]:
    """Yield an overview of the thesis's claims, then the comparisons behind each."""
    yield "## Claims"
    if not learned:
        yield (
            "No model has been scored yet on a data set of the thesis. The commands "
            "are at the end of this page."
        )
        return

    rows_by_claim = {}
    for claim in CLAIMS:
        rows_by_claim[claim] = {
            results.where: claim_rows(claim, results) for results in learned
        }
    yield CLAIMS_NOTE
    yield claims_overview(rows_by_claim, [results.where for results in learned])

    unanswered = []
    for claim, rows_by_place in rows_by_claim.items():
        all_rows = [row for rows in rows_by_place.values() for row in rows]
        if all_rows:
            yield f"### {claim.question}"
            yield table_markdown(comparison_table(all_rows))
        else:
            unanswered.append(f"- {claim.question}")
    if unanswered:
        yield UNANSWERED_NOTE
        yield "\n".join(unanswered)


def _references_and_training(learned: Sequence[SplitResults]) -> Iterator[str]:
    """Yield where references beat models, and how errors still fall at the end."""
    if not learned:
        return
    leading = leading_references(learned)
    if leading.rows:
        yield (
            "## In which metrics has a reference predictor a better mean than every "
            "model?"
        )
        yield table_markdown(leading)

    yield "## How much does the error decrease with the training?"
    yield TRAINING_NOTE
    yield training_table(learned)


def _chapter(results: SplitResults) -> Iterator[str]:
    """Yield the scores on one split and size: horizon, thesis, costs."""
    size = results.size
    task = size.task
    test_count = len(size.subsets["test"])
    train_count = len(size.subsets["train"])
    yield f"## {results.where}"
    yield (
        f"{size.particles} particles; {task.input_frames} given frames, "
        f"{task.horizon} predicted frames; {test_count} test scenarios, {train_count} "
        f"train scenarios; version {size.version} of the data. The models are sorted "
        f"by `{results.ranking}`, the best first."
    )
    yield horizon_table(results)
    if not results.models:
        return

    if size.split in TABLE_4_8:
        yield (
            "This table has two errors for each scene, like Table 4.8 of the thesis: "
            "`average` is `mse_avg` of the scenario, and `end` is its `mse_end`. A "
            "cell is our value / the value of the thesis. Our scenario is not the one "
            "of the thesis, but our first test scenario of the same scene."
        )
        yield table_markdown(rollout_table(results, TABLE_4_8[size.split]))
    elif size.split in EXPECTED:
        yield _vorticity_note(results)
        yield vorticity_table(results)
        tau = order_agreement(results)
        if tau is not None:
            yield (
                "Kendall's tau compares two orders of the models: by our MSE, averaged "
                "over the test scenarios, and by the MSE of the thesis on T0. It is "
                f"{tau} (1: the same order, -1: the reversed order)."
            )
    yield COST_NOTE
    yield cost_table(results)


def _vorticity_note(results: SplitResults) -> str:
    note = (
        "This table has the metrics of the vorticity at frame "
        f"{key_frame(results.size)}. Tables 5.4 and 5.5 and Fig. 5.13 of the thesis "
        "have the same metrics. A cell is the mean over test scenarios, with the first "
        "test scenario (T0) in brackets"
    )
    if results.size.split == "cavity":
        return f"{note}. The thesis has only T0: compare it with the brackets."
    return f"{note}."


def _protocols(sources: Sources, sizes: Sequence[str]) -> Iterator[str]:
    """Yield the results of VAR by the thesis's protocol, those of --studies first."""
    for size in sizes:
        for home in (sources.studies, sources.runs):
            if home is None:
                continue
            path = home / "fluid" / size / PROTOCOL_FILE
            if path.is_file():
                yield beside_thesis(read_json(path)).text
                break


def _studies(sources: Sources, sizes: Sequence[str]) -> Iterator[str]:
    """Yield the tables of MLPs that have a row with results."""
    homes = [home for home in (sources.studies, sources.runs) if home is not None]
    for size in sizes:
        for name, (_, split) in TABLES.items():
            measured = sources.size(split, size).measured
            data_hash = measured.dataset_sha256 if measured else None
            folders = [home / split / size for home in homes]
            studies = read_study_results(folders, data_hash)
            row_names = {study_name(study) for study in study_rows(name)}
            if row_names & studies.keys():
                yield studies_beside_thesis(name, size, studies).text


def _variant_line(model: RosterModel) -> str:
    """Return how a variant of a reference model is made."""
    settings = "".join(f" --set {setting}" for setting in model.settings)
    if model.weights_of:
        weights = f"weights of `{model.weights_of}`"
        return f"- `{model.name}`: `lagbench predict{settings}` with {weights}"
    recipe = f" --recipe {model.recipe}" if model.recipe else ""
    return f"- `{model.name}`: `--baseline {model.baseline}{recipe}{settings}`"


def _missing_lines(results: SplitResults) -> Iterator[str]:
    """Yield the models without an entry, and the command that makes them."""
    split = results.size.split
    expected = EXPECTED[split]
    unscored = []
    missing = []
    for name in expected:
        if results.stand_in(name) in results.methods:
            continue
        if results.was_trained(name):
            unscored.append(label(name))
        else:
            missing.append(label(name))

    if unscored:
        names = "; ".join(unscored)
        yield (
            f"- {results.where}: trained, but without an active entry "
            f"([reason](baselines.md#gates)): {names}."
        )
    if missing:
        names = "; ".join(missing)
        if len(missing) == len(expected):
            names = "all models of the thesis, and NeuralMPM trained at this size"
        command = f"python -m studies.thesis --size {results.size.name} --split {split}"
        yield f"- {results.where}: without an entry, `{command}`: {names}."
    if results.stale:
        count = len(results.stale)
        yield f"- {results.where}: {count} score files belong to other data."


SHOWN_LINES = 20  # of the difference from a stale page
SHOWN_COLUMNS = 200  # of each of them


def main(arguments: Sequence[str] | None = None) -> int:
    """Write or check the page; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.results",
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
        help="folder of results without an entry, beside those of --runs",
    )
    parser.add_argument("--root", type=Path, help="not needed: no data set is read")
    parser.add_argument(
        "--check",
        action="store_true",
        help="write nothing; fail where the page is stale",
    )
    options = parser.parse_args(arguments)
    try:
        sources = Sources(
            board=options.board,
            weights=options.weights,
            runs=options.runs,
            studies=options.studies,
        )
        page = render(sources).encode()
        if options.check:
            return _check(options.output, page)
        write_atomically(options.output, page)
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{options.output}: written, {len(page)} bytes\n")
    return 0


def _check(path: Path, page: bytes) -> int:
    """Return 0 if a file holds the page; else 1, and print how they differ."""
    if not path.is_file():
        sys.stdout.write(f"{path}: stale: there is no such page\n")
        return 1
    present = path.read_bytes()
    if present == page:
        sys.stdout.write(f"{path}: up to date\n")
        return 0
    difference = difflib.unified_diff(
        present.decode("utf-8", "replace").splitlines(),
        page.decode().splitlines(),
        fromfile=str(path),
        tofile="from the score files",
        n=0,
        lineterm="",
    )
    lines = list(difference)
    sys.stdout.write(f"{path}: stale\n")
    for line in lines[:SHOWN_LINES]:
        sys.stdout.write(f"{line[:SHOWN_COLUMNS]}\n")
    if len(lines) > SHOWN_LINES:
        sys.stdout.write(f"... and {len(lines) - SHOWN_LINES} lines more\n")
    return 1


if __name__ == "__main__":
    raise SystemExit(main())
