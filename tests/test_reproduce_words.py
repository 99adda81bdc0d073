"""What reproduction scripts say: the thesis's numbers, sentences from scores, small mathematics."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from reproduce_bench import a_method, a_score

from lagbench.baselines.reproduce import statements, thesis, wording
from lagbench.baselines.reproduce.interpolation import cubic_vorticity, errors
from lagbench.baselines.reproduce.learning_curves import loss_over_steps, smoothed
from lagbench.baselines.reproduce.method import Method, Seeded
from lagbench.baselines.reproduce.scenes import stand_in
from lagbench.baselines.reproduce.table_4_8 import rollout_table
from lagbench.data.registry import load
from lagbench.metrics import METRICS, Score


def test_printed_parameters_follow_from_the_widths() -> None:
    """Every printed parameter count of Tables 4.2 to 4.5 is that of dense layers 10,000 -> ... -> 10,000."""
    for study in thesis.STUDIES:
        widths = (10_000, *study.widths, 10_000)
        assert study.parameters == sum(a * b + b for a, b in pairwise(widths)), study
    assert [study.table for study in thesis.STUDIES].count("4.3") == 6
    assert len(thesis.STUDIES) == 19


def test_printed_errors_agree_with_each_other() -> None:
    """In Table 5.4 RMSE is the root of MSE, and MAE is the smaller, as for any sample."""
    for row in thesis.TABLE_5_4.values():
        assert row.rmse == pytest.approx(math.sqrt(row.mse), rel=4e-3)
        assert row.mae < row.rmse


def test_the_two_tables_of_rollouts_swap_their_columns() -> None:
    """What Table 4.7 prints as average is what 4.8 prints as end, for MLP and LSTM + MLP."""
    row = next(row for row in thesis.TABLE_4_8 if row.scenario == 26)
    for name in ("mlp", "lstm-mlp"):
        assert thesis.TABLE_4_7.average[name] == row.end[name]
        assert thesis.TABLE_4_7.end[name] == row.average[name]


def test_a_pair_says_what_can_be_counted_by_hand() -> None:
    """Better by 0.1 in 8 of 8 scenarios: the exact test gives 2 / 2^8 = 0.0078."""
    first, second = a_score([0.1] * 8), a_score([0.2] * 8)
    text = wording.pair(first, second)
    assert text == "0.1 against 0.2, better in 8 of 8 scenarios, lead 0.1 (0.1 to 0.1), p = 0.0078"
    assert wording.told(first, second, ("A", "B")) == "A is better than B"
    assert wording.told(second, first, ("B", "A")) == "A is better than B"


def test_nothing_is_claimed_of_what_cannot_be_told() -> None:
    """Mixed signs, or fewer than six scenarios, give no verdict."""
    mixed = a_score([0.1, 0.3, 0.1, 0.3, 0.1, 0.3]), a_score([0.2] * 6)
    assert "cannot be told apart" in wording.told(*mixed, ("A", "B"))
    assert "nothing is claimed" in wording.told(a_score([0.1] * 5), a_score([0.9] * 5), ("A", "B"))


def test_higher_is_better_where_it_is() -> None:
    """For a correlation the larger value wins."""
    high, low = a_score([0.9] * 8, "vorticity_pearson"), a_score([0.5] * 8, "vorticity_pearson")
    assert wording.told(low, high, ("low", "high")) == "high is better than low"
    assert wording.wins(high, low) == (8, 8)


def six(**better: list[float]) -> dict[str, Method]:
    """Return six operators at 0.5 in eight scenarios, some replaced."""
    return {name: a_method(name, better.get(name, [0.5] * 8)) for name in thesis.OPERATORS}


def test_first_place_is_told_from_the_data() -> None:
    """SuperGAT first in the mean, and better than the second; then last of six."""
    said = " ".join(statements._first_of_six(six(supergat=[0.1] * 8, gns=[0.2] * 8), "vorticity_rmse"))
    assert "Yes in the mean: by `vorticity_rmse` over the horizon it is 1st of 6 operators." in said
    assert "SuperGAT is better than GNS" in said
    assert "Each of the others differs" in said
    said = " ".join(statements._first_of_six(six(supergat=[0.9] * 8), "vorticity_rmse"))
    assert "No: by `vorticity_rmse` over the horizon it is 6th of 6" in said
    assert "GAT is better than SuperGAT" in said
    assert "One training each" in said


def test_ties_with_the_leader_are_named() -> None:
    """A rival that wins in half of the scenarios shares the first place, in words."""
    models = six(supergat=[0.1] * 8, gns=[0.05, 0.16] * 4)
    said = " ".join(statements._first_of_six(models, "vorticity_rmse"))
    assert "Not told from the leader, SuperGAT, at 5 %: GNS." in said


def test_seeds_stand_beside_each_other() -> None:
    """The score of two seeds is their mean per scenario; the spread is the sample deviation of means."""
    method = a_method("gns", [1.0, 3.0], [3.0, 5.0])
    assert method.scores["vorticity_rmse"].values.tolist() == [2.0, 4.0]
    assert method.spread("vorticity_rmse") == pytest.approx(math.sqrt(2.0))  # of means 2 and 4
    assert math.isnan(a_method("gns", [1.0]).spread("vorticity_rmse"))
    assert method.at("vorticity_rmse", 54, 1) == 4.0
    said = list(statements._seeds_say({"gns": method}, "vorticity_rmse", ("gns",)))
    assert said == ["By seed: GNS 2 and 4."]


def test_an_undefined_seed_is_left_out() -> None:
    """A scenario without a value in one seed has that of the other."""
    method = a_method("gns", [1.0, math.nan], [3.0, 5.0])
    assert method.scores["vorticity_rmse"].values.tolist() == [2.0, 5.0]


@pytest.mark.parametrize(
    ("without", "answer", "verdict"),
    [(0.9, "Yes", "GNS is better than"), (0.1, "No, it harms", "loss is better than GNS")],
)
def test_the_vorticity_loss_is_judged_by_the_test(without: float, answer: str, verdict: str) -> None:
    """Weight 1 wins, or loses, in all of eight scenarios; the correlation's direction is the other way."""
    models = {
        "gns": a_method("gns", [0.5] * 8),
        "gns-novorticity": a_method("gns-novorticity", [without] * 8),
    }
    said = " ".join(statements._vorticity_loss(models, 54))
    assert said.startswith(f"**Does the vorticity loss help (Fig. 5.5)?** {answer}, at 5 %. GNS")
    assert said.split("`vorticity_pearson`")[0].count(verdict) == 1
    assert "p = 0.0078" in said


def test_link_loss_is_judged_by_equal_seeds_and_start() -> None:
    """A seed that only one of the two has does not count; the plain SuperGAT has another start."""
    models = {
        "supergat": a_method("supergat", [0.1] * 8),
        "supergat-link": a_method("supergat-link", [0.5] * 8, [99.0] * 8),
        "supergat-unlinked": a_method("supergat-unlinked", [0.9] * 8),
    }
    said = " ".join(statements._link_loss(models, "vorticity_rmse", 54))
    assert "**Does SuperGAT's link loss help?** Yes, at 5 %. With weight 1" in said
    assert "0.5 against 0.9, better in 8 of 8 scenarios" in said
    assert "0.1" not in said.split("`vorticity_pearson`")[0].split("lead")[0]


def test_absent_frame_models_are_named() -> None:
    """A first place among two of three is not said to be one among three."""
    models = {"mlp": a_method("mlp", [0.9] * 8), "lstm-mlp": a_method("lstm-mlp", [0.5] * 8)}
    said = " ".join(statements._frame_models(models, "mse_avg"))
    assert "Yes in the mean (LSTM missing)" in said


def test_floors_are_compared_one_by_one() -> None:
    """Better, worse and untold models are told apart."""
    models = {"gns": a_method("gns", [0.1] * 8), "gat": a_method("gat", [0.9] * 8)}
    floors = {"persistence": a_method("persistence", [0.5] * 8)}
    (said,) = statements._against_floors(models, floors, "vorticity_rmse")
    assert (
        said == "**Against the floor persistence** (0.5) by `vorticity_rmse`: better at 5 %: GNS; worse: GAT."
    )


def test_floors_that_no_model_beats_are_named() -> None:
    """Where standing still has the least error in the mean, the best model stands beside it."""
    models = {"gns": a_method("gns", [0.5] * 8), "gat": a_method("gat", [0.9] * 8)}
    floors = {"persistence": a_method("persistence", [0.1] * 8)}
    said = " ".join(statements._unbeaten(models, floors))
    assert "`vorticity_rmse` (persistence 0.1 against 0.5 of GNS)" in said
    floors = {"persistence": a_method("persistence", [0.6] * 8)}
    assert "`vorticity_rmse`" not in " ".join(statements._unbeaten(models, floors))


def test_scenes_stand_for_their_own_kind() -> None:
    """At full size ids are the thesis's; elsewhere family (id % 4) and pair (id % 6) are the same."""
    registry = load()
    for row in thesis.TABLE_4_8:
        split, families = ("fluid", 4) if row.scenario < 54 else ("multimaterial", 6)
        assert stand_in(registry.size(split, "full"), row.scenario) == row.scenario
        mini = stand_in(registry.size(split, "mini"), row.scenario)
        assert mini is not None
        assert mini % families == row.scenario % families


@pytest.mark.parametrize(("spin", "strain"), [(0.3, 0.0), (-0.2, 0.5)])
def test_interpolation_finds_the_vorticity_of_a_linear_flow(spin: float, strain: float) -> None:
    """U = (s x - w y, w x - s y) has vorticity 2 w everywhere inside the hull."""
    position = np.random.default_rng(1).random((400, 2))
    x, y = position.T
    velocity = np.stack([strain * x - spin * y, spin * x - strain * y], axis=-1)
    found = cubic_vorticity(position, velocity, ((0.2, 0.8), (0.1, 0.7)), cells=12)
    assert np.isfinite(found).all()
    assert found == pytest.approx(np.full((12, 12), 2 * spin), abs=1e-6)


def test_errors_of_interpolated_fields() -> None:
    """A field against itself is perfect; against twice itself the hand-worked values hold."""
    truth = np.array([[1.0, -2.0], [3.0, np.nan]])
    assert errors(truth, truth) == {
        "mae": 0.0,
        "mse": 0.0,
        "rmse": 0.0,
        "kl": 0.0,
        "pearson": pytest.approx(1.0),
    }
    twice = errors(truth, 2 * truth)
    # residuals 1, 2, 3; magnitudes in the same proportion, so that KL is 0
    assert twice["mae"] == pytest.approx(2.0)
    assert twice["mse"] == pytest.approx(14 / 3)
    assert twice["kl"] == pytest.approx(0.0, abs=1e-9)
    assert errors(truth, -truth)["pearson"] == pytest.approx(-1.0)
    assert math.isnan(errors(truth, np.zeros((2, 2)))["pearson"])


def test_losses_are_read_back_from_tensorboard(tmp_path: Path) -> None:
    """What was logged comes back in the order of steps; no log gives no curve."""
    writer = pytest.importorskip("torch.utils.tensorboard").SummaryWriter(str(tmp_path / "tensorboard"))
    for step in (10, 20, 30):
        writer.add_scalar("loss/total", 1.0 / step, step)
    writer.close()
    steps, loss = loss_over_steps(tmp_path)
    assert steps.tolist() == [10, 20, 30]
    assert loss == pytest.approx([0.1, 0.05, 1 / 30])
    assert loss_over_steps(tmp_path, "vorticity")[0].size == 0
    assert loss_over_steps(tmp_path / "none")[0].size == 0


def test_smoothing_is_a_centred_mean() -> None:
    """Each value is the mean of 12 before it to 12 after, fewer at both ends, by brute force; lines stay."""
    values = np.random.default_rng(2).random(60)
    reach = [min(12, i, 59 - i) for i in range(60)]
    assert smoothed(values) == pytest.approx([values[i - k : i + k + 1].mean() for i, k in enumerate(reach)])
    assert smoothed(np.arange(60.0)) == pytest.approx(np.arange(60.0))


def test_a_table_of_rollouts_puts_ours_beside_theirs() -> None:
    """Cells are ours / the thesis's, of the scenario that stands for the thesis's."""
    size = load().size("fluid", "full")
    ids = tuple(sorted(size.subsets["test"]))
    values = np.arange(len(ids), dtype=float)
    none = np.empty((len(ids), 0))
    metrics = ("mse_avg", "mse_end")
    scores = {m: Score(METRICS[m], ids, (), none, values, (0,) * len(ids)) for m in metrics}
    held = Method(name="mlp", seeds=(Seeded(seed=0, scores=scores, record={}, path=Path()),))
    table = rollout_table(SimpleNamespace(size=size, methods={"mlp": held}))
    circle = dict(zip(table.columns, table.rows[1], strict=True))
    assert circle["thesis's id"] == circle["our id"] == "26"
    assert circle["average, MLP"] == f"{ids.index(26)} / 2.127"
    assert circle["average, LSTM"] == "- / 3.583"
