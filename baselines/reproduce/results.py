"""Write docs/results.md: every model's scores beside the thesis's numbers, from committed files.

    python -m lagbench.baselines.reproduce.results -o docs/results.md [--board leaderboard]
        [--weights baselines/weights] [--runs RUNS] [--check]

Score files and entries of the leaderboard and what trainings recorded suffice: no data set is
read. ``--runs`` adds what is not committed yet. The same files give the same bytes; ``--check``
writes nothing and fails where the page is stale.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.draw.markdown import table
from lagbench.errors import LagbenchError
from lagbench.scoring.task import ranking_metric

from .evidence import BOARD, WEIGHTS, Evidence, Sources, read_json
from .result_tables import costs, horizon, rollout_errors, totals, vorticity_at
from .roster import EXPECTED, SIZES, label
from .section_4_8_3 import FILE, SPLIT, beside
from .statements import key_frame, statements
from .wording import listed

__all__ = ["render"]

HEAD = """# Results

Ten reference models, their variants and two floors on the test scenarios of each data set, beside the
numbers of the thesis (D. Dharma, PhD thesis, University of Leeds, 2025). Written by
`python -m lagbench.baselines.reproduce.results -o docs/results.md` from the score files in `leaderboard/`
and the records of the trainings in `baselines/weights/`; do not edit.

How to read it. Cells are means over test scenarios with 95 % bootstrap intervals, and ± the deviation
over seeds where there are several. Differences are tested by the exact sign-flip test over scenarios,
two-sided, uncorrected for the number of comparisons; with fewer than six scenarios nothing is claimed. The
thesis trained on its own data, at what is here size `full`, for hours on GPUs, and prints one scenario
per table: its absolute numbers are beside ours for orientation, and only orders can be compared at
size `mini` (a quarter of the particles, half the grid: vorticity is resolved half as finely, and a
node covers four times the area). `docs/scoring.md` defines every metric."""

COMMANDS = """## How to make these again

```
lagbench generate --split cavity --size mini
lagbench train --baseline supergat --split cavity --size mini --seed 0
lagbench predict runs/cavity/mini/supergat-0/weights.pt -o runs/cavity/mini/supergat-0/predictions.nc
lagbench score runs/cavity/mini/supergat-0/predictions.nc
```

All models, tables and figures of a size, resumable: `python -m lagbench.baselines.reproduce --size mini
--root DATA --runs runs`. Variants change one option: `gns-novorticity` is `--baseline gns --set
model.loss.vorticity=0`, `supergat-unlinked` is `--baseline supergat-link --set model.link_weight=0`
(SuperGAT with link loss starts from smaller weights, so that the loss of links does not drown the
others), `mlp-change` is `--baseline mlp --recipe change`."""


def render(sources: Sources, sizes: Sequence[str] = SIZES) -> str:
    """Return the page."""
    found = [Evidence(sources, split, size) for size in sizes for split in EXPECTED]
    known = [evidence for evidence in found if evidence.methods]
    parts = [HEAD, _findings(known), *(part for evidence in known for part in _chapter(evidence))]
    protocols = [part for size in sizes for part in _protocol(sources, size)]
    parts += ["## VAR by the thesis's protocol (section 4.8.3)", *protocols] if protocols else []
    hours = [f"- {line}" for line in totals(known)]
    parts += [COMMANDS, "\n".join(["## Hours", "", *hours])] if hours else [COMMANDS]
    return "\n\n".join([*parts, _missing(found)]) + "\n"


def _findings(known: Sequence[Evidence]) -> str:
    lines = ["## Findings"]
    for evidence in known:
        said = list(statements(evidence))
        if evidence.models() and said:
            lines += ["", f"### {_title(evidence)}", "", *_paragraphs(said)]
    return "\n".join(lines if len(lines) > 1 else [*lines, "", "No model has been scored yet."])


def _paragraphs(said: Sequence[str]) -> Iterator[str]:
    """Yield one list item per claim, with the sentences that follow it."""
    items: list[list[str]] = []
    for sentence in said:
        if sentence.startswith("**") or not items:
            items.append([])
        items[-1].append(sentence)
    yield from (f"- {' '.join(item)}" for item in items)


def _title(evidence: Evidence) -> str:
    return f"{evidence.size.split} {evidence.size.name}"


def _chapter(evidence: Evidence) -> Iterator[str]:
    size, task = evidence.size, evidence.size.task
    yield f"## {_title(evidence)}"
    yield (
        f"{size.particles} particles, {task.input_frames} frames given, {task.horizon} predicted,"
        f" {len(size.subsets['test'])} test scenarios, {len(size.subsets['train'])} to train on; data set"
        f" {size.version}. Best first by `{ranking_metric(size)}`."
    )
    yield horizon(evidence)
    if evidence.models():
        yield from _beside_thesis(evidence)
        yield "Cost. Speed-up: our solver's time for a frame on one core over the model's, same machine."
        yield costs(evidence)


def _beside_thesis(evidence: Evidence) -> Iterator[str]:
    if ranking_metric(evidence.size) == "vorticity_rmse":
        frame = key_frame(evidence)
        text = f"vorticity at frame {frame}, mean over scenarios, in brackets the first test scenario (T0)"
        thesis = evidence.size.split == "cavity"
        yield (
            f"Tables 5.4, 5.5 and Fig. 5.13: {text}; the thesis's T0 beside it."
            if thesis
            else f"By frame: {text}."
        )
        yield vorticity_at(evidence)
    else:
        yield "Table 4.8: errors of a rollout by scene, ours / the thesis's."
        yield rollout_errors(evidence)


def _protocol(sources: Sources, size: str) -> Iterator[str]:
    """Yield what the thesis's own protocol gave for VAR, where it was measured."""
    for home in (sources.weights, sources.runs):
        path = home / SPLIT / size / FILE if home else None
        if path and path.is_file():
            sheet = beside(read_json(path))
            yield "\n\n".join([*sheet.notes, *(table(held.columns, held.rows) for held in sheet.tables)])
            return


def _missing(found: Sequence[Evidence]) -> str:
    lines = ["## Missing", ""]
    for evidence in found:
        split, size = evidence.size.split, evidence.size.name
        absent = [name for name in EXPECTED[split] if name not in evidence.methods]
        refused = [name for name in absent if evidence.trained(name)]
        if refused:
            names = listed(map(label, refused))
            lines.append(
                f"- {split} {size}: {names}: trained, and refused by the scorer (baselines.md says why)."
            )
        absent = [name for name in absent if name not in refused]
        if absent:
            what = "all models" if len(absent) == len(EXPECTED[split]) else listed(map(label, absent))
            short = " --recipe short" if size == "full" and "gns" in EXPECTED[split] else ""
            command = f"python -m lagbench.baselines.reproduce --size {size} --split {split}{short}"
            lines.append(f"- {split} {size}: {what}. `{command}` makes what is missing.")
        if evidence.stale:
            lines.append(f"- {split} {size}: {len(evidence.stale)} score files of other data, left out.")
    return "\n".join(lines if len(lines) > 2 else [*lines, "Nothing."])


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
    parser.add_argument("--runs", type=Path, help="folder of runs that are not committed yet")
    parser.add_argument("--root", type=Path, help="not needed: no data set is read")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where it is stale")
    given = parser.parse_args(arguments)
    try:
        page = render(Sources(board=given.board, weights=given.weights, runs=given.runs)).encode()
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
