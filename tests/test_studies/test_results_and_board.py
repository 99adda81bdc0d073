"""The results page beside the leaderboard: two routes to the same numbers."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from reproduce_bench import markdown_rows

from lagbench.board.build import collect
from lagbench.board.folder import Folder
from lagbench.board.model import Tab
from lagbench.board.overview import LearningVerdict, judge, verdict_of_interval
from lagbench.data.yamlfile import read_yaml
from lagbench.references.predictor import Kind
from studies.result_tables import (
    cost_table,
    deciding_model,
    slower_than_simulator,
    summary_table,
    training_table,
    verdict_on_learning,
)
from studies.thesis.split_results import BOARD, WEIGHTS, Sources, SplitResults
from studies.validation_curves import curves_of


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
        LearningVerdict.NO_SOLVER: "every classical solver costs more",
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
    beside_a_dear_solver = verdict_of_interval(low, high, solver_costs_more=True)
    if verdict is LearningVerdict.PAYS:
        assert beside_a_dear_solver is verdict
    else:
        assert beside_a_dear_solver is LearningVerdict.NO_SOLVER


TWO_OF_THREE = (
    r"On 2 of the 3 of these 4 data sets whose time was measured the best model .*"
    r" \(2 to 8.1 times as much\)\."
)


@pytest.mark.parametrize(
    ("ratios", "words"),
    [
        ([2.0, 0.5, 8.12, None], TWO_OF_THREE),
        ([2.44, None], r"On 1 of the 1 of these 2 data sets whose time was measured "),
        (
            [2.0, 0.5],
            r"On 1 of these 2 data sets the best model .* \(2 times as much\)\.",
        ),
        (
            [2.44],
            r"The best model takes more time .* \(2.4 times as much\)\.",
        ),
    ],
)
def test_data_sets_with_a_model_slower_than_the_simulator_are_counted(
    ratios: list[float | None], words: str
) -> None:
    """The range is that of the slower ones. A data set without a known time does not
    count, neither as slower nor in the total.
    """
    (sentence,) = slower_than_simulator(ratios)
    assert re.match(words, sentence)


def test_nothing_is_said_where_no_model_is_slower_than_the_simulator() -> None:
    assert slower_than_simulator([0.5, 1.0, None]) == []


def test_the_verdict_compares_times_of_one_run_with_the_simulator() -> None:
    """On cavity mini the hybrid takes 2.4 times as long as the solver, by the times of
    leaderboard/verified.yaml.
    """
    results = SplitResults(Sources(), "cavity", "mini")
    path = BOARD / "verified.yaml"
    lines = read_yaml(path)
    cost = lines["submissions/cavity/mini/hybrid-projection.yaml"]["cost"]
    ratio = cost["seconds_per_frame"] / cost["solver"]
    assert ratio > 1.0
    assert deciding_model(results) == "hybrid-projection"
    assert f"simulator that made the data ({ratio:.2g} times" in verdict_on_learning(
        [results]
    )


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


def test_a_model_cheaper_than_every_solver_pays_if_it_beats_the_cheapest() -> None:
    """On cylinder mini NeuralMPM is more accurate than ``projection``."""
    results = results_of_a_fast_neuralmpm("cylinder")
    against = results.against_classical("neuralmpm")
    assert against is not None
    assert against.solver_costs_more
    assert against.reference == "projection"
    assert "Learning pays on cylinder mini" in verdict_on_learning([results])
    (row,) = markdown_rows(summary_table([results]), "skill")
    assert row["against\\_classical"].endswith("projection, which costs more")


def test_a_model_cheaper_than_every_solver_may_stand_behind_them() -> None:
    """On curl-noise-3d mini all solvers are more accurate, but need more time."""
    results = results_of_a_fast_neuralmpm("curl-noise-3d")
    verdict = verdict_on_learning([results])
    assert "On curl-noise-3d mini there is no verdict" in verdict
    model_error = results.methods["neuralmpm"].scores[results.ranking].mean
    solver_error = results.methods["projection"].scores[results.ranking].mean
    ratio = model_error / solver_error
    assert ratio > 1.0
    sentence = f"{ratio:.3g} times the error of the cheapest solver (projection)"
    assert sentence in verdict


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
