"""Reproduction of entries: their models run again, scores compared, costs measured."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from simple_models import SMALL
from typer.testing import Result

from lagbench.baselines.checkpoint import Checkpoint, round_weights, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.predict import predict
from lagbench.baselines.simulator import GraphNetwork
from lagbench.board.check import CheckResult, check_board
from lagbench.board.entry import Level, Meta
from lagbench.board.folder import Folder
from lagbench.board.reproduce import (
    TOLERANCE,
    ReproduceResult,
    reproduce,
    sample_scenarios,
)
from lagbench.board.submit import submit
from lagbench.board.verified import read_verified
from lagbench.data.checksums import file_sha256
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.submission import open_predictions, write

NAME = "curl-noise/tiny/gns"
PATH = "submissions/curl-noise/tiny/gns.yaml"


@dataclass(frozen=True)
class Bench:
    """A leaderboard with the entry gns, whose weights lie beside it, and its data."""

    folder: Path
    root: Path
    predictions: Path

    @property
    def weights(self) -> Path:
        """The weights on the board."""
        return self.folder / "weights/curl-noise/tiny/gns_0.pt"

    def shifted(self, distance: float) -> Path:
        """Write the predictions with every particle shifted a little."""
        size = load().size("curl-noise", "tiny")
        positions = {}
        with open_predictions(self.predictions) as opened:
            for scenario in size.subsets["test"]:
                blocks = [block for _, block in opened.blocks(scenario)]
                position = np.concatenate(blocks)
                positions[scenario] = position + distance * np.sin(1e3 * position)
        return write(
            self.folder.parent / f"shifted-{distance}.nc",
            positions,
            method="gns",
            split="curl-noise",
            size="tiny",
            seed=0,
            parameters=7,
        )

    def submit(self, path: Path, **options: Any) -> None:
        """Submit predictions of gns."""
        meta = Meta(authors=("A. Author",), command="make")
        submit(
            [path], meta, board=self.folder, root=self.root, new_board=True, **options
        )

    def edit(self, path: Path, change: Callable[[dict[str, Any]], object]) -> None:
        """Change a YAML file of the board by hand."""
        content = yaml.safe_load(path.read_text())
        change(content)
        path.write_text(yaml.safe_dump(content, sort_keys=False))

    def find(self, **options: Any) -> CheckResult:
        """Check the board."""
        return check_board(self.folder, root=self.root, isolated=False, **options)


@pytest.fixture(scope="module")
def master(
    tmp_path_factory: pytest.TempPathFactory, generated: GenerationResult
) -> Bench:
    """A small network that moves particles at random, predicted and submitted."""
    folder = tmp_path_factory.mktemp("reproduce")
    info = read_dataset_info("curl-noise", "tiny", root=generated.root)
    torch.manual_seed(3)
    model = GraphNetwork.with_operator(GNS).build(SMALL, info)
    last_layer = model.network.decoder[-1]
    assert isinstance(last_layer, torch.nn.Linear)
    torch.nn.init.normal_(last_layer.weight, std=0.1)
    recipe = {"name": "curl-noise/tiny", "training": {"seed": 0}}
    checkpoint = Checkpoint(
        baseline="gns",
        options=SMALL,
        info=info,
        weights=round_weights(model),
        training={"step": 5, "recipe": recipe},
    )
    save(folder / "weights.pt", checkpoint)
    predict(
        folder / "weights.pt",
        folder / "predictions.nc",
        root=generated.root,
        device="cpu",
        threads=1,
        method="gns",
    )
    bench = Bench(folder / "board", generated.root, folder / "predictions.nc")
    bench.submit(bench.predictions, weights=[folder / "weights.pt"])
    return bench


@pytest.fixture
def own(master: Bench, tmp_path: Path) -> Bench:
    """A copy of the leaderboard that the test may change."""
    shutil.copytree(master.folder, tmp_path / "board")
    return replace(master, folder=tmp_path / "board")


def run_again(own: Bench, *names: str, **options: Any) -> ReproduceResult:
    """Reproduce entries without costs."""
    defaults: dict[str, Any] = {"costs": False}
    return reproduce(
        own.folder,
        names,
        root=own.root,
        **(defaults | options),
    )


def test_a_model_gives_the_scores_of_its_entry(own: Bench) -> None:
    """Its line says so, it is not run twice, and the board has nothing to object."""
    result = run_again(own, NAME, costs=True, time_solver=lambda *_: 0.5)
    assert (result.exit_code, result.predicted) == (0, [f"{NAME}, seed 0"])
    line = read_verified(Folder(own.folder))[PATH]
    assert line == result.lines[PATH]
    assert line.level is Level.REPRODUCED
    (one,) = line.reproduced
    assert (one.scenarios, one.of, one.difference) == (2, 2, 0.0)
    assert one.model == file_sha256(own.weights)
    assert line.cost is not None
    assert line.cost.solver == 0.5
    assert {"projection"} <= line.cost.classical.keys()
    assert line.cost.speed_up == 0.5 / line.cost.seconds_per_frame

    before = (own.folder / "verified.yaml").read_bytes()
    assert run_again(own, NAME).predicted == []
    assert run_again(own).predicted == []
    assert (own.folder / "verified.yaml").read_bytes() == before
    assert run_again(own, NAME, again=True).predicted == [f"{NAME}, seed 0"]
    assert own.find().findings == ()


def test_a_model_that_gives_other_scores(own: Bench) -> None:
    """An entry whose score file belongs to other predictions is not reproduced."""
    weights = own.weights.read_bytes()
    own.submit(own.shifted(0.01), replace=True)
    own.weights.parent.mkdir(parents=True, exist_ok=True)
    own.weights.write_bytes(weights)
    said = {
        "path": own.weights.relative_to(own.folder).as_posix(),
        "sha256": file_sha256(own.weights),
    }
    own.edit(
        own.folder / PATH,
        lambda content: content["predictions"][0].update(weights=said),
    )
    result = run_again(own, NAME)
    assert result.exit_code == ChecksFailedError.exit_code
    assert result.differing == [PATH]
    line = read_verified(Folder(own.folder))[PATH]
    assert line.level is Level.AS_SUBMITTED
    assert line.reproduced[0].difference > TOLERANCE


def test_a_line_holds_for_its_models_only(own: Bench) -> None:
    """Other weights of the same predictions make the line stale."""
    run_again(own, NAME)
    own.edit(
        own.folder / "verified.yaml",
        lambda content: content[PATH]["reproduced"][0].update(model="0" * 64),
    )
    assert [issue.check for issue in own.find().findings] == ["verified"]


def test_what_cannot_be_run_is_refused(own: Bench) -> None:
    """A model that was exchanged, an entry without a model, an unknown entry."""
    own.weights.write_bytes(own.weights.read_bytes() + b"1")
    with pytest.raises(ChecksFailedError) as caught:
        run_again(own, NAME)
    assert caught.value.where == str(own.weights)
    result = run_again(own)
    assert [failure.entry for failure in result.failures] == [PATH]
    assert result.exit_code == ChecksFailedError.exit_code

    own.edit(
        own.folder / PATH, lambda content: content["predictions"][0].pop("weights")
    )
    for name in ("curl-noise/tiny/nobody", NAME):
        with pytest.raises(UsageError):
            run_again(own, name)


def test_predictions_made_anew_confirm_within_the_tolerance(own: Bench) -> None:
    """Positions that differ by 1e-7 confirm the entry; those 1e-2 away do not."""
    near = own.find(predictions=[own.shifted(1e-7)])
    assert near.findings == ()
    (confirmation,) = near.confirmed
    assert confirmation.is_anew
    assert 0.0 < confirmation.difference <= TOLERANCE
    far = own.find(predictions=[own.shifted(1e-2)])
    assert [issue.check for issue in far.findings] == ["rescored"]


def test_a_sample_is_the_same_in_every_run() -> None:
    """Models have samples of their own, inside the test subset."""
    scenarios = range(100, 120)
    samples = [sample_scenarios(scenarios, f"{i}", 4) for i in range(9)]
    assert samples == [sample_scenarios(scenarios, f"{i}", 4) for i in range(9)]
    assert len(set(samples)) > 1
    assert all(set(scenarios) > set(sample) for sample in samples)
    assert sample_scenarios(scenarios, "1", None) == tuple(scenarios)


def test_the_command_says_what_it_did(own: Bench, run: Callable[..., Result]) -> None:
    """Options that contradict each other are refused before any work."""
    board = ("--board", own.folder)
    for words in ((), (NAME, "--all"), (NAME, "--costs", "--no-costs")):
        assert run("leaderboard", "reproduce", *words, *board).exit_code == 2
    result = run("leaderboard", "reproduce", "curl-noise/tiny/nobody", *board, "--json")
    assert result.exit_code == 2
