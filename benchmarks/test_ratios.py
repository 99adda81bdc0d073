"""Ratios of processor times within one run: a line for each.

    make bench

Seconds depend on the machine and on its load; ratios hardly do.
"""

from __future__ import annotations

import hashlib
import math
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.interpolate import griddata
from statsmodels.tsa.api import VAR as StatsmodelsVAR
from torch import Tensor, nn

import lagbench
from lagbench.baselines.graph import radius_graph
from lagbench.baselines.network import EdgeMLP, EncodeProcessDecode
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.var import LaggedRows, solve
from lagbench.data.checksums import ContentHasher
from lagbench.torch import WindowDataset, WindowSampler

Floats = NDArray[np.floating]
SPLIT = "curl-noise"


def processor_seconds(call: Callable[[], object], rounds: int = 3) -> float:
    """Return the least processor time of some calls, child processes included [s]."""
    best = math.inf
    for _ in range(rounds):
        start = _processor_time()
        call()
        best = min(best, _processor_time() - start)
    return best


def _processor_time() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def show(name: str, ratio: float, limit: str) -> None:
    """Print the line of a ratio."""
    print(f"\nratio: {name}: {ratio:.2f} ({limit})")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the test scenarios of curl-noise mini."""
    folder = tmp_path_factory.mktemp("data")
    lagbench.generate(SPLIT, "mini", subset="test", root=folder, workers=1)
    return folder


def test_start() -> None:
    """--help takes at most half of the time of importing xarray, the import 15 %."""

    def start(*words: str) -> float:
        command = [sys.executable, *words]
        return processor_seconds(
            lambda: subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        )

    xarray = start("-c", "import xarray")
    help_ratio = start("-m", "lagbench", "--help") / xarray
    import_ratio = start("-c", "import lagbench") / xarray
    show("lagbench --help / import xarray", help_ratio, "at most 0.5")
    show("import lagbench / import xarray", import_ratio, "at most 0.15")
    assert help_ratio <= 0.5
    assert import_ratio <= 0.15


def test_content_hash() -> None:
    """The content hash takes at most four times as long as SHA-256 of the bytes."""
    rng = np.random.default_rng(0)
    frames = rng.random((300, 8192, 2), dtype=np.float32)

    def content_hash() -> None:
        hasher = ContentHasher({"split": SPLIT})
        axes = ("frame", "particle", "space")
        hasher.declare("position", frames.dtype, axes, frames.shape)
        for frame in frames:
            hasher.update("position", frame)
        hasher.hexdigest()

    bare = processor_seconds(lambda: hashlib.sha256(frames.data).digest())
    ratio = processor_seconds(content_hash) / bare
    show("content hash / SHA-256", ratio, "at most 4")
    assert ratio <= 4


def test_two_workers(tmp_path: Path) -> None:
    """Two workers write the bits of one, at less than twice its processor time."""

    def generate(workers: int) -> str | None:
        folder = tmp_path / str(workers)
        result = lagbench.generate(SPLIT, "mini", root=folder, workers=workers)
        return result.dataset_sha256

    hashes = {}
    seconds = {}
    for workers in (1, 2):
        start = _processor_time()
        hashes[workers] = generate(workers)
        seconds[workers] = _processor_time() - start
    ratio = seconds[2] / seconds[1]
    show("generating with two workers / with one", ratio, "at most 1.8")
    assert hashes[1] == hashes[2]
    assert ratio <= 1.8


def test_windows(root: Path) -> None:
    """Windows in the sampler's order are read at least as fast as in random order."""

    def data() -> WindowDataset:
        return WindowDataset(SPLIT, size="mini", subset="test", root=root, history=6)

    ordered = data()
    order = list(WindowSampler(ordered, seed=0))
    rng = np.random.default_rng(0)
    random_order = rng.permutation(len(order))[:300]
    shuffled = data()

    def seconds_per_window(dataset: WindowDataset, indices: list[int]) -> float:
        def read() -> None:
            for index in indices:
                dataset[index]

        return processor_seconds(read, rounds=1) / len(indices)

    ratio = seconds_per_window(shuffled, random_order.tolist())
    ratio /= seconds_per_window(ordered, order)
    show("a window in random order / in the sampler's order", ratio, "at least 1")
    assert ratio >= 1


def test_score(root: Path, tmp_path: Path) -> None:
    """All metrics of a frame take at most a fifth of two cubic interpolations."""
    test = lagbench.open_split(SPLIT, subset="test", size="mini", root=root)
    predictions = {}
    for scenario in test.scenario.values:
        truth = test.position.sel(scenario=scenario).values[:96]
        predictions[int(scenario)] = np.repeat(truth[5:6], 90, axis=0)
    path = lagbench.submission.write(
        tmp_path / "rest.nc",
        predictions,
        split=SPLIT,
        size="mini",
        method="rest",
        root=root,
    )
    ours = processor_seconds(
        lambda: lagbench.score(path, root=root, workers=1, write=False), rounds=1
    )
    axis = np.linspace(0.1, 0.9, 40)
    nodes = tuple(np.meshgrid(axis, axis, indexing="ij"))
    position, after = truth[5], truth[6]
    naive = processor_seconds(
        lambda: griddata(position, after - position, nodes, method="cubic")
    )
    frames = 90 * len(predictions)
    ratio = frames * 2 * naive / ours
    show("vorticity by griddata / all metrics of lagbench", ratio, "at least 5")
    assert ratio >= 5


def test_radius_graph() -> None:
    """The neighbour search takes at most a tenth of the time of all distances."""
    rng = np.random.default_rng(0)
    position = torch.from_numpy(rng.random((8192, 2), dtype=np.float32))
    radius = 0.015

    def all_distances() -> Tensor:
        return (torch.cdist(position, position) <= radius).nonzero()

    ratio = processor_seconds(all_distances)
    ratio /= processor_seconds(lambda: radius_graph(position, radius))
    show("all distances / radius graph of 8192 particles", ratio, "at least 10")
    assert ratio >= 10


def test_graph_network_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training step is at most 10 % slower than with the plain edge product."""
    count = 2048
    generator = torch.Generator().manual_seed(0)
    position = math.sqrt(count) * torch.rand(count, 2, generator=generator)
    edge_index = radius_graph(position, 1.72)
    node = torch.randn(count, 30)
    edge = torch.randn(edge_index.shape[1], 3)
    target = torch.randn(count, 2)

    def step_seconds() -> float:
        torch.manual_seed(0)
        model = EncodeProcessDecode(
            GNS, node_features=30, edge_features=3, latent=64, layers=5
        )
        optimizer = torch.optim.Adam(model.parameters())

        def step() -> None:
            output, _ = model(node, edge_index, edge, generator)
            optimizer.zero_grad()
            loss = nn.functional.mse_loss(output, target)
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()

        step()
        return processor_seconds(step)

    def plain_update(
        self: EdgeMLP, edge: Tensor, node: Tensor, edge_index: Tensor
    ) -> Tensor:
        """Multiply the whole concatenation of an edge and its ends."""
        sender, receiver = edge_index
        hidden = self.first(torch.cat([edge, node[receiver], node[sender]], dim=1))
        update: Tensor = self.rest(hidden)
        return update

    ours = step_seconds()
    monkeypatch.setattr(EdgeMLP, "forward", plain_update)
    ratio = ours / step_seconds()
    show("our step of GNS / a step with plain products", ratio, "at most 1.1")
    assert ratio <= 1.1


def test_var() -> None:
    """The fit of a VAR(1) of 500 dimensions is twice as fast as in statsmodels."""
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(700, 500)) @ rng.normal(size=(500, 500))
    states = np.asarray(mixed / math.sqrt(500), np.float32)
    exact = states.astype(np.float64)
    ratio = processor_seconds(lambda: StatsmodelsVAR(exact).fit(1, trend="c"))
    ratio /= processor_seconds(lambda: solve(LaggedRows([states], lags=1)))
    show("VAR of statsmodels / of lagbench", ratio, "at least 2")
    assert ratio >= 2
