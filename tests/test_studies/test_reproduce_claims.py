"""Claims from scores, the thesis's numbers, and the small mathematics of
reproduction.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from reproduce_bench import a_method, made_up_results
from scipy.stats import kendalltau

from lagbench.data.registry import load
from lagbench.metrics import METRICS, Score
from lagbench.references.shipped import FOLDER
from lagbench.references.table import NAIVE
from lagbench.scoring.score_file import read_statistics
from studies.result_tables import kendall_tau
from studies.thesis import published as thesis
from studies.thesis.cases import scenario_of
from studies.thesis.claims import (
    CLAIMS,
    Claim,
    ComparedModels,
    Verdict,
    answer,
    claim_rows,
    compare_models,
    leading_references,
)
from studies.thesis.drawing import SMOOTHED, smooth
from studies.thesis.split_results import Method, ScoredTraining, Sources, SplitResults
from studies.thesis.tables import (
    cubic_errors,
    cubic_vorticity,
    rollout_table,
)

FIRST = Claim(
    question="",
    first="supergat",
    rivals=thesis.OPERATORS[1:],
)


def equal(score: float, count: int = 8) -> list[float]:
    """Return the scores of a model that is as good in each of eight scenarios."""
    return [score] * count


EQUAL = equal(0.5)


def six(**better: list[float]) -> SplitResults:
    """Return six operators at 0.5 in eight scenarios, some replaced."""
    values = dict.fromkeys(thesis.OPERATORS, EQUAL)
    return made_up_results(values | better)


def two_models(*, gns: list[float], gat: list[float]) -> SplitResults:
    """Return the results of two models with these scores."""
    return made_up_results({"gns": gns, "gat": gat})


def compare_errors(results: SplitResults, first: str, second: str) -> ComparedModels:
    """Return the comparison of two models by the error of their positions."""
    metrics = ["position_rmse"]
    (row,) = compare_models(results, first, [second], metrics)
    return row


def test_a_comparison_can_be_counted_by_hand() -> None:
    """Better by 0.1 in 8 of 8 scenarios: the exact test gives 2 / 2^8, whichever comes
    first.
    """
    results = two_models(gns=equal(0.1), gat=equal(0.2))
    row = compare_errors(results, "gns", "gat")
    first_mean, second_mean = row.means
    assert first_mean == pytest.approx(0.1)
    assert second_mean == pytest.approx(0.2)
    assert row.win_count == 8
    assert row.seed_counts == (1, 1)
    assert row.p == 2 / 2**8
    assert row.test.p == row.p
    assert row.verdict is Verdict.BETTER
    turned = compare_errors(results, "gat", "gns")
    assert turned.verdict is Verdict.WORSE
    assert turned.win_count == 0
    assert turned.p == row.p


def test_directions_come_from_the_metrics_table() -> None:
    """A higher correlation is better; the values of one frame may be compared."""
    results = two_models(gns=equal(0.9), gat=EQUAL)
    metrics = ["vorticity_pearson"]
    (row,) = compare_models(results, "gns", ["gat"], metrics, frame=54)
    assert row.verdict is Verdict.BETTER
    assert row.win_count == 8
    assert row.frame == 54


def test_an_undecided_comparison_claims_nothing() -> None:
    """Mixed signs leave a question open; fewer than six scenarios give no p-value at
    all.
    """
    results = two_models(gns=[0.1, 0.3] * 4, gat=equal(0.2))
    mixed = compare_errors(results, "gns", "gat")
    assert mixed.verdict is Verdict.OPEN

    results = two_models(gns=equal(0.1, 5), gat=equal(0.9, 5))
    few = compare_errors(results, "gns", "gat")
    assert few.verdict is Verdict.FEW
    assert math.isnan(few.p)


def test_first_place_takes_all_rivals() -> None:
    """Better than all five after correction (5 x 2 / 2^8 < 5 %): yes; a tie or a loss:
    counted.
    """
    rows = claim_rows(FIRST, six(supergat=equal(0.1)))
    rivals = {row.second for row in rows}
    assert rivals == set(FIRST.rivals)
    for row in rows:
        assert row.p == 5 * 2 / 2**8
    assert answer(rows) == "yes (these weights)"

    as_good_in_half = [0.05, 0.16] * 4
    results = six(supergat=equal(0.1), gns=as_good_in_half)
    tied = claim_rows(FIRST, results)
    open_rivals = [row.second for row in tied if row.verdict is Verdict.OPEN]
    assert open_rivals == ["gns"]
    counts = "better than 4, worse than 0, open: 1"
    assert answer(tied) == f"{counts} (these weights)"

    last = claim_rows(FIRST, six(supergat=equal(0.9)))
    for row in last:
        assert row.verdict is Verdict.WORSE


@pytest.mark.parametrize(
    ("without", "expected"),
    [
        (0.9, "yes (these weights)"),
        (0.1, "no (these weights)"),
        (0.5, "open (these weights)"),
    ],
)
def test_a_loss_is_judged_by_the_model_without_it(
    without: float, expected: str
) -> None:
    """The claim on the vorticity loss compares GNS with its ablation, by the ranking
    metric first.
    """
    ablation = "gns-novorticity"
    claims = {claim.rivals: claim for claim in CLAIMS}
    claim = claims[(ablation,)]
    results = made_up_results({"gns": EQUAL, ablation: equal(without)})
    rows = claim_rows(claim, results)
    assert answer(rows) == expected
    assert rows[0].metric == results.ranking
    assert {row.metric for row in rows} == {
        results.ranking,
        *claim.metrics,
        *claim.at_key_frame,
    }


def test_three_trainings_on_both_sides_speak_for_the_methods() -> None:
    """A reference predictor and a closed form need no second training."""
    results = made_up_results({"var": equal(0.8), "persistence": equal(0.9)})
    three_seeds = (equal(0.1), equal(0.11), equal(0.12))
    results.methods["gns"] = a_method("gns", *three_seeds)
    results.methods["gat"] = a_method("gat", *(equal(0.5) for _ in range(3)))
    results.methods["mlp"] = a_method("mlp", equal(0.5), equal(0.5))
    for rival in ("gat", "var", "persistence"):
        rows = compare_models(results, "gns", [rival], [results.ranking])
        assert answer(rows) == "yes", rival
    rows = compare_models(results, "gns", ["mlp"], [results.ranking])
    assert answer(rows) == "yes (these weights)"


def test_a_network_that_passes_its_gates_stands_for_its_operator() -> None:
    results = six(supergat=equal(0.9))
    pushforward = a_method("supergat-pushforward", equal(0.1))
    results.methods["supergat-pushforward"] = pushforward
    rows = claim_rows(FIRST, results)
    assert {row.first for row in rows} == {"supergat-pushforward"}
    assert {row.second for row in rows} == set(FIRST.rivals)
    assert answer(rows) == "yes (these weights)"


def test_models_that_fail_a_gate_take_no_part() -> None:
    """Neither first nor as rivals; the answer says how many rivals were compared."""
    results = six(supergat=equal(0.1))
    results.under_trained = {"gat", "gns"}
    rows = claim_rows(FIRST, results)
    assert {row.second for row in rows} == {"pointnet", "gatv2", "transformer"}
    answered = answer(rows, len(FIRST.rivals))
    assert answered == "yes; 3 of 5 compared (these weights)"
    results.under_trained = {"supergat"}
    assert claim_rows(FIRST, results) == []


def test_an_ablation_is_compared_by_its_own_recipe() -> None:
    """The variant with pushforward stands in for an operator among operators only."""
    ablation = "gns-novorticity"
    claims = {claim.rivals: claim for claim in CLAIMS}
    results = made_up_results({"gns": EQUAL, ablation: equal(0.9)})
    results.methods["gns-pushforward"] = a_method("gns-pushforward", equal(0.1))
    rows = claim_rows(claims[(ablation,)], results)
    assert {row.first for row in rows} == {"gns"}


@pytest.mark.parametrize("variant", ["gns-tenfold", "gns-unrolled"])
def test_a_variant_is_compared_with_the_plain_operator(variant: str) -> None:
    """Another recipe in place of the only rival would answer another question."""
    (claim,) = (claim for claim in CLAIMS if claim.first == variant)
    results = made_up_results({"gns": EQUAL, variant: equal(0.9)})
    results.methods["gns-pushforward"] = a_method("gns-pushforward", equal(0.1))
    rows = claim_rows(claim, results)
    assert {row.second for row in rows} == {"gns"}


def test_seeds_that_only_one_has_do_not_count() -> None:
    """Two models are compared over common seeds; where there are none, over all."""
    results = made_up_results({})
    results.methods["gns"] = a_method("gns", EQUAL, equal(99.0))
    results.methods["gat"] = a_method("gat", equal(0.9))
    row = compare_errors(results, "gns", "gat")
    first_mean, second_mean = row.means
    assert first_mean == pytest.approx(0.5)
    assert second_mean == pytest.approx(0.9)

    (only,) = results.methods["gat"].trainings
    other_seed = replace(only, seed=7)
    results.methods["gat"] = Method(name="gat", trainings=(other_seed,))
    row = compare_errors(results, "gns", "gat")
    assert row.seed_counts == (2, 1)


def test_skill_is_measured_from_the_best_naive_baseline() -> None:
    """Skill is 1 - score / score of the naive baseline of least error."""
    results = made_up_results(
        {
            "gns": equal(0.1),
            "gat": equal(0.9),
            "persistence": equal(0.5),
            "constant-velocity": equal(2.0),
        }
    )
    assert results.best_naive == "persistence"
    assert results.skill("gns") == pytest.approx(0.8)
    assert results.skill("gat") == pytest.approx(-0.8)
    assert results.skill("persistence") == 0.0
    best_naive_first = Claim(question="", first="")
    rows = claim_rows(best_naive_first, results)
    verdicts = {row.second: row.verdict for row in rows}
    assert verdicts == {
        "gns": Verdict.WORSE,
        "gat": Verdict.BETTER,
    }
    del results.methods["gns"]
    ahead = leading_references([results])
    metrics = {row[1] for row in ahead.rows}
    leaders = {row[2] for row in ahead.rows}
    assert results.ranking in metrics
    assert leaders <= set(results.references)
    tied = made_up_results({"gns": EQUAL, "constant-velocity": EQUAL})
    assert leading_references([tied]).rows == ()


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.question[:30])
def test_every_claim_asks_what_can_be_answered(claim: Claim) -> None:
    """Its metrics are of the table; where nobody has an entry there are no rows, and no
    answer.
    """
    for metric in (*claim.metrics, *claim.at_key_frame):
        assert metric in METRICS
    for models in ({}, {"gns-short": EQUAL}):
        rows = claim_rows(claim, made_up_results(models))
        assert rows == []
        assert answer(rows) == ""


def test_seeds_become_a_mean_per_scenario() -> None:
    """The score of two seeds is their mean per scenario; the spread is the sample
    deviation of means.
    """
    method = a_method("gns", [1.0, 3.0], [3.0, 5.0])
    score = method.scores["position_rmse"]
    assert score.values.tolist() == [2.0, 4.0]
    # the means are 2 and 4
    spread = method.spread("position_rmse")
    assert spread == pytest.approx(math.sqrt(2.0))
    assert method.at("position_rmse", 54, 1) == 4.0
    assert math.isnan(method.at("no_metric", 54))
    one_seed = a_method("gns", [1.0])
    assert math.isnan(one_seed.spread("position_rmse"))
    partly = a_method("gns", [1.0, math.nan], [3.0, 5.0])
    partial_score = partly.scores["position_rmse"]
    assert partial_score.values.tolist() == [2.0, 5.0]


def test_orders_agree_as_scipy_says() -> None:
    """Kendall's tau of random rankings without ties."""
    draw = np.random.default_rng(1)
    for count in (2, 3, 6):
        one, two = draw.random((2, count))
        expected = kendalltau(one, two).statistic
        assert kendall_tau(one, two) == pytest.approx(expected)


def test_printed_parameters_follow_from_the_widths() -> None:
    """Every printed parameter count of Tables 4.2 to 4.5 is that of dense layers 10,000
    -> ... -> 10,000.
    """
    for study in thesis.MLP_STUDIES:
        widths = (10_000, *study.widths, 10_000)
        parameter_count = 0
        for inputs, outputs in pairwise(widths):
            parameter_count += (inputs + 1) * outputs
        assert study.parameters == parameter_count, study
    tables = [study.table for study in thesis.MLP_STUDIES]
    assert tables.count("4.3") == 6
    assert len(thesis.MLP_STUDIES) == 19


def test_printed_errors_agree_with_each_other() -> None:
    """In Table 5.4 RMSE is the root of MSE, MAE the smaller; Table 4.7 swaps columns of
    4.8.
    """
    for row in thesis.TABLE_5_4.values():
        root = math.sqrt(row["mse"])
        assert row["rmse"] == pytest.approx(root, rel=4e-3)
        assert row["mae"] < row["rmse"]
    swapped = thesis.TABLE_4_7
    rows = {row.scenario: row for row in thesis.TABLE_4_8["fluid"]}
    right = rows[swapped.scenario]
    for name in ("mlp", "lstm-mlp"):
        i = thesis.FRAME_MODELS.index(name)
        assert right.average[i] == swapped.end[i]
        assert right.end[i] == swapped.average[i]


def test_scenes_stand_for_their_own_kind() -> None:
    """Family (id % 4) or pair (id % 6) is the thesis's; T0 is the first."""
    registry = load()
    for split, scene_count in (("fluid", 4), ("multimaterial", 6)):
        for name in ("full", "mini"):
            size = registry.size(split, name)
            for row in thesis.TABLE_4_8[split]:
                scenario = scenario_of(size, row.scenario)
                assert scenario in size.subsets["test"]
                assert scenario is not None
                assert scenario % scene_count == row.scenario % scene_count
    cavity = registry.size("cavity", "mini")
    first_test_scenario = min(cavity.subsets["test"])
    assert scenario_of(cavity, 0) == first_test_scenario
    assert scenario_of(cavity, 1000) is None


@pytest.mark.parametrize(
    ("spin", "strain"),
    [
        (0.3, 0.0),
        (-0.2, 0.5),
    ],
)
def test_interpolation_finds_the_vorticity_of_a_linear_flow(
    spin: float, strain: float
) -> None:
    """U = (s x - w y, w x - s y) has vorticity 2 w everywhere inside the hull."""
    rng = np.random.default_rng(1)
    position = rng.random((200, 2))
    x, y = position.T
    u = strain * x - spin * y
    v = spin * x - strain * y
    velocity = np.stack([u, v], axis=-1)
    bounds = ((0.3, 0.7), (0.2, 0.6))
    vorticity = cubic_vorticity(position, velocity, bounds, cells=8)
    assert vorticity.shape == (8, 8)
    assert_allclose(vorticity, 2 * spin, rtol=0, atol=1e-5)


def test_errors_of_interpolated_fields() -> None:
    """A field against itself is perfect; against twice itself the hand-worked values
    hold.
    """
    truth = np.array([[1.0, -2.0], [3.0, np.nan]])
    perfect = {
        "mae": 0.0,
        "mse": 0.0,
        "rmse": 0.0,
        "kl": 0.0,
        "pearson": pytest.approx(1.0),
    }
    assert cubic_errors(truth, truth) == perfect
    twice = cubic_errors(truth, 2 * truth)
    # residuals 1, 2, 3; magnitudes in the same proportion, so that KL is 0
    assert twice["mae"] == pytest.approx(2.0)
    assert twice["mse"] == pytest.approx(14 / 3)
    assert twice["kl"] == pytest.approx(0.0, abs=1e-9)
    reversed_errors = cubic_errors(truth, -truth)
    assert reversed_errors["pearson"] == pytest.approx(-1.0)
    at_rest = np.zeros((2, 2))
    errors_of_rest = cubic_errors(truth, at_rest)
    assert math.isnan(errors_of_rest["pearson"])


def test_smoothing_is_a_centred_mean() -> None:
    """Each value is the mean of as many before it as after, fewer at both ends; lines
    stay lines.
    """
    rng = np.random.default_rng(2)
    values = rng.random(60)
    means = []
    for i in range(60):
        reach = min(SMOOTHED // 2, i, 59 - i)
        window = values[i - reach : i + reach + 1]
        means.append(window.mean())
    assert smooth(values) == pytest.approx(means)
    line = np.arange(60.0)
    assert smooth(line) == pytest.approx(line)


def test_a_table_of_rollouts_puts_ours_beside_theirs() -> None:
    """Cells are ours / the thesis's, of the scenario that stands for the thesis's."""
    results = SplitResults(Sources(board=None), "fluid", "full")
    ids = tuple(sorted(results.size.subsets["test"]))
    count = len(ids)
    values = np.arange(float(count))
    no_frames = np.empty((count, 0))
    undefined = (0,) * count
    scores = {}
    for name in ("mse_avg", "mse_end"):
        metric = METRICS[name]
        scores[name] = Score(metric, ids, (), no_frames, values, undefined)
    seed = ScoredTraining(seed=0, scores=scores, record={}, path=Path())
    results.methods["mlp"] = Method(name="mlp", trainings=(seed,))
    table = rollout_table(results, thesis.TABLE_4_8["fluid"])
    row = table.rows[1]
    circle = dict(zip(table.columns, row, strict=True))
    assert circle["thesis's id"] == "26"
    assert circle["id of our scenario"] == "38"
    assert circle["average, MLP"] == f"{ids.index(38)} / 2.127"
    assert circle["average, LSTM"] == "- / 3.583"


@pytest.mark.parametrize("split", ["curl-noise", "fluid"])
def test_skill_is_that_of_the_shipped_naive_scores(split: str) -> None:
    """Worked from the shipped JSON file and the committed score files alone."""
    path = FOLDER / f"{split}-mini.json"
    content = json.loads(path.read_text())
    board = Path(__file__).parents[2] / "leaderboard"
    results = SplitResults(Sources(board=board), split, "mini")
    assert results.models
    naive_means = []
    floors = content["floors"]
    for name in NAIVE.intersection(floors):
        values = floors[name]["values"][results.ranking]
        naive_means.append(np.mean(values))
    for name, method in results.models.items():
        seed_means = []
        for training in method.trainings:
            scores = read_statistics(training.path).scores()
            seed_means.append(scores[results.ranking].mean)
        mean = np.mean(seed_means)
        expected = 1.0 - mean / min(naive_means)
        assert results.skill(name) == pytest.approx(expected, abs=1e-4)
