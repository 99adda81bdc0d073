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
from lagbench.board.overview import FINDING
from lagbench.errors import LagbenchError

from .result_tables import (
    claims_overview,
    cost_table,
    format_time,
    leading_table,
    metrics_table,
    order_agreement,
    ranking_table,
    run_of,
    summary_table,
    training_table,
    vorticity_table,
)
from .thesis.cases import key_frame
from .thesis.claims import CLAIMS, claim_rows, comparison_table
from .thesis.items import table_markdown
from .thesis.plan import TABLES, read_study_results, study_name, study_rows
from .thesis.roster import (
    EXPECTED,
    NEWER_SPLITS,
    SIZES,
    label,
)
from .thesis.split_results import (
    BOARD,
    WEIGHTS,
    Sources,
    SplitResults,
    read_json,
)
from .thesis.tables import studies_beside_thesis
from .thesis.var_protocol import FILE_NAME as PROTOCOL_FILE
from .thesis.var_protocol import beside_thesis

INTRODUCTION = """\
# Results

On this page you can look up for each data set:

- which model is the most accurate;
- the scores of predictors without training;
- whether a model is better than every classical solver of the same or a smaller cost;
- which recipe trained a model, and how long the training took.

First comes what these numbers show [about learning](#does-learning-pay). The table
behind it has the best learned model and the best hybrid of each data set. Then each
data set has a chapter with its [active entries](glossary.md) and reference predictors.
Last come [claims](#claims) about the models, and notes on the trainings."""

SUMMARY_NOTE = """\
- Scores are errors ([metrics](scoring.md#metrics)), so lower is better.
- A *naive* predictor learns nothing and integrates no equations. A *classical* solver
  integrates the equations. Both are [reference predictors](references.md): nobody
  trains them.
- A *learned* [model](baselines.md) contains no solver. A *hybrid* is a classical solver
  with a learned part. Some data sets have no hybrid.
- The time in brackets is the processor time of one frame on one core, as a mean over
  the first ten frames. All times of one data set come from one run on one machine. So
  compare times only within a data set.
- `skill` is 1 - (score of the model) / (score of the best naive predictor). Skill 1 is
  perfect. Skill 0 is as good as that predictor.
- `against_classical` is (score of the model) / (score of a classical solver). The
  solver is the best one that costs no more per frame than the model. The brackets
  contain the 95 % interval.
- If every solver costs more than the model, the ratio uses the cheapest solver. Then
  the cell says "which costs more".
- The simulator itself, restarted from the given frames, is not among the solvers."""

LEARNING = "## Does learning pay?"

HOW_TO_READ = """\
## How to read the chapters

Each chapter has three tables. Cavity mini also has Table 5.4 of the
[thesis](glossary.md).

**Ranking.** The best method comes first.

- The score is the mean over the test scenarios. The brackets contain its 95 % interval
  (bootstrap over scenarios).
- If a model has several seeds, the number after ± is the standard deviation over the
  seeds. The leaderboard resamples seeds too, so the leaderboard has wider intervals.
- A dash means that there is no value.
- `readme-network` is the network of the program in the README.
- A [mirror-averaged](baselines.md#mirror-averaging) model has the weights of the model
  without averaging.
- The times and `against_classical` mean the same as in the first table.

**Other metrics.** The table has means over scenarios and frames. [Scoring](scoring.md)
defines the metrics. ↓ means that lower is better, and ↑ that higher is better. After ◎
stands the best value. A star marks a metric that is undefined in some frames. The mean
leaves these frames out. On [free surfaces](glossary.md) the table has no metrics of the
vorticity.

**Trainings.**

- `changed` lists the options that differ from the recipe. If the seeds of a model
  differ in an option, a slash separates the options of the seeds.
- The CPU hours are a mean over the seeds, without hours on a GPU. The hours include
  validations only for the first seed of NeuralMPM on cavity mini.
- If a training started from other weights, its hours include the earlier trainings.

`python -m studies.results -o docs/results.md` writes this page from the entries, the
score files and the records of the trainings."""

CLAIMS_NOTE = """\
The questions below concern the splits of the thesis. Some questions test a claim of the
thesis on our data. The answers use the ranking metric and the level of 5 %:

| answer | meaning |
| --- | --- |
| yes | significantly better than every compared model |
| no | significantly worse than the only compared model |
| open | the test finds no difference from the only compared model |
| better than 4, worse than 0, open: 1 | better than four models, open for one |
| 3 of 5 compared | two of the five other models have no usable entry |
| these weights | a compared model with random training has fewer than three seeds |
| - | no usable entries to compare |

A usable entry is active and fails no [gate](baselines.md#gates). Graph networks are
named after their [operator](glossary.md). In the first two questions a graph network
with "pushforward" in its name stands for its operator. The compared networks may also
differ in size and training, see the tables of trainings.

Do not compare the errors of the thesis with ours directly. The thesis trained on its
own data, at the size `full`. Each value of the thesis comes from one scenario."""

COMPARISONS_NOTE = """\
The next tables have the comparisons behind the answers:

- The first number of `means` and of `seeds` belongs to the model `first`.
- The means use the seeds that both models have. Without common seeds the means use all
  seeds.
- `lead` is the difference of the means, positive if the first model is better.
- `won` counts the scenarios in which the first model is better.
- `p (Holm)` is corrected for the number of compared models. If both models have one
  seed, p comes from the sign-flip test. Otherwise p comes from a t-test over scenarios
  and seeds ([tests](scoring.md#comparing-two-methods)).
- Some tables have rows for a second metric. The answers do not use these rows."""

LEADING_NOTE = """\
The table lists the metrics in which a reference predictor has a better mean than every
learned or hybrid model. A data set without a row has no such metric."""

TRAINING_NOTE = """\
All rows are of the first seed. The columns *validation at* show the lowest validation
error in the first quarter of the steps, in the first half, and in all steps.
`validated` is the metric of this error (`rmse` is the position error).

The last column shows how much this error decreased in the second half. A training with
a decrease of more than 2 % has not converged.

The third column has the steps and the windows per step. An epoch is one pass over all
windows of train. VAR and the hybrids are fitted, without steps. If a training started
from other weights, the steps of the earlier trainings count too."""

COMMANDS = """\
## How to make these results again

```
lagbench generate --split cavity --size mini
lagbench train --baseline neuralmpm --split cavity --size mini --seed 0
lagbench predict runs/cavity/mini/neuralmpm-0/weights.safetensors -o predictions.nc
lagbench score predictions.nc
```

`python -m studies.thesis --size mini --root DATA --runs runs` makes the tables and
figures of the thesis, and trains the models for them. DATA is your
[root folder](glossary.md).

The file `leaderboard/submissions/SPLIT/SIZE/METHOD.yaml` states under `command` how
each model was made."""

MISSING_NOTE = """\
The models below have no active entry, so the tables do not show them. Semicolons
separate the names of the models. Each command trains the models of its line that have a
recipe."""


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

    parts = [INTRODUCTION, LEARNING, " ".join(FINDING), "## Best models"]
    summarised = [*learned, *newer_learned]
    if summarised:
        parts += [summary_table(summarised), SUMMARY_NOTE]
    parts.append(HOW_TO_READ)
    for results in [*scored, *newer_learned]:
        parts += _chapter(results)
    parts += _claims(learned)
    parts += _references_and_training(summarised)

    protocols = list(_protocols(sources, sizes))
    if protocols:
        parts += ["## VAR by the thesis's protocol (section 4.8.3)", *protocols]
    studies = list(_studies(sources, sizes))
    if studies:
        parts += ["## MLPs from frame to frame", *studies]

    missing = [line for results in thesis_results for line in _missing_lines(results)]
    parts += [COMMANDS, "## Missing"]
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
    yield COMPARISONS_NOTE

    for claim, rows_by_place in rows_by_claim.items():
        all_rows = [row for rows in rows_by_place.values() for row in rows]
        if all_rows:
            yield f"### {claim.question}"
            yield table_markdown(comparison_table(all_rows))


def _references_and_training(all_results: Sequence[SplitResults]) -> Iterator[str]:
    """Yield where reference predictors lead, and how much trainings still gain."""
    if not all_results:
        return
    leading = leading_table(all_results)
    if leading:
        yield "## In which metrics does a reference predictor lead?"
        yield LEADING_NOTE
        yield leading

    yield "## How much does the error decrease with the training?"
    yield TRAINING_NOTE
    yield training_table(all_results)


def _chapter(results: SplitResults) -> Iterator[str]:
    """Yield the results on one split and size: ranking, thesis, metrics, trainings."""
    size = results.size
    task = size.task
    test_count = len(size.subsets["test"])
    train_count = len(size.subsets["train"])
    yield f"## {results.where}"
    text = (
        f"Data of version {size.version}: {size.particles:,} particles, "
        f"{task.input_frames} given frames, {task.horizon} predicted frames, "
        f"{train_count} train scenarios, {test_count} test scenarios."
    )
    run = run_of(results)
    if run is not None and run.solver is not None:
        text += (
            " The simulator that made the data takes "
            f"{format_time(run.solver)} for a frame."
        )
    yield text
    yield ranking_table(results)
    if size.split == "cavity":
        yield from _thesis_vorticity(results)
    yield "**Other metrics.**"
    yield metrics_table(results)
    if results.models:
        yield "**Trainings.**"
        yield cost_table(results)


def _thesis_vorticity(results: SplitResults) -> Iterator[str]:
    """Yield Table 5.4 of the thesis beside our values; nothing without its models."""
    table = vorticity_table(results)
    if not table:
        return
    yield (
        "**Table 5.4 of the thesis.** [Metrics](scoring.md#metrics) of the vorticity "
        f"at frame {key_frame(results.size)}. Our cells have the mean over the test "
        "scenarios, and in brackets the value of the first test scenario. Table 5.4 "
        "has only one test scenario, which corresponds to our first one."
    )
    yield table
    tau = order_agreement(results)
    if tau is not None:
        yield (
            "Kendall's tau compares the order of the models by our mean MSE with the "
            f"order by the MSE of the thesis. Here tau is {tau}. (For equal orders tau "
            "is 1, for reversed orders -1.)"
        )


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
            names = "all models of the thesis, and NeuralMPM of this size"
        command = f"python -m studies.thesis --size {results.size.name} --split {split}"
        yield f"- {results.where}: without a recorded training: {names}. `{command}`"
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
