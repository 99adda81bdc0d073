"""The results page beside the leaderboard: two routes to the same numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from lagbench.board.build import collect
from lagbench.board.model import Tab
from lagbench.board.overview import LearningVerdict, judge, verdict_of_interval
from lagbench.references.predictor import Kind
from studies.result_tables import deciding_model, verdict_on_learning
from studies.thesis.split_results import BOARD, Sources, SplitResults


@pytest.mark.slow
def test_learning_is_judged_as_the_leaderboard_judges_it() -> None:
    """The ratio to the classical solver of every committed entry is that of the page:
    both take the costs that were measured in one run. So is the verdict.
    """
    tabs = collect(BOARD).tabs
    compared = 0
    for tab in tabs:
        results = SplitResults(Sources(), tab.size.split, tab.size.name)
        for row in tab.rows:
            if not row.active:
                assert row.entry.method not in results.methods
                continue
            against = None
            if row.entry.method in results.methods:
                against = results.against_classical(row.entry.method)
            if against is None or row.against_classical is None:
                assert against is None
                assert row.against_classical is None
                continue
            assert against.value == pytest.approx(row.against_classical.mean, rel=1e-6)
            compared += 1
        _require_same_verdict(tab, results)
    assert compared > 25


def _require_same_verdict(tab: Tab, results: SplitResults) -> None:
    """Compare the page's verdict on a data set with that of the results."""
    conclusion = judge(tab)
    assert conclusion is not None
    words = {
        LearningVerdict.PAYS: "Learning pays on",
        LearningVerdict.OPEN: "the question is open",
        LearningVerdict.DOES_NOT_PAY: "Learning does not pay on",
        LearningVerdict.NO_SOLVER: "no classical solver is as cheap as",
    }
    verdict = verdict_on_learning([results])
    for own_verdict, words_of_verdict in words.items():
        is_own = own_verdict is conclusion.verdict
        assert (words_of_verdict in verdict) is is_own, tab.id
    assert deciding_model(results) == conclusion.row.id


def test_a_better_model_of_unknown_cost_decides_nothing() -> None:
    """The next one decides, as on the page of the leaderboard."""
    results = SplitResults(Sources(), "cavity", "mini")
    first = deciding_model(results)
    assert first is not None
    unknown = replace(results.methods[first], cost=None, measured=None)
    results.methods[first] = unknown
    assert results.best(Kind.LEARNED, Kind.HYBRID) == first
    second = deciding_model(results)
    assert second not in (None, first)


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.5, 0.9, LearningVerdict.PAYS),
        (0.5, 1.1, LearningVerdict.OPEN),
        (1.1, 1.5, LearningVerdict.DOES_NOT_PAY),
        (math.nan, math.nan, LearningVerdict.OPEN),
    ],
)
def test_the_interval_of_a_ratio_decides(
    low: float, high: float, verdict: LearningVerdict
) -> None:
    """The page and the results take the verdict from this function."""
    assert verdict_of_interval(low, high) is verdict


def test_a_model_that_is_cheaper_than_every_solver_stands_beside_those_it_beats() -> (
    None
):
    """Where a frame of the only model costs less than one of any solver, its scores
    beside theirs say which it beats: NeuralMPM on cylinder mini, made ten times faster.
    """
    results = SplitResults(Sources(), "cylinder", "mini")
    del results.methods["hybrid-projection"]
    method = results.methods["neuralmpm"]
    assert method.measured is not None
    seconds = 0.1 * method.measured.seconds_per_frame
    faster = method.measured.model_copy(update={"seconds_per_frame": seconds})
    results.methods["neuralmpm"] = replace(method, measured=faster)
    scores = {}
    for name, method in results.methods.items():
        scores[name] = method.scores[results.ranking].mean
    assert results.against_classical("neuralmpm") is None
    solvers = ("projection-3x", "projection-2x", "projection")
    beaten = [name for name in solvers if scores[name] > scores["neuralmpm"]]
    ahead = [name for name in solvers if scores[name] < scores["neuralmpm"]]
    verdict = verdict_on_learning([results])
    assert beaten
    less, greater = verdict.split("less than")[1].split("greater than")
    assert " and ".join(beaten) in less
    assert " and ".join(ahead) in greater
