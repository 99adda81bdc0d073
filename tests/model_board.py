"""A leaderboard with a small graph network, whose weights lie beside its entry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from simple_models import SMALL

from lagbench.baselines.checkpoint import Checkpoint, round_weights, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.predict import predict
from lagbench.baselines.simulator import GraphNetwork
from lagbench.board.check import CheckResult, check_board
from lagbench.board.entry import Meta
from lagbench.board.submit import submit
from lagbench.data.registry import load
from lagbench.submission import open_predictions, write

SPLIT = "curl-noise"
NAME = f"{SPLIT}/tiny/gns"
PATH = f"submissions/{NAME}.yaml"


@dataclass(frozen=True)
class ModelBoard:
    """A leaderboard with the entry gns, whose weights lie beside it, and its data."""

    folder: Path
    root: Path
    predictions: Path
    split: str = SPLIT

    @property
    def weights(self) -> Path:
        """The weights on the board."""
        return self.folder / f"weights/{self.split}/tiny/gns_0.safetensors"

    def shifted(self, distance: float) -> Path:
        """Write the predictions with every particle shifted a little."""
        size = load().size(self.split, "tiny")
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
            split=self.split,
            size="tiny",
            seed=0,
            parameters=7,
        )

    def submit(self, path: Path, *, method: str | None = None, **options: Any) -> None:
        """Submit predictions of gns."""
        meta = Meta(authors=("A. Author",), command="make", method=method)
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
        return check_board(self.folder, root=self.root, **options)


def make_bench(folder: Path, root: Path, split: str = SPLIT) -> ModelBoard:
    """Return a board with a network that moves particles at random.

    A board that another process has made is taken as it is.
    """
    bench = ModelBoard(folder / "board", root, folder / "predictions.nc", split)
    if bench.weights.exists():
        return bench
    folder.mkdir(parents=True, exist_ok=True)
    info = read_dataset_info(split, "tiny", root=root)
    torch.manual_seed(3)
    model = GraphNetwork.with_operator(GNS).build(SMALL, info)
    last_layer = model.network.decoder[-1]
    assert isinstance(last_layer, torch.nn.Linear)
    torch.nn.init.normal_(last_layer.weight, std=0.1)
    recipe = {"name": f"{split}/tiny", "training": {"seed": 0}}
    checkpoint = Checkpoint(
        baseline="gns",
        options=SMALL,
        info=info,
        weights=round_weights(model),
        training={"step": 5, "recipe": recipe},
    )
    save(folder / "weights.safetensors", checkpoint)
    predict(
        folder / "weights.safetensors",
        folder / "predictions.nc",
        root=root,
        device="cpu",
        threads=1,
        method="gns",
    )
    bench.submit(bench.predictions, weights=[folder / "weights.safetensors"])
    return bench
