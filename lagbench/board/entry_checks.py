"""What an entry states of a training and of diverged rollouts, and what cannot be.

`lagbench submit` refuses it before the scoring, and ``leaderboard check`` reports it in
an entry that was written by hand.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from lagbench.references.predictor import Kind
from lagbench.scoring.score_file import SubmissionStatistics
from lagbench.submission.budget import Budget
from lagbench.submission.issues import ValidationIssue
from lagbench.submission.provenance import TrainingProvenance

from .entry import Entry, Prediction, ScoredFile
from .issues import make_issue

SCORED_SUBSETS = frozenset({"test", "shift"})
"""Subsets whose scenarios no model may learn from."""


def find_training_fault(
    kind: Kind,
    provenances: Sequence[TrainingProvenance | None],
    budgets: Sequence[Budget | None],
) -> str | None:
    """Return what is stated of a training and cannot be; None if all can be.

    Args:
        kind: what the submitter says of the method.
        provenances: trainings that the submitter and the files of predictions state.
        budgets: budgets that they state.
    """
    for provenance in provenances:
        if provenance is None:
            continue
        scored = sorted(SCORED_SUBSETS.intersection(provenance.subsets))
        if scored:
            return f"a training on windows of {' and '.join(scored)}"
        if kind is Kind.CLASSICAL:
            return "kind: classical, and a training"
    if kind is Kind.CLASSICAL and any(budget is not None for budget in budgets):
        return "kind: classical, and the budget of a training"
    return None


def find_contradiction(budget: Budget) -> str | None:
    """Return where a budget contradicts itself, None where it does not.

    No step is later than the last one, and the best validation is the least one.
    """
    steps = [step for step, _ in budget.validations]
    values = [value for _, value in budget.validations]
    if any(later <= earlier for earlier, later in pairwise(steps)):
        return "validations whose steps do not ascend"
    if budget.steps is not None:
        if steps and steps[-1] > budget.steps:
            return f"a validation at step {steps[-1]} of {budget.steps}"
        if budget.best_step is not None and budget.best_step > budget.steps:
            return f"best_step {budget.best_step} of {budget.steps} steps"
    if budget.best is not None and values and budget.best > min(values):
        return f"best {budget.best}, and a validation of {min(values)}"
    return None


def check_training(entry: Entry) -> Iterator[ValidationIssue]:
    """Yield what an entry states of its training that cannot be."""
    path = entry.yaml_path
    provenances = [TrainingProvenance.from_sentence(entry.training)]
    budgets: list[Budget | None] = [entry.budget]
    for prediction in entry.predictions:
        provenances.append(prediction.provenance)
        budgets.append(prediction.budget)
    fault = find_training_fault(entry.kind, provenances, budgets)
    if fault is not None:
        yield make_issue("training", path, fault)
    if entry.budget is not None:
        yield from _check_budget(entry.budget, f"{path}, budget")
    for number, prediction in enumerate(entry.predictions):
        other_data_set = _find_other_data_set(entry, prediction)
        if other_data_set is not None:
            yield make_issue(
                "training",
                f"{path}, predictions.{number}",
                f"a training on {other_data_set}",
                what="the weights lie beside an entry of another data set",
                expected="weights beside an entry of the data set of their training",
                fix="submit predictions and weights of one training",
            )
        if prediction.budget is not None:
            where = f"{path}, predictions.{number}.budget"
            yield from _check_budget(prediction.budget, where)


def _check_budget(budget: Budget, where: str) -> Iterator[ValidationIssue]:
    """Yield the contradiction of a budget, if it has one."""
    contradiction = find_contradiction(budget)
    if contradiction is not None:
        yield make_issue(
            "budget",
            where,
            contradiction,
            what="a budget that contradicts itself",
            expected="steps up to the last one, and the least validation as best",
            fix="state the budget as `lagbench train` wrote it",
        )


def _find_other_data_set(entry: Entry, prediction: Prediction) -> str | None:
    """Return the data set that weights on the board were trained on, if it is another.

    Weights lie beside an entry of the data set of their training; other entries share
    them from there. None where no weights or no training are known.
    """
    weights = prediction.weights
    provenance = prediction.provenance or entry.provenance
    if weights is None or provenance is None or weights.path.endswith(".onnx"):
        return None
    split, size, _ = weights.place_of(entry.place)
    if (provenance.split, provenance.size) == (split, size):
        return None
    return f"{provenance.split} {provenance.size}"


def check_diverged(
    file: ScoredFile, scores: SubmissionStatistics, where: str
) -> Iterator[ValidationIssue]:
    """Yield diverged rollouts of scenarios or frames that were not predicted.

    Args:
        file: a score file, as its entry describes it.
        scores: what the score file holds.
        where: key of the entry, for messages.
    """
    for scenario, frame in file.diverged_at.items():
        tally = scores.tallies.get(scenario)
        if tally is None or not tally.frames[0] <= frame <= tally.frames[-1]:
            yield make_issue(
                "score",
                where,
                f"scenario {scenario}, frame {frame}",
                what="a diverged rollout that was not predicted",
                expected="scenarios and frames of the score file",
            )
            return
