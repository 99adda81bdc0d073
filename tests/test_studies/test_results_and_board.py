"""The results page beside the leaderboard: two routes to the same numbers."""

from __future__ import annotations

import pytest

from lagbench.board.build import collect
from studies.thesis.split_results import BOARD, Sources, SplitResults


@pytest.mark.slow
def test_learning_is_judged_as_the_leaderboard_judges_it() -> None:
    """The ratio to the classical solver of every committed entry is that of the page:
    both take the costs that were measured in one run.
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
    assert compared > 40
