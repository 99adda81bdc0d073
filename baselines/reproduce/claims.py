"""What the scores say of the thesis's claims and of ours: rows of one kind of
comparison.

A comparison is two-sided, in the metric's loss, of the seeds that both have (of all
where they share none): the exact sign-flip test over test scenarios where both have one
seed, else the two-way bootstrap over scenarios and seeds, of the differences seed by
seed where both are the same weights used in two ways. The p-values of one model against
several are corrected together (Holm 1979). With one training per model a difference is
one between two trainings, which another seed may turn.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from lagbench.figures.tables import Table
from lagbench.metrics.metric import Direction
from lagbench.metrics.significance import SIGNIFICANCE, Comparison, compare, holm
from lagbench.metrics.table import CHOSEN

from .evidence import Evidence, ordered
from .thesis import FRAME_MODELS, OPERATORS, ROSTER, interval, key_frame, label, number


@dataclass(frozen=True)
class Claim:
    """A question about one model and its rivals, asked of every split by the ranking
    metric.
    """

    first: str  # model that the question is about; empty for the best floor
    rivals: tuple[str, ...] = ()  # models to compare it with; empty for all
    question: str = ""
    metrics: tuple[str, ...] = ()  # judged beside the ranking one, over the horizon
    # judged at the frame at which the thesis compares models
    at_key_frame: tuple[str, ...] = ()


_CLAIMS = {
    "Does SuperGAT come first among the operators (Table 5.4: on the cavity "
    "it does)?": Claim(
        "supergat",
        tuple(name for name in OPERATORS if name != "supergat"),
        at_key_frame=("vorticity_mse",),
    ),
    "Does SuperGAT's link loss help, at the same start and seeds?": Claim(
        "supergat", ("supergat-unlinked",), at_key_frame=("vorticity_pearson",)
    ),
    "Does the vorticity loss help (Fig. 5.5: it does), at the same budget "
    "and seeds?": Claim(
        "gns",
        ("gns-novorticity",),
        metrics=("position_rmse", "energy_error"),
        at_key_frame=("vorticity_pearson",),
    ),
    "Do summed messages decide: is SuperGAT better with them than without?": Claim(
        "supergat", ("supergat-unsummed",)
    ),
    "Is MX attention better than SD (Eq. 5.27 has both)?": Claim(
        "supergat", ("supergat-sd",)
    ),
    "Is acceleration a better target than velocity (section 5.9.3)?": Claim(
        "gns", ("gns-velocity",), at_key_frame=("vorticity_pearson",)
    ),
    "Is L2 better than L1 as the norm of the loss (the thesis chooses L2)?": Claim(
        "gns", ("gns-l1",)
    ),
    "Does a weight of the vorticity loss ten times as large help?": Claim(
        "gns-tenfold", ("gns",), at_key_frame=("vorticity_pearson",)
    ),
    "Does a loss over three own steps help (section 6.2), at the same "
    "processor time?": Claim("gns-unrolled", ("gns",)),
    "Graph or grid: is neuralmpm better than every operator?": Claim(
        "neuralmpm", OPERATORS
    ),
    "Is it better for NeuralMPM to learn from its own rollouts than from more calls "
    "unrolled?": Claim("neuralmpm-long", ("neuralmpm-unrolled",)),
    "Does NeuralMPM gain by one grid of velocities for all materials, at no "
    "more steps?": Claim("neuralmpm", ("neuralmpm-unmixed",)),
    "Does NeuralMPM gain by conserved momentum, shorter bundles and more of the "
    "first frames?": Claim("neuralmpm-conserving", ("neuralmpm-long", "neuralmpm")),
    "Does NeuralMPM gain by holding bodies in shape and matter from being pressed "
    "together?": Claim("neuralmpm-projected", ("neuralmpm-conserving",)),
    "Does NeuralMPM gain by the mean over the images of the box, with the same "
    "weights?": Claim("neuralmpm-averaged", ("neuralmpm",)),
    "Does NeuralMPM gain by starting from the weights of another size?": Claim(
        "neuralmpm-started", ("neuralmpm",)
    ),
    "Does NeuralMPM that is held in shape gain by starting from the weights of "
    "another size?": Claim("neuralmpm-projected-started", ("neuralmpm-projected",)),
    "Does it gain by grids of shape and density as fine as those of full "
    "at full?": Claim(
        "neuralmpm-projected-finer",
        ("neuralmpm-projected-started", "neuralmpm-projected"),
    ),
    "Does LSTM + MLP come first among the frame models (Table 4.8: it does)?": Claim(
        "lstm-mlp", tuple(name for name in FRAME_MODELS if name != "lstm-mlp")
    ),
    "Is standing still better than VAR(1) (section 4.8.3: its forecast "
    "diverges)?": Claim("persistence", ("var",), metrics=("mse_end",)),
    "Is the best floor better than a model that learned?": Claim(""),
}

CLAIMS = tuple(replace(claim, question=question) for question, claim in _CLAIMS.items())


class Verdict(enum.StrEnum):
    """What a comparison lets one say of the first of two, at 5 %."""

    BETTER = "better"
    WORSE = "worse"
    OPEN = "open"
    FEW = "too few scenarios"


@dataclass(frozen=True, kw_only=True)
class Compared:
    """One row: two models by one metric."""

    where: str  # split and size
    metric: str
    frame: int | None  # None for the horizon
    first: str
    second: str
    means: tuple[float, float]
    test: Comparison
    won: int  # scenarios in which the first has the smaller loss
    seeds: tuple[int, int]  # trainings behind each mean
    p: float  # corrected for the number of rivals; NaN with too few scenarios

    @property
    def verdict(self) -> Verdict:
        """What the test lets one say."""
        if math.isnan(self.p):
            return Verdict.FEW
        if self.p >= SIGNIFICANCE:
            return Verdict.OPEN
        if self.test.difference < 0.0:
            return Verdict.BETTER
        return Verdict.WORSE


def compared(
    evidence: Evidence,
    first: str,
    rivals: Sequence[str],
    metrics: Sequence[str],
    *,
    frame: int | None = None,
) -> list[Compared]:
    """Return a model against its rivals by each metric that both have, over the horizon
    or at a frame.
    """
    found = []
    for metric in metrics:
        rows = [
            row
            for name in rivals
            if {first, name} <= evidence.methods.keys()
            and (row := _pair(evidence, first, name, metric, frame))
        ]
        corrected = holm([row.test.p for row in rows])
        found += [replace(row, p=p) for row, p in zip(rows, corrected, strict=True)]
    return found


def _pair(
    evidence: Evidence, first: str, second: str, metric: str, frame: int | None
) -> Compared | None:
    one = evidence.methods[first]
    two = evidence.methods[second]
    common = {held.seed for held in one.seeds} & {held.seed for held in two.seeds}
    if common:
        one = one.of_seeds(common)
        two = two.of_seeds(common)
    if metric not in one.scores or metric not in two.scores:
        return None
    scores = [held.scores[metric] for held in (one, two)]
    sides = [[seed.scores[metric] for seed in held.seeds] for held in (one, two)]
    if frame is not None:
        scores = [replace(score, values=score.at(frame)) for score in scores]
        sides = [
            [replace(score, values=score.at(frame)) for score in side] for side in sides
        ]
    same_weights = bool(common) and first in ROSTER and ROSTER[first].weights == second
    test = compare(*sides, paired=same_weights)
    losses = [
        [score.metric.loss(value) for value in score.values.tolist()]
        for score in scores
    ]
    return Compared(
        where=evidence.where,
        metric=metric,
        frame=frame,
        first=first,
        second=second,
        means=(scores[0].mean, scores[1].mean),
        test=test,
        won=sum(
            ours < theirs for ours, theirs in zip(*losses, strict=True)
        ),  # NaN is not smaller
        seeds=(len(one.seeds), len(two.seeds)),
        p=test.p,
    )


def claim_rows(claim: Claim, evidence: Evidence) -> list[Compared]:
    """Return all rows of a claim on one split and size, those by the ranking metric
    first.
    """
    first = claim.first or evidence.best_floor
    if first is None:
        return []
    rivals = claim.rivals or tuple(
        name for name in evidence.order(evidence.models) if name != first
    )
    over = dict.fromkeys((evidence.ranking, *claim.metrics))
    rows = compared(evidence, first, rivals, tuple(over))
    return rows + compared(
        evidence, first, rivals, claim.at_key_frame, frame=key_frame(evidence.size)
    )


def answer(rows: Sequence[Compared]) -> str:
    """Return what the rows by the ranking metric say: yes, no, open, or of how many
    rivals; "" without.
    """
    judged = [row for row in rows if row.metric == rows[0].metric and row.frame is None]
    verdicts = [row.verdict for row in judged]
    if not verdicts or Verdict.FEW in verdicts:
        if verdicts:
            return Verdict.FEW.value
        return ""
    better = verdicts.count(Verdict.BETTER)
    worse = verdicts.count(Verdict.WORSE)
    if better == len(judged):
        return "yes"
    if len(judged) == 1:
        if worse:
            return "no"
        return "open"
    ahead = sum(row.test.difference < 0.0 for row in judged)
    return (
        f"ahead of {ahead} of {len(judged)}; better than {better}, worse than {worse}"
    )


def comparison_table(rows: Sequence[Compared]) -> Table:
    """Return comparisons as a table; the lead is second minus first in loss: positive
    favours the first.
    """
    sides = ("where", "metric", "first", "second", "means", "seeds")
    heads = (*sides, "lead (95 %)", "won", "p (Holm)", "the first is")
    cells = []
    for row in rows:
        low, high = row.test.interval
        cells.append(
            (
                row.where,
                row.metric if row.frame is None else f"{row.metric}, frame {row.frame}",
                label(row.first),
                label(row.second),
                f"{number(row.means[0])} / {number(row.means[1])}",
                f"{row.seeds[0]} / {row.seeds[1]}",
                interval(-row.test.difference, (-high, -low)),
                f"{row.won} of {len(row.test.scenarios)}",
                number(row.p, 2),
                row.verdict.value,
            )
        )
    return Table("", heads, tuple(cells))


def floors_ahead(everything: Sequence[Evidence]) -> Table:
    """Return the metrics in which a floor is better than every model, in the mean."""
    rows = []
    for evidence in everything:
        for metric in dict.fromkeys((evidence.ranking, *CHOSEN)):
            scores = {
                n: m.scores[metric]
                for n, m in evidence.methods.items()
                if metric in m.scores
            }
            if any(
                score.metric.direction is Direction.NONE for score in scores.values()
            ):
                continue
            order = [
                name for name in ordered(scores) if not math.isnan(scores[name].mean)
            ]
            best = next((name for name in order if name in evidence.models), None)
            if best is None or order[0] not in evidence.floors:
                continue
            loss = scores[best].metric.loss
            if loss(scores[order[0]].mean) < loss(scores[best].mean):
                means = number(scores[order[0]].mean), number(scores[best].mean)
                rows.append(
                    (evidence.where, metric, order[0], means[0], label(best), means[1])
                )
    return Table(
        "",
        ("where", "metric", "floor", "its mean", "best model", "its mean"),
        tuple(rows),
    )
