"""What the scores say of the thesis's claims, as sentences formed from the data.

Every comparison is the exact sign-flip test over test scenarios, two-sided, in the metric's loss;
p-values are not corrected for their number. Scenarios are the sample: with one training per
model a difference is one between two trainings, which another seed may turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lagbench.metrics import Score, compare
from lagbench.scoring.task import ranking_metric

from .evidence import Evidence
from .method import Method
from .roster import label
from .spending import budget
from .thesis import FRAME_MODELS, OPERATORS, TABLE_5_4
from .wording import agreement, listed, number, ordinal, pair, told

__all__ = ["key_frame", "statements"]

KEY_FRAMES = {"cavity": 54, "curl-noise": 40}
"""Frames at which the thesis compares models: 54; and 35 after the last of six given ones."""

OURS, PLAIN, WITHOUT = "supergat", "gns", "gns-novorticity"
LINK, UNLINKED = "supergat-link", "supergat-unlinked"

DIVERGED = 10.0
"""A rollout whose last error is that many times that of standing still has diverged."""

STILL = "persistence"

TELLING = (
    *("vorticity_rmse", "mse_avg", "mse_end", "position_rmse", "velocity_rmse", "energy_error"),
    *("density_rmse", "shape_error", "connectivity", "sliced_w2"),
)
"""Metrics by which a floor is held against the models."""


def key_frame(evidence: Evidence) -> int:
    """Return the frame of interest nearest to the one at which the thesis compares models."""
    task = evidence.size.task
    wanted = KEY_FRAMES.get(evidence.size.split, task.frames_of_interest[0])
    return min(task.frames_of_interest, key=lambda frame: (abs(frame - wanted), frame))


def statements(evidence: Evidence) -> Iterator[str]:
    """Yield what the scores of one split and size say, one sentence or a few per claim."""
    ranking = ranking_metric(evidence.size)
    models = {name: m for name, m in evidence.models().items() if ranking in m.scores}
    yield from _first_of_six(models, ranking)
    frame = key_frame(evidence)
    if ranking == "vorticity_rmse":
        if evidence.size.split == "cavity":
            yield from _first_at_frame(models, frame)
        yield from _link_loss(models, ranking, frame)
        yield from _vorticity_loss(models, frame)
    else:
        yield from _frame_models(models, ranking)
    yield from _against_floors(models, evidence.floors(), ranking)
    yield from _unbeaten(models, evidence.floors())
    yield from _diverging(models, evidence.floors())


def ordered(scores: Mapping[str, Score]) -> list[str]:
    """Return names from the least mean loss to the greatest; undefined ones last."""

    def loss(name: str) -> float:
        value = scores[name].mean
        return math.inf if math.isnan(value) else scores[name].metric.loss(value)

    return sorted(scores, key=lambda name: (loss(name), name))


def _first_of_six(models: Mapping[str, Method], metric: str) -> Iterator[str]:
    six = {name: models[name].scores[metric] for name in OPERATORS if name in models}
    if OURS not in six or len(six) < 2:
        return
    order = ordered(six)
    complete = "" if len(six) == len(OPERATORS) else f" (of {len(OPERATORS)}; the others are missing)"
    answer = "Yes in the mean" if order[0] == OURS else "No"
    spent = _spent([models[name] for name in order])
    after = f", after {spent[0]} steps x windows" if len(spent) == 1 else ""
    yield (
        f"**Does SuperGAT come first (Table 5.4: on the cavity it does)?** {answer}{after}: by `{metric}`"
        f" over the horizon it is {ordinal(order.index(OURS) + 1)} of {len(six)} operators{complete}."
        f" From best to worst: {listed(f'{label(n)} {number(six[n].mean)}' for n in order)}."
    )
    rival = order[1] if order[0] == OURS else order[0]
    yield f"SuperGAT against {label(rival)}: {pair(six[OURS], six[rival])}: {_verdict(six, OURS, rival)}."
    yield from _tied_with(six, order)
    yield from _budgets([models[name] for name in order])
    yield from _seeds_say(models, metric, (OURS, rival))


def _verdict(scores: Mapping[str, Score], first: str, second: str) -> str:
    return told(scores[first], scores[second], (label(first), label(second)))


def _tied_with(scores: Mapping[str, Score], order: Sequence[str]) -> Iterator[str]:
    leader = order[0]
    tied = [n for n in order[1:] if not compare(scores[n], scores[leader]).significant]
    if tied:
        yield f"Not told from the leader, {label(leader)}, at 5 %: {listed(map(label, tied))}."
    else:
        yield f"Each of the others differs from the leader, {label(leader)}, at 5 %."


def _budgets(methods: Sequence[Method]) -> Iterator[str]:
    """Say whether the budgets were equal, and whose validation still improved at the end."""
    records, spent = _records(methods), _spent(methods)
    if len(spent) == 1:
        yield f"Equal budgets, steps x windows: {spent[0]} each; parameters differ (table below)."
    elif spent:
        yield f"Budgets differ: {listed(f'{label(name)} {budget(record)}' for name, record in records)}."
    rising = dict.fromkeys(name for name, record in records if record.get("best_step") == record["step"])
    if rising:
        yield f"Still improving in validation at the last step: {listed(map(label, rising))}."


def _records(methods: Sequence[Method]) -> list[tuple[str, Mapping[str, Any]]]:
    return [(held.name, seed.record) for held in methods for seed in held.seeds if "windows" in seed.record]


def _spent(methods: Sequence[Method]) -> list[str]:
    """Return the different budgets of some models."""
    return list(dict.fromkeys(budget(record) for _, record in _records(methods)))


def _seeds_say(models: Mapping[str, Method], metric: str, names: Sequence[str]) -> Iterator[str]:
    seeds = {name: models[name] for name in names}
    several = {name: m for name, m in seeds.items() if len(m.seeds) > 1}
    if not several:
        yield "One training each: another seed may turn this."
        return
    parts = [
        f"{label(name)} {listed(number(held.scores[metric].mean) for held in method.seeds)}"
        for name, method in seeds.items()
    ]
    yield f"By seed: {'; '.join(parts)}."


def _first_at_frame(models: Mapping[str, Method], frame: int) -> Iterator[str]:
    found = {name: models[name] for name in OPERATORS if name in models}
    if OURS not in found or len(found) < 2:
        return
    places = []
    for metric in ("vorticity_mae", "vorticity_mse", "vorticity_kl", "vorticity_pearson"):
        order = ordered({name: m.frozen_at(metric, frame) for name, m in found.items()})
        places.append(f"{ordinal(order.index(OURS) + 1)} by `{metric}` ({label(order[0])} leads)")
    yield (
        f"At frame {frame}, where the thesis has it first in every measure (of one scenario), SuperGAT"
        f" is, in the mean over scenarios, {listed(places)}, of {len(found)}."
    )
    theirs = sorted(found, key=lambda name: TABLE_5_4[name].mse)
    ours = ordered({name: m.frozen_at("vorticity_mse", frame) for name, m in found.items()})
    yield (
        f"Orders by `vorticity_mse` there: the thesis's {listed(map(label, theirs))}; ours"
        f" {listed(map(label, ours))}; Kendall's tau {number(agreement(theirs, ours), 2)} (1: the same order,"
        " -1: reversed)."
    )


def _link_loss(models: Mapping[str, Method], metric: str, frame: int) -> Iterator[str]:
    two = _same_seeds(models, LINK, UNLINKED)
    if two:
        over = {name: method.scores[metric] for name, method in two.items()}
        at = {name: method.frozen_at("vorticity_pearson", frame) for name, method in two.items()}
        yield (
            f"**Does SuperGAT's link loss help?** {_helps(over[LINK], over[UNLINKED])}. With weight 1"
            " against weight 0, the same start and seeds,"
            f" `{metric}`: {pair(over[LINK], over[UNLINKED])}: {_verdict(over, LINK, UNLINKED)}."
            f" `vorticity_pearson` at frame {frame}: {pair(at[LINK], at[UNLINKED])}:"
            f" {_verdict(at, LINK, UNLINKED)}."
        )
    six = {name: models[name].scores[metric] for name in (*OPERATORS, LINK) if name in models}
    six.pop(OURS, None)
    if LINK in six and len(six) > 1:
        order = ordered(six)
        place = ordinal(order.index(LINK) + 1)
        yield f"With its link loss in place of the plain one SuperGAT is {place} of {len(six)} operators."


def _helps(score: Score, without: Score) -> str:
    """Return whether what one has and the other lacks helps, as far as scenarios can tell."""
    found = compare(score, without)
    if not found.significant:
        return "Not decided at 5 %"
    return "Yes, at 5 %" if found.difference < 0.0 else "No, it harms, at 5 %"


def _same_seeds(models: Mapping[str, Method], first: str, second: str) -> dict[str, Method]:
    """Return two models with the seeds that both have; nothing where there are none."""
    if not {first, second} <= models.keys():
        return {}
    common = {held.seed for held in models[first].seeds} & {held.seed for held in models[second].seeds}
    return {name: models[name].of_seeds(common) for name in (first, second)} if common else {}


def _vorticity_loss(models: Mapping[str, Method], frame: int) -> Iterator[str]:
    two = _same_seeds(models, PLAIN, WITHOUT)
    if not two:
        return
    judged = {name: method.scores["vorticity_rmse"] for name, method in two.items()}
    parts = []
    for metric, where in (
        ("vorticity_rmse", None),
        ("vorticity_pearson", frame),
        ("position_rmse", None),
        ("energy_error", None),
    ):
        scores = {
            name: method.scores[metric] if where is None else method.frozen_at(metric, where)
            for name, method in two.items()
        }
        text = f"`{metric}`" if where is None else f"`{metric}` at frame {where}"
        parts.append(f"{text} {pair(scores[PLAIN], scores[WITHOUT])}: {_verdict(scores, PLAIN, WITHOUT)}")
    yield (
        f"**Does the vorticity loss help (Fig. 5.5)?** {_helps(judged[PLAIN], judged[WITHOUT])}. GNS with"
        " weight 1 against the same with weight 0,"
        f" equal budget and seeds: {'; '.join(parts)}."
    )
    yield from _seeds_say(two, "vorticity_rmse", (PLAIN, WITHOUT))


def _frame_models(models: Mapping[str, Method], metric: str) -> Iterator[str]:
    found = {name: models[name].scores[metric] for name in FRAME_MODELS if name in models}
    if "lstm-mlp" not in found or len(found) < 2:
        return
    order = ordered(found)
    answer = "Yes in the mean" if order[0] == "lstm-mlp" else "No"
    absent = [label(name) for name in FRAME_MODELS if name not in found]
    complete = f" ({listed(absent)} missing)" if absent else ""
    yield (
        f"**Does LSTM + MLP come first (Table 4.8)?** {answer}{complete}: by `{metric}`, from best to worst,"
        f" {listed(f'{label(n)} {number(found[n].mean)}' for n in order)}."
    )
    for rival in [name for name in order if name != "lstm-mlp"]:
        text = pair(found["lstm-mlp"], found[rival])
        yield f"LSTM + MLP against {label(rival)}: {text}: {_verdict(found, 'lstm-mlp', rival)}."
    yield from _seeds_say(models, metric, order)


def _against_floors(models: Mapping[str, Method], floors: Mapping[str, Method], metric: str) -> Iterator[str]:
    for name, floor in floors.items():
        scores = {n: m.scores[metric] for n, m in models.items()}
        better = [n for n in ordered(scores) if _differs(scores[n], floor.scores[metric], -1)]
        worse = [n for n in ordered(scores) if _differs(scores[n], floor.scores[metric], 1)]
        if not scores:
            continue
        parts = [f"better at 5 %: {listed(map(label, better)) if better else 'none'}"]
        parts += [f"worse: {listed(map(label, worse))}"] if worse else []
        mean = number(floor.scores[metric].mean)
        yield f"**Against the floor {name}** ({mean}) by `{metric}`: {'; '.join(parts)}."


def _unbeaten(models: Mapping[str, Method], floors: Mapping[str, Method]) -> Iterator[str]:
    """Name the metrics of the table in which a floor's mean is better than every model's."""
    if not models:
        return
    parts = []
    for metric in TELLING:
        held = {n: m.scores[metric] for n, m in {**models, **floors}.items() if metric in m.scores}
        defined = [name for name in ordered(held) if not math.isnan(held[name].mean)]
        if defined and defined[0] in floors:
            best = next((name for name in defined if name in models), None)
            rival = f" against {number(held[best].mean)} of {label(best)}" if best else ""
            parts.append(f"`{metric}` ({defined[0]} {number(held[defined[0]].mean)}{rival})")
    if parts:
        yield f"**Where a floor is better than every model, in the mean**: {listed(parts)}."


def _differs(score: Score, floor: Score, sign: int) -> bool:
    found = compare(score, floor)
    return found.significant and sign * found.difference > 0.0


def _diverging(models: Mapping[str, Method], floors: Mapping[str, Method]) -> Iterator[str]:
    if "var" not in models or STILL not in floors:
        return
    found, still = (held.scores["mse_end"].mean for held in (models["var"], floors[STILL]))
    answer = "Yes" if found > DIVERGED * still else "No"
    yield (
        f"**Does VAR(1) diverge (section 4.8.3)?** {answer}: its error at the last frame is {number(found)}"
        f" standardised units squared in the mean over scenarios, {number(found / still)} times that of"
        " standing still (the thesis: 3.5e18, by its own protocol)."
    )
