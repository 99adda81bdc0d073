"""The results page beside the leaderboard: two routes to the same numbers."""

from __future__ import annotations

import pytest

from lagbench.board.build import collect
from lagbench.board.model import Tab
from lagbench.board.overview import LearningVerdict, judge
from lagbench.references.predictor import Kind
from studies.result_tables import verdict_on_learning
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
    assert compared > 40


def _require_same_verdict(tab: Tab, results: SplitResults) -> None:
    """Compare the page's verdict on a data set with that of the results."""
    conclusion = judge(tab)
    assert conclusion is not None
    words = {
        LearningVerdict.PAYS: "Learning pays on",
        LearningVerdict.OPEN: "the question is open",
        LearningVerdict.DOES_NOT_PAY: "Learning does not pay on",
        LearningVerdict.NO_SOLVER: "no classical solver is as cheap as the best model",
    }
    verdict = verdict_on_learning([results])
    for own_verdict, words_of_verdict in words.items():
        is_own = own_verdict is conclusion.verdict
        assert (words_of_verdict in verdict) is is_own, tab.id
    assert results.best(Kind.LEARNED, Kind.HYBRID) == conclusion.row.id


def test_a_model_that_is_cheaper_than_every_solver_stands_beside_those_it_beats() -> (
    None
):
    """On cylinder mini a frame of NeuralMPM costs less than one of any solver: its
    scores beside theirs say which it beats.
    """
    results = SplitResults(Sources(), "cylinder", "mini")
    scores = {}
    for name, method in results.methods.items():
        scores[name] = method.scores[results.ranking].mean
    assert results.against_classical("neuralmpm") is None
    solvers = ("projection-3x", "projection-2x", "projection")
    beaten = [name for name in solvers if scores[name] > scores["neuralmpm"]]
    ahead = [name for name in solvers if scores[name] < scores["neuralmpm"]]
    verdict = verdict_on_learning([results])
    assert beaten
    assert f"less than that of {' and '.join(beaten)}." in verdict
    assert f"That of {' and '.join(ahead)} is less than the model's." in verdict
