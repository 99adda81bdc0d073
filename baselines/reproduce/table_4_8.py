"""Tables 4.7 and 4.8: average and end error of rollouts by MLP, LSTM and LSTM + MLP, scene by scene."""

from __future__ import annotations

from lagbench.scoring.tables import Table

from .evidence import Evidence
from .plan import Plan
from .roster import label
from .scenes import rollouts, stand_in
from .sheet import Sheet
from .thesis import FRAME_MODELS, TABLE_4_7, Rollout
from .wording import number

__all__ = ["rollout_table", "tables"]

SPLITS = ("fluid", "multimaterial")
ALSO = ("var", "var-stable")


def tables(plan: Plan, name: str) -> Sheet:
    """Return Table 4.7 or 4.8 with ours beside it."""
    if name == "table_4_7":
        note = (
            "Table 4.7 prints MLP and LSTM + MLP with average and end swapped against Table 4.8, which holds:"
            " an average below the error at the end is what a growing error gives."
        )
        return Sheet(notes=(note,), tables=(rollout_table(plan.evidence("fluid"), (TABLE_4_7,)),))
    found = [plan.evidence(split) for split in SPLITS]
    notes = (
        "Error of Eq. 4.16 over (x, y, u, v), each standardised by the statistics of train; average over the"
        " rollout (Eq. 4.17) and at its last frame (Eq. 4.18). Cells: ours / the thesis's.",
    )
    return Sheet(notes=notes, tables=tuple(rollout_table(held) for held in found))


def rollout_table(evidence: Evidence, printed: tuple[Rollout, ...] | None = None) -> Table:
    """Return average and end error by scene, ours and the thesis's, as in "0.31 / 0.58"."""
    names = [*FRAME_MODELS, *(n for n in ALSO if n in evidence.methods)]
    rows = []
    for row in printed or rollouts(evidence.size.split):
        scenario = stand_in(evidence.size, row.scenario)
        cells = [str(row.scenario), row.scene, "-" if scenario is None else str(scenario)]
        for theirs, metric in ((row.average, "mse_avg"), (row.end, "mse_end")):
            cells += [
                f"{_ours(evidence, name, metric, scenario)} / {number(theirs.get(name), 4)}" for name in names
            ]
        rows.append(tuple(cells))
    heads = [f"{what}, {label(name)}" for what in ("average", "end") for name in names]
    title = f"{evidence.size.split} {evidence.size.name}"
    return Table(title, ("thesis's id", "scene", "our id", *heads), tuple(rows))


def _ours(evidence: Evidence, name: str, metric: str, scenario: int | None) -> str:
    if name not in evidence.methods or scenario is None:
        return "-"
    score = evidence.methods[name].scores[metric]
    return number(float(score.values[score.scenarios.index(scenario)]))
