"""The results page beside the leaderboard: two routes to the same numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from reproduce_bench import markdown_rows

from lagbench.board.build import collect
from lagbench.board.folder import Folder
from studies.result_tables import (
    cost_table,
    summary_table,
    training_table,
)
from studies.thesis.split_results import BOARD, WEIGHTS, Sources, SplitResults
from studies.validation_curves import curves_of


@pytest.mark.slow
def test_the_ratio_to_the_solver_is_that_of_the_leaderboard() -> None:
    """Both take the costs that were measured in one run, for every committed entry."""
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
    assert compared > 25


def results_of_a_fast_neuralmpm(split: str) -> SplitResults:
    """Return the results of mini without the hybrid, with NeuralMPM 100 times faster.

    A frame of it then costs less than one of any solver.
    """
    results = SplitResults(Sources(), split, "mini")
    del results.methods["hybrid-projection"]
    method = results.methods["neuralmpm"]
    assert method.measured is not None
    seconds = 0.01 * method.measured.seconds_per_frame
    faster = method.measured.model_copy(update={"seconds_per_frame": seconds})
    results.methods["neuralmpm"] = replace(method, measured=faster)
    return results


def test_a_model_cheaper_than_every_solver_is_compared_with_the_cheapest() -> None:
    """On cylinder mini NeuralMPM is more accurate than ``projection``."""
    results = results_of_a_fast_neuralmpm("cylinder")
    against = results.against_classical("neuralmpm")
    assert against is not None
    assert against.solver_costs_more
    assert against.reference == "projection"
    (row,) = markdown_rows(summary_table([results]), "skill")
    assert row["against\\_classical"].endswith("projection, which costs more")


@pytest.mark.parametrize("has_records", [True, False])
def test_a_chain_of_trainings_counts_as_a_whole(
    has_records: bool, tmp_path: Path
) -> None:
    """The five trainings of GNS on fluid mini took 5,000, 7,500, 1,500, 1,500 and 1,500
    windows, as their commands in docs/baselines.md say; train has 7,056. Only the last
    training was validated at the end, so no earlier half can be compared.
    """
    weights = WEIGHTS if has_records else tmp_path
    results = SplitResults(Sources(weights=weights), "fluid", "mini")
    rows = {}
    for row in markdown_rows(training_table([results]), "decrease in the second half"):
        rows[row["model"]] = row
    row = rows["GNS, free flight"]
    assert row["steps x windows"] == "17,000 x 1"
    assert float(row["epochs"]) == pytest.approx(17_000 / 7_056, rel=2e-3)
    assert row["validation at 1/4"] == row["validation at 1/2"] == "-"
    assert float(row["validation at the end"]) == pytest.approx(0.0634, rel=1e-2)
    assert row["decrease in the second half"] == "-"


@pytest.mark.parametrize("has_records", [True, False])
def test_an_option_of_the_prediction_counts_for_all_seeds(
    has_records: bool, tmp_path: Path
) -> None:
    """All three seeds of the entry are averaged; only seed 0 has a record of training
    of its own.
    """
    weights = WEIGHTS if has_records else tmp_path
    results = SplitResults(Sources(weights=weights), "cavity", "mini")
    (row,) = (
        row
        for row in markdown_rows(cost_table(results), "CPU hours per seed")
        if row["model"] == "NeuralMPM, mirror-averaged"
    )
    assert row["seeds"] == "0, 1, 2"
    for changes in row["changed"].split(" / "):
        assert "model.average=true" in changes


def test_a_curve_begins_after_the_windows_of_earlier_trainings() -> None:
    """GNS on fluid mini was validated after 15,500 and after 17,000 windows."""
    curves = curves_of(Folder(BOARD))["fluid", "mini"]
    (curve,) = (curve for curve in curves if curve.name == "GNS, free flight")
    assert curve.windows == (15_500, 17_000)
    assert curve.gain is None
