"""Trainings that start from weights: what they go on from, what they cost, what is
refused.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import torch
from simple_models import Drift, trainer

from lagbench.baselines.baseline import DatasetInfo
from lagbench.baselines.checkpoint import Checkpoint, load, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.predict import predict
from lagbench.baselines.provenance import training_provenance
from lagbench.baselines.train import TrainingResult
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.make.generate import GenerationResult
from lagbench.submission.budget import Budget, track_of
from lagbench.work.progress import Progress

Run = Callable[..., TrainingResult]
Changes = dict[str, Any] | None
STILL = ("steps=1", "learning_rate=1e-30")
"""One step that changes no weight by as much as its rounding."""


class AnySize(Drift):
    """A Drift in the units of its statistics, of any size; ``unit`` says what its
    weight means.

    ``share`` has no weights: that of weights to start from is kept.
    """

    any_size = True

    class Options(Drift.Options):
        """See above."""

        of_weights = frozenset({"unit"})
        unit: float = 1.0
        share: float = 1.0

    def __init__(self, options: Any, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.speed = info.statistics["velocity_std"][0]

    def advance(self, state: Any) -> Any:
        """Drift by a share of what is usual."""
        state, position = super().advance(state)
        return state, position + self.options.share * self.speed * self.a


@pytest.fixture
def run(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Run:
    """Train on tiny curl-noise data."""
    return trainer(
        generated.root,
        unmeasured,
        tmp_path,
        monkeypatch,
        drift=Drift,
        any=AnySize,
    )


@pytest.fixture
def stored(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
) -> Callable[..., Path]:
    """Store weights of a made-up training; ``info`` change those of the data."""

    def call(
        baseline: str = "any",
        *,
        info: Changes = None,
        model: Changes = None,
        weights: Changes = None,
        **more: Any,
    ) -> Path:
        here = read_dataset_info(
            "curl-noise", "tiny", root=generated.root, registry=unmeasured
        )
        built = AnySize.build({"start": 0.5, **(model or {})}, here)
        checkpoint = Checkpoint(
            baseline=baseline,
            options=built.options.model_dump(),
            info=replace(here, **(info or {})),
            weights=weights or built.state_dict(),
            training={"step": 9, "recipe": {"name": "curl-noise/mini-made-up"}, **more},
        )
        save(tmp_path / "start.pt", checkpoint)
        return tmp_path / "start.pt"

    return call


@pytest.mark.parametrize("size", ["tiny", "mini"])
def test_it_goes_on_where_the_weights_are(
    run: Run,
    stored: Callable[..., Path],
    generated: GenerationResult,
    unmeasured: Registry,
    size: str,
) -> None:
    """A step that changes nothing predicts what the weights do, also in units of
    another size.
    """
    units = dict.fromkeys(
        ("velocity_std", "acceleration_std", "position_std"), (1e-3, 1e-3)
    )
    other = {
        "size": "mini",
        "dataset_sha256": "0" * 64,
        "statistics": units,
        "radius": 0.5,
    }
    start = stored(info=other if size == "mini" else None, model={"share": 0.5})
    result = run("any", *STILL, start=start)  # the recipe's share is another
    options: dict[str, Any] = {
        "root": generated.root,
        "registry": unmeasured,
        "threads": 1,
        "size": "tiny",
    }
    found = []
    for weights in (start, result.weights):
        with netCDF4.Dataset(
            predict(weights, result.folder / "made.nc", **options).path
        ) as data:
            found.append(np.asarray(data["position"][:]))
    assert np.array_equal(*found)


def test_it_learns_from_there(run: Run) -> None:
    """A training from its own end begins at the loss that it ended with; random weights
    do not.
    """
    first = run("gns", "steps=30", "validate_every=0", to="first")
    further, anew = (
        run("gns", "steps=1", "validate_every=0", start=start, to=to)
        for start, to in ((first.weights, "further"), (None, "anew"))
    )
    assert further.loss["total"] < 0.95 * anew.loss["total"]


def test_nothing_worse_takes_their_place(run: Run, stored: Callable[..., Path]) -> None:
    """Where every step leads away, the best weights are those that it started from.

    What fails early can be tried again: a checkpoint lies beside the weights that were
    validated first.
    """
    start = stored()
    result = run(
        "any", "steps=4", "learning_rate=100.0", "validate_every=2", start=start
    )
    assert result.best_step == 0
    assert float(load(result.weights).weights["a"]) == 0.5
    record = json.loads((result.folder / "training.json").read_text())
    assert [entry["step"] for entry in record["validation"]] == [0, 2, 4]
    for _ in range(2):
        with pytest.raises(WorkFailedError):
            run(
                "any",
                "steps=100",
                "learning_rate=1e38",
                "validate_every=50",
                start=start,
                to="bad",
            )


def test_what_came_before_is_told(
    run: Run,
    stored: Callable[..., Path],
    tmp_path: Path,
) -> None:
    """Hours are with those of the start, other figures are not; words and record name
    the weights.
    """
    spent = {
        "cpu_hours": 2.0,
        "gpu_hours": 0.5,
        "validation_hours": 0.25,
        "steps": 9,
        "windows": 18,
    }
    start = stored(budget=spent)
    result = run("any", *STILL, start=start)
    record = json.loads((tmp_path / "run/training.json").read_text())
    budget = record["budget"]
    assert 2.0 < budget["cpu_hours"] < 2.1
    assert budget["gpu_hours"] == 0.5
    assert 0.25 < budget["validation_hours"] < 0.35
    assert budget["steps"] == 1
    assert budget["start_steps"] == 9
    assert budget["windows"] == 2
    assert record["recipe"]["start"]["sha256"] == file_sha256(start)
    assert file_sha256(start)[:12] in result.start
    words = training_provenance(load(result.weights)).describe()
    assert words.endswith(f"curl-noise/mini-made-up, weights {file_sha256(start)[:12]}")
    again = load(run("any", *STILL, start=result.weights, to="again").weights).training[
        "budget"
    ]
    assert 2.0 < again["cpu_hours"] < 2.1
    assert again["start_steps"] == 10


def test_hours_that_nobody_knows(run: Run, stored: Callable[..., Path]) -> None:
    """Weights without a budget that can be believed leave the sum unknown: it is of no
    equal compute.
    """
    doubtful = (
        {"cpu_hours": 0.1, "validation_hours": 0.0},
        {"cpu_hours": 9.9e11, "gpu_hours": 0.0},
    )
    for number, spent in enumerate((None, *doubtful)):
        result = run("any", *STILL, start=stored(budget=spent), to=f"run{number}")
        budget = Budget.model_validate(load(result.weights).training["budget"])
        assert budget.cpu_hours is track_of("mini", budget) is None


def test_what_came_before_counts_for_convergence() -> None:
    """Steps that bring nothing converge only where they are half of all."""
    flat = Budget(steps=4, cpu_hours=9.0, best=0.5, validations=((2, 0.5), (4, 0.5)))
    for start, track in ((None, "converged"), (2, None), (0, "converged"), (100, None)):
        assert track_of("mini", flat.model_copy(update={"start_steps": start})) == track
    long = flat.model_copy(
        update={"start_steps": 10, "steps": 30, "validations": ((9, 0.5), (30, 0.5))}
    )
    assert track_of("mini", long) == "converged"


def test_nothing_is_lost(run: Run, stored: Callable[..., Path]) -> None:
    """A start that is refused leaves what the folder holds; none may lie in the folder
    that is emptied.
    """
    first = run("any", "steps=2")
    held = first.weights.read_bytes(), first.checkpoint.read_bytes()
    odd = {"a": torch.zeros(2), "calls": torch.zeros(())}
    link = first.folder.with_name("link.pt")
    link.symlink_to(first.checkpoint)
    for baseline, start in (
        *(("any", first.weights), ("any", link)),
        *(("any", {"weights": odd}), ("drift", {}), ("any", {"model": {"unit": 2.0}})),
    ):
        path = stored(**start) if isinstance(start, dict) else start
        with pytest.raises(LagbenchError):
            run(baseline, "steps=2", "model.unit=1", start=path, fresh=True)
        assert (first.weights.read_bytes(), first.checkpoint.read_bytes()) == held


def test_facts_are_those_of_the_data(run: Run, stored: Callable[..., Path]) -> None:
    """What a file says of frames, box and cells does not bound what is validated on."""
    plain = run("any", "steps=2", start=stored(), to="plain")
    told = {
        "horizon": 1,
        "score_cells": 10**6,
        "score_placement": "odd",
        "bounds": ((0.4, 0.6), (0.4, 0.6)),
    }
    odd = run("any", "steps=2", start=stored(info=told), to="odd")
    assert odd.best_value == plain.best_value


def test_it_can_be_interrupted(run: Run, stored: Callable[..., Path]) -> None:
    """It goes on with its own weights, and only from the same start; the bits are those
    of one run.
    """

    def stop(news: Progress) -> None:
        if news.stage != "predicting" and news.done == 2:
            raise KeyboardInterrupt

    start = stored()
    whole = run("any", "steps=4", start=start, to="whole")
    with pytest.raises(KeyboardInterrupt):
        run("any", "steps=4", start=start, progress=stop)
    for other in (None, stored(model={"start": 0.25})):
        with pytest.raises(UsageError) as told:
            run("any", "steps=4", start=other)
        assert "--start" in str(told.value.where)
    parts = run("any", "steps=4", start=stored())
    assert 0 < parts.first_step < 4
    one, two = (load(result.checkpoint).weights for result in (whole, parts))
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.parametrize(
    ("baseline", "start", "kind"),
    [
        ("drift", {}, UsageError),  # of another baseline
        ("any", {"info": {"split": "fluid"}}, UsageError),
        ("any", {"info": {"dataset_sha256": "0" * 64}}, DataError),
        ("any", {"info": {"size": "mini", "version": "0.9.0"}}, DataError),
        ("any", {"info": {"size": "mini", "frame_interval": 9.0}}, UsageError),
        (
            "drift",
            {"baseline": "drift", "info": {"size": "mini"}},
            UsageError,
        ),  # for one size only
        ("any", {"info": {"statistics": {}}}, UnreadableFileError),
        *(
            (
                "any",
                {"weights": {"a": a, "calls": torch.zeros(())}},
                UnreadableFileError,
            )
            for a in (torch.zeros(2), torch.full((1,), float("nan")))
        ),
        ("var", {"baseline": "var"}, UsageError),  # fitted, not trained
        (
            "any",
            {"recipe": {"name": "x", "start": {"sha256": "../x", "recipe": "x"}}},
            UnreadableFileError,
        ),
    ],
)
def test_weights_that_do_not_fit(
    run: Run,
    stored: Callable[..., Path],
    baseline: str,
    start: dict[str, Any],
    kind: type[LagbenchError],
) -> None:
    """They are refused before a step is made."""
    with pytest.raises(kind):
        run(baseline, *STILL, start=stored(**start))
