"""Claims of the thesis and of ours, and what the scores say about each.

A comparison is two-sided, in the loss of a metric, over the seeds that both models have
(over all where they share none, or where the fit of one of them draws nothing). Where
both have one seed, the test is the exact sign-flip test over test scenarios, else the
two-way bootstrap over scenarios and seeds.
For the same weights used in two ways it is that of the differences seed by seed. The
p-values of one model against several are corrected together (Holm 1979). With fewer
than three trainings of a model, an answer is about these weights: another seed may
change it.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from lagbench.figures.tables import Table
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import Direction
from lagbench.metrics.significance import SIGNIFICANCE, Comparison, compare, holm
from lagbench.metrics.table import CHOSEN
from lagbench.references.table import REFERENCES

from .cases import key_frame
from .formatting import interval, number
from .published import FRAME_MODELS, OPERATORS
from .roster import ROSTER, WITHOUT_DRAWS, label
from .split_results import Method, SplitResults, rank

SEEDS_OF_A_CLAIM = 3
"""Trainings of a model that a claim about its method needs."""


@dataclass(frozen=True)
class Claim:
    """A question about one model and its rivals, asked of every split."""

    first: str  # the model in question; empty for the best naive baseline
    rivals: tuple[str, ...] = ()  # models to compare it with; empty for all
    question: str = ""
    # metrics to compare over the horizon, beside the one that ranks
    metrics: tuple[str, ...] = ()
    # metrics to compare at the frame at which the thesis compares models
    at_key_frame: tuple[str, ...] = ()


_CLAIMS = {
    "Is SuperGAT the most accurate operator? (On the cavity it is, in Table "
    "5.4.)": Claim(
        "supergat",
        tuple(name for name in OPERATORS if name != "supergat"),
        at_key_frame=("vorticity_mse",),
    ),
    "Does the link loss of SuperGAT help, with the same initial weights and "
    "seeds?": Claim(
        "supergat", ("supergat-unlinked",), at_key_frame=("vorticity_pearson",)
    ),
    "Does the vorticity loss help, with the same budget and seeds? (In Fig. 5.5 it "
    "does.)": Claim(
        "gns",
        ("gns-novorticity",),
        metrics=("position_rmse", "energy_error"),
        at_key_frame=("vorticity_pearson",),
    ),
    "Is SuperGAT better if each particle also receives the sum of its messages?": Claim(
        "supergat", ("supergat-unsummed",)
    ),
    "Is SuperGAT better with MX attention than with scaled dot products (SD)? (Eq. "
    "5.27 has both.)": Claim("supergat", ("supergat-sd",)),
    "Is acceleration a better target than velocity (section 5.9.3)?": Claim(
        "gns", ("gns-velocity",), at_key_frame=("vorticity_pearson",)
    ),
    "Is L2 better than L1 as the norm of the loss? (The thesis chooses L2.)": Claim(
        "gns", ("gns-l1",)
    ),
    "Does a vorticity loss with ten times the weight help?": Claim(
        "gns-tenfold", ("gns",), at_key_frame=("vorticity_pearson",)
    ),
    "Does a loss over three unrolled steps help (section 6.2), with the same "
    "processor time?": Claim("gns-unrolled", ("gns",)),
    "Is NeuralMPM, a network on a grid, better than every graph network?": Claim(
        "neuralmpm", OPERATORS
    ),
    "Does NeuralMPM learn better from its own rollouts than from more unrolled "
    "frames?": Claim("neuralmpm-long", ("neuralmpm-unrolled",)),
    "Is NeuralMPM better with one velocity grid for all materials than with one grid "
    "per material? (The model with one grid per material has at least as many training "
    "steps as the other.)": Claim("neuralmpm", ("neuralmpm-unmixed",)),
    "Does NeuralMPM gain by three changes together: momentum is conserved, a call "
    "predicts fewer frames, and more of the windows are from the first frames?": Claim(
        "neuralmpm-conserving", ("neuralmpm-long", "neuralmpm")
    ),
    "Does NeuralMPM gain by shape matching and density projection?": Claim(
        "neuralmpm-projected", ("neuralmpm-conserving",)
    ),
    "Does NeuralMPM gain by averaging over the mirror images of the box, with the "
    "same weights?": Claim("neuralmpm-averaged", ("neuralmpm",)),
    "Does NeuralMPM gain by starting from the weights of another size?": Claim(
        "neuralmpm-started", ("neuralmpm",)
    ),
    "Does NeuralMPM with shape matching gain by starting from the weights of "
    "another size?": Claim("neuralmpm-projected-started", ("neuralmpm-projected",)),
    "Does NeuralMPM with shape matching gain if the shape matching and the density use "
    "an additional grid of 60 cells along each axis?": Claim(
        "neuralmpm-projected-finer",
        ("neuralmpm-projected-started", "neuralmpm-projected"),
    ),
    "Is LSTM + MLP more accurate than MLP and LSTM? (In Table 4.8 it is.)": Claim(
        "lstm-mlp", tuple(name for name in FRAME_MODELS if name != "lstm-mlp")
    ),
    "Is persistence, in which nothing moves, better than VAR(1)? (In section 4.8.3 "
    "the forecast of VAR(1) diverges.)": Claim(
        "persistence", ("var",), metrics=("mse_end",)
    ),
    "Is the best naive baseline better than the learned and hybrid models?": Claim(""),
}

CLAIMS = tuple(replace(claim, question=question) for question, claim in _CLAIMS.items())


def _is_drawn(name: str) -> bool:
    """Return whether another seed gives another model."""
    return name not in REFERENCES and name not in WITHOUT_DRAWS


class Verdict(enum.StrEnum):
    """What a comparison says of the first of two models, at 5 %."""

    BETTER = "better"
    WORSE = "worse"
    OPEN = "open"
    FEW = "too few scenarios"


@dataclass(frozen=True, kw_only=True)
class ComparedModels:
    """Two models compared by one metric."""

    where: str  # split and size
    metric: str
    frame: int | None  # None for the horizon
    first: str
    second: str
    means: tuple[float, float]
    test: Comparison
    win_count: int  # scenarios in which the first has the smaller loss
    seed_counts: tuple[int, int]  # trainings behind each mean
    p: float  # corrected for the number of rivals; NaN with too few scenarios

    @property
    def has_enough_seeds(self) -> bool:
        """Whether the verdict is about the methods, not only about these weights."""
        names = (self.first, self.second)
        for name, count in zip(names, self.seed_counts, strict=True):
            if _is_drawn(name) and count < SEEDS_OF_A_CLAIM:
                return False
        return True

    @property
    def verdict(self) -> Verdict:
        """What the test says of the first model."""
        if math.isnan(self.p):
            return Verdict.FEW
        if self.p >= SIGNIFICANCE:
            return Verdict.OPEN
        if self.test.difference < 0.0:
            return Verdict.BETTER
        return Verdict.WORSE


def compare_models(
    results: SplitResults,
    first: str,
    rivals: Sequence[str],
    metrics: Sequence[str],
    *,
    frame: int | None = None,
) -> list[ComparedModels]:
    """Compare a model with its rivals by each metric that both have.

    The values are those over the horizon, or those of a frame. The p-values of a metric
    are corrected for the number of rivals (Holm). Rivals without results are left out.
    """
    all_rows: list[ComparedModels] = []
    for metric in metrics:
        rows = []
        for rival in rivals:
            if first in results.methods and rival in results.methods:
                row = _compare_pair(results, first, rival, metric=metric, frame=frame)
                if row is not None:
                    rows.append(row)
        corrected = holm([row.test.p for row in rows])
        for row, p in zip(rows, corrected, strict=True):
            all_rows.append(replace(row, p=p))
    return all_rows


def _compare_pair(
    results: SplitResults,
    first: str,
    second: str,
    *,
    metric: str,
    frame: int | None,
) -> ComparedModels | None:
    """Compare two models by a metric; None where one of them lacks it."""
    first_method = results.methods[first]
    second_method = results.methods[second]
    first_seeds = {training.seed for training in first_method.trainings}
    second_seeds = {training.seed for training in second_method.trainings}
    common_seeds = first_seeds & second_seeds
    if common_seeds and _is_drawn(first) and _is_drawn(second):
        first_method = first_method.of_seeds(common_seeds)
        second_method = second_method.of_seeds(common_seeds)
    if metric not in first_method.scores or metric not in second_method.scores:
        return None

    first_score = _value_at(first_method.scores[metric], frame)
    second_score = _value_at(second_method.scores[metric], frame)
    have_same_weights = (
        bool(common_seeds) and first in ROSTER and ROSTER[first].weights_of == second
    )
    test = compare(
        _seed_values(first_method, metric, frame),
        _seed_values(second_method, metric, frame),
        paired=have_same_weights,
    )

    win_count = 0
    for first_value, second_value in zip(
        first_score.values.tolist(), second_score.values.tolist(), strict=True
    ):
        first_loss = first_score.metric.loss(first_value)
        second_loss = second_score.metric.loss(second_value)
        win_count += first_loss < second_loss  # NaN is not smaller
    return ComparedModels(
        where=results.where,
        metric=metric,
        frame=frame,
        first=first,
        second=second,
        means=(first_score.mean, second_score.mean),
        test=test,
        win_count=win_count,
        seed_counts=(len(first_method.trainings), len(second_method.trainings)),
        p=test.p,
    )


def _value_at(score: Score, frame: int | None) -> Score:
    """Return a score with its values at a frame; None is the horizon."""
    if frame is None:
        return score
    return replace(score, values=score.at(frame))


def _seed_values(method: Method, metric: str, frame: int | None) -> list[Score]:
    """Return the score of each seed, at a frame or over the horizon."""
    return [_value_at(training.scores[metric], frame) for training in method.trainings]


def claim_rows(claim: Claim, results: SplitResults) -> list[ComparedModels]:
    """Return all comparisons of a claim, those by the ranking metric first.

    A claim that names no first model is about the best naive baseline. Under-trained
    models, which fail a gate, take no part. If the rivals are several operators, the
    variants that are trained with pushforward stand in, where they have scores.
    """
    first = claim.first or results.best_naive
    if first is None:
        return []
    rivals = claim.rivals
    if len(rivals) > 1 and set(rivals) <= set(OPERATORS):
        first = results.stand_in(first)
        rivals = tuple(results.stand_in(name) for name in rivals)
    if first in results.under_trained:
        return []
    if not rivals:
        ranked = results.order(results.models)
        rivals = tuple(name for name in ranked if name != first)

    rivals = tuple(name for name in rivals if name not in results.under_trained)

    metrics = tuple(dict.fromkeys((results.ranking, *claim.metrics)))
    over_horizon = compare_models(results, first, rivals, metrics)
    at_key_frame = compare_models(
        results, first, rivals, claim.at_key_frame, frame=key_frame(results.size)
    )
    return over_horizon + at_key_frame


def answer(rows: Sequence[ComparedModels], rival_count: int = 0) -> str:
    """Return the answer of the rows by the ranking metric; "" without rows.

    One rival gives yes, no or open. Several give yes, or how many are worse or better.
    An answer from fewer than three trainings of a model holds for these weights only,
    and says so. So does an answer from fewer rivals than the claim has.

    Args:
        rows: comparisons of one claim on one data set.
        rival_count: models that the claim names as rivals; 0 for all that there are.
    """
    judged = []
    for row in rows:
        if row.metric == rows[0].metric and row.frame is None:
            judged.append(row)
    if not judged:
        return ""

    verdicts = [row.verdict for row in judged]
    if Verdict.FEW in verdicts:
        return Verdict.FEW.value
    text = _count_verdicts(judged)
    if len(judged) < rival_count:
        text = f"{text}; {len(judged)} of {rival_count} compared"
    if all(row.has_enough_seeds for row in judged):
        return text
    return f"{text} (these weights)"


def _count_verdicts(judged: Sequence[ComparedModels]) -> str:
    """Return yes, no or open; or how many of several rivals are worse or better."""
    verdicts = [row.verdict for row in judged]
    better_count = verdicts.count(Verdict.BETTER)
    worse_count = verdicts.count(Verdict.WORSE)
    if better_count == len(judged):
        return "yes"
    if len(judged) == 1:
        return "no" if worse_count else "open"
    open_count = len(judged) - better_count - worse_count
    return f"better than {better_count}, worse than {worse_count}, open: {open_count}"


def comparison_table(rows: Sequence[ComparedModels]) -> Table:
    """Return comparisons as a table.

    The lead is the second mean minus the first in loss: positive favours the first.
    """
    heads = (
        "where",
        "metric",
        "first",
        "second",
        "means",
        "seeds",
        "lead (95 %)",
        "won",
        "p (Holm)",
        "the first is",
    )
    cells = []
    for row in rows:
        metric = row.metric
        if row.frame is not None:
            metric = f"{row.metric}, frame {row.frame}"
        low, high = row.test.interval
        cells.append(
            (
                row.where,
                metric,
                label(row.first),
                label(row.second),
                f"{number(row.means[0])} / {number(row.means[1])}",
                f"{row.seed_counts[0]} / {row.seed_counts[1]}",
                interval(-row.test.difference, (-high, -low)),
                f"{row.win_count} of {len(row.test.scenarios)}",
                number(row.p, 2),
                row.verdict.value,
            )
        )
    return Table("", heads, tuple(cells))


def leading_references(all_results: Sequence[SplitResults]) -> Table:
    """Return the metrics in which a reference predictor has a better mean than all."""
    rows = []
    for results in all_results:
        for metric in dict.fromkeys((results.ranking, *CHOSEN)):
            row = _leading_reference(results, metric)
            if row is not None:
                rows.append(row)
    heads = (
        "where",
        "metric",
        "reference predictor",
        "its mean",
        "best model",
        "its mean",
    )
    return Table("", heads, tuple(rows))


def _leading_reference(results: SplitResults, metric: str) -> tuple[str, ...] | None:
    """Return the row of a metric in which a reference predictor leads; None else."""
    scores: Mapping[str, Score] = {
        name: method.scores[metric]
        for name, method in results.methods.items()
        if metric in method.scores
    }
    directions = {score.metric.direction for score in scores.values()}
    if Direction.NONE in directions:
        return None

    ranked = [name for name in rank(scores) if not math.isnan(scores[name].mean)]
    ranked_models = [name for name in ranked if name in results.models]
    if not ranked_models or ranked[0] not in results.references:
        return None
    reference = ranked[0]
    model = ranked_models[0]
    reference_mean = scores[reference].mean
    model_mean = scores[model].mean
    loss = scores[model].metric.loss
    if loss(reference_mean) >= loss(model_mean):
        return None
    return (
        results.where,
        metric,
        reference,
        number(reference_mean),
        label(model),
        number(model_mean),
    )
