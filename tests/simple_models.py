"""Made-up models, data sets and motions whose training and rollouts are known, for
tests of baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import EntryPoint
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lagbench.baselines import catalogue
from lagbench.baselines.baseline import Baseline, Batch, DatasetInfo
from lagbench.baselines.baseline import Options as Base
from lagbench.baselines.operators.gat import GAT, GATv2
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.operators.operator import Operator
from lagbench.baselines.operators.pointnet import PointNet
from lagbench.baselines.operators.supergat import SuperGAT, SuperGATDot
from lagbench.baselines.operators.transformer import Transformer
from lagbench.baselines.simulator import GraphNetwork
from lagbench.baselines.simulator import ParticleState as Moving
from lagbench.data.registry import Registry

Floats = NDArray[np.float32]
State = tuple[Tensor, Tensor, int]

INFO = DatasetInfo(
    split="curl-noise",
    size="tiny",
    version="1.0.0",
    dataset_sha256="0" * 64,
    particles=3,
    bounds=((0.0, 1.0), (0.0, 1.0)),
    radius=0.1,
    input_frames=6,
    horizon=20,
    score_cells=10,
    score_placement="cell_centres",
    frame_interval=0.1,
    moving_walls=True,
    statistics=dict.fromkeys(
        ("position_mean", "position_std", "velocity_std"), (0.5, 0.5)
    ),
)

OPERATORS: tuple[type[Operator], ...] = (
    GNS,
    SuperGAT,
    SuperGATDot,
    GAT,
    GATv2,
    PointNet,
    Transformer,
)


class Drift(Baseline):
    """``x(f+1) = x(f) + a (x(f) - x(f-1))``; the best ``a`` is a quotient of two
    sums.
    """

    method = "Drift"

    class Options(Base):
        """Its start, and where it fails."""

        start: float = 0.0
        fail_at: int = 0  # call of `forward` whose loss is NaN; 0 is none
        explode_at: int = 0  # frame of a rollout that is infinite; 0 is none

    def __init__(self, options: Any, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.a = nn.Parameter(torch.full((1,), options.start))
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    @property
    def history(self) -> int:
        """Two frames: one velocity."""
        return 2

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the same mean squared error twice."""
        before, now, after = batch.position.unbind(1)
        self.calls += 1
        error = (1e3 * (after - now - self.a * (now - before))).square().mean()
        broken = (
            error * float("nan") if int(self.calls) == self.options.fail_at else error
        )
        return {"motion": error, "swirl": broken}

    def start(self, given: Batch) -> State:
        """Return the last two frames and the number of the next."""
        return given.position[:, -2], given.position[:, -1], 1

    def advance(self, state: State) -> tuple[State, Tensor]:
        """Keep on drifting."""
        before, now, frame = state
        after = now + self.a * (now - before)
        if frame == self.options.explode_at:
            after = after / 0.0
        return (now, after, frame + 1), after


class Bursting(Drift):
    """A Drift of which a window bursts after three frames if its first particle is left
    of the middle.
    """

    method = "Bursting"

    def advance(self, state: State) -> tuple[State, Tensor]:
        """Advance by one frame; a batch with such a window is infinite altogether."""
        (now, after, frame), position = super().advance(state)
        first = now[:: self.info.particles, 0]
        if frame > 4 and bool((first < 0.5).any()):
            position = torch.full_like(after, float("inf"))
        return (now, position, frame), position


def install(monkeypatch: pytest.MonkeyPatch, **models: type) -> None:
    """Let packages seem installed that add baselines, by name."""
    own = tuple(catalogue.list_entry_points(catalogue.GROUP))
    added = tuple(
        EntryPoint(name, f"{model.__module__}:{model.__name__}", catalogue.GROUP)
        for name, model in models.items()
    )
    monkeypatch.setattr(catalogue, "list_entry_points", lambda group: own + added)


def trainer(
    root: Path,
    registry: Registry,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    **models: type,
) -> Callable[..., Any]:
    """Return a function that trains on tiny curl-noise data on one thread; settings are
    `training.`'s.
    """
    from lagbench.baselines.train import train as run  # loads Lightning

    install(monkeypatch, **models)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")

    def call(baseline: str, *settings: str, to: str = "run", **options: Any) -> Any:
        options = {"root": root, "split": "curl-noise", "registry": registry, **options}
        own = tuple(
            one if one.startswith(("model.", "training.")) else f"training.{one}"
            for one in settings
        )
        return run(
            baseline,
            size="tiny",
            settings=own,
            output=folder / to,
            threads=1,
            **options,
        )

    return call


def info_of(scenarios: Sequence[Floats]) -> DatasetInfo:
    """Return info whose statistics are those of some scenarios of shape [frame,
    particle, 2].
    """
    statistics = {}
    for name, order in (("position", 0), ("velocity", 1), ("acceleration", 2)):
        values = np.concatenate(
            [np.diff(x.astype(float), order, axis=0).reshape(-1, 2) for x in scenarios]
        )
        for kind, (x, y) in (
            ("mean", values.mean(axis=0)),
            ("std", values.std(axis=0)),
        ):
            statistics[f"{name}_{kind}"] = float(x), float(y)
    particles = scenarios[0].shape[1]
    return replace(
        INFO,
        split="fluid",
        particles=particles,
        input_frames=2,
        score_cells=8,
        statistics=statistics,
    )


def side_by_side(
    windows: Sequence[NDArray[Any]],
    kinds: Sequence[Tensor],
    walls: Tensor | None,
) -> Batch:
    """Return windows of shape [frame, particle, 2] as a batch, with the materials of
    each.
    """
    rows = [
        torch.from_numpy(np.ascontiguousarray(w.swapaxes(0, 1), dtype=np.float32))
        for w in windows
    ]
    return Batch(
        position=torch.cat(rows),
        sample=torch.arange(len(windows)).repeat_interleave(
            torch.tensor([len(row) for row in rows])
        ),
        material=torch.cat(list(kinds)),
        wall_velocity=walls,
        scenario=torch.arange(len(windows)),
        frame=torch.zeros(len(windows), dtype=torch.int64),
    )


def batch_of(windows: Sequence[Floats], material: Sequence[int] | None = None) -> Batch:
    """Put windows side by side; materials repeat in every window, all is liquid by
    default.
    """
    kinds = [
        torch.tensor([0] * w.shape[1] if material is None else material)
        for w in windows
    ]
    return side_by_side(windows, kinds, None)


def batch(*windows: NDArray[np.float64] | Floats, walls: bool = False) -> Batch:
    """Put windows of all materials side by side; walls slide at 0.01 to 0.08 if
    asked.
    """
    moving = (torch.arange(1.0, 9.0).reshape(4, 2) / 100.0).expand(
        len(windows), len(windows[0]), 4, 2
    )
    kinds = [torch.arange(w.shape[1]) % 4 for w in windows]
    return side_by_side(windows, kinds, moving.clone() if walls else None)


def rotations(
    scenarios: int,
    *,
    frames: int = 40,
    particles: int = 12,
    seed: int = 0,
) -> list[Floats]:
    """Return one lopsided cloud that turns about the centre of the box, from other
    angles.
    """
    rng = np.random.default_rng(seed)
    cloud = np.array([0.25, 0.0]) + rng.normal(0.0, 0.06, (particles, 2))
    angle = rng.uniform(0.0, 2 * np.pi, scenarios)[:, None] + 0.1 * np.arange(frames)
    c = np.cos(angle)
    s = np.sin(angle)
    turn = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    return list((0.5 + np.einsum("pi,sfij->sfpj", cloud, turn)).astype(np.float32))


def train(
    model: Baseline,
    scenarios: Sequence[Floats],
    *,
    steps: int,
    batch: int = 32,
) -> None:
    """Take Adam steps on random windows, as little as it needs."""
    rng = np.random.default_rng(0)
    length = model.history + model.future
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        picks = [
            rng.integers([len(scenarios), len(scenarios[0]) - length + 1])
            for _ in range(batch)
        ]
        terms = model(
            batch_of([scenarios[s][f : f + length] for s, f in picks]), generator
        )
        loss = sum(
            (model.weights.get(name, 1.0) * term for name, term in terms.items()),
            torch.zeros(()),
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()


def rolled(model: Baseline, given: Batch, frames: int) -> Tensor:
    """Return predicted positions, shape [particle, frame, 2]."""
    state: Any = model.eval().start(given)
    predicted = []
    with torch.no_grad():
        for _ in range(frames):
            state, position = model.advance(state)
            predicted.append(position)
    return torch.stack(predicted, dim=1)


def share_of_persistence(
    model: Baseline,
    scenario: Floats,
    *,
    frames: int,
    given: int = 2,
) -> float:
    """Return the rollout's squared error over that of standing still, both in
    positions.
    """
    truth = torch.from_numpy(scenario[given : given + frames].swapaxes(0, 1).copy())
    start = batch_of([scenario[:given]])
    still = (truth - start.position[:, -1:]).square().mean()
    return float((rolled(model, start, frames) - truth).square().mean() / still)


def counted(widths: Sequence[int]) -> int:
    """Return the parameters of dense layers with biases, by hand."""
    return sum(before * after + after for before, after in pairwise(widths))


RADIUS = 0.0625  # a power of two: distances over it round nowhere
# runs in milliseconds
SMALL: dict[str, object] = {
    "latent": 16,
    "layers": 2,
    "noise_std": 0.0,
}


def info(**changes: object) -> DatasetInfo:
    """Return the figures of a box of 256 particles whose statistics have no mean."""
    statistics = {
        "position_mean": (0.5, 0.5),
        "position_std": (0.25, 0.3),
        "velocity_std": (0.004, 0.003),
        "acceleration_std": (0.0002, 0.0001),
        **dict.fromkeys(("velocity_mean", "acceleration_mean"), (0.0, 0.0)),
    }
    plain: dict[str, Any] = {
        "split": "cavity",
        "particles": 256,
        "radius": RADIUS,
        "frame_interval": 0.5,
    }
    return replace(
        INFO,
        **plain
        | {"bounds": ((0.0625, 0.9375),) * 2, "statistics": statistics}
        | changes,
    )


def jittered(
    seed: int,
    side: int = 16,
    low: float = 0.0625,
    high: float = 0.9375,
) -> NDArray[np.float64]:
    """Return a jittered lattice of side^2 particles in a square, shape [particle,
    2].
    """
    rng = np.random.default_rng(seed)
    spacing = (high - low) / side
    axis = low + (np.arange(side) + 0.5) * spacing
    lattice = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    return lattice + rng.uniform(-0.3, 0.3, lattice.shape) * spacing


def swirl(
    seed: int,
    frames: int,
    speeds: Sequence[float] = (0.05, -0.03),
) -> NDArray[np.float64]:
    """Return particles on circles about the middle, from one angle per frame to
    another.
    """
    arm = jittered(seed) - 0.5
    arm *= 0.6  # the corners' circles stay in the box
    angle = np.linspace(*speeds, frames).cumsum()
    turn = np.stack(
        [np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1
    )
    return 0.5 + np.einsum("fij,pj->fpi", turn.reshape(-1, 2, 2), arm)


def network(
    *,
    awake: bool = False,
    changes: Mapping[str, object] | None = None,
    **options: object,
) -> Any:
    """Return a small GNS in float32; awake ones have a decoder that is not zero."""
    torch.manual_seed(0)
    model = GraphNetwork.with_operator(GNS).build(
        SMALL | options, info(**(changes or {}))
    )
    if awake:
        torch.nn.init.normal_(model.network.decoder[-1].weight, std=0.1)
        torch.nn.init.normal_(model.network.decoder[-1].bias, std=0.1)
    return model


def oracle(truth: torch.Tensor, target: str, **options: object) -> Any:
    """Return a simulator whose network is the truth, [particle, frame, 2],
    standardised; six are given.
    """
    velocity = truth.diff(dim=1)
    exact = {"velocity": velocity[:, 5:], "acceleration": velocity.diff(dim=1)[:, 4:]}[
        target
    ]

    class Oracle(GraphNetwork):
        operator = GNS
        method = "oracle"
        frame = 0

        def predict(
            self, state: Moving, *_: object
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            scale = getattr(self, target)
            self.frame += 1
            return scale(exact[:, self.frame - 1].float()).to(state.position.dtype), {}

    means = {"velocity_mean": (1e-3, -2e-3), "acceleration_mean": (1e-5, 2e-5)}
    shifted = info(statistics=dict(info().statistics) | means)
    return Oracle.build(SMALL | {"target": target} | options, shifted)


class Graph(NamedTuple):
    """Node inputs, senders and receivers, edge inputs."""

    node: Tensor
    edge_index: Tensor
    edge: Tensor


def graph(nodes: int, edges: int, *, node: int, edge: int, seed: int = 0) -> Graph:
    """Return a random graph without loops or repeated edges; the last node has no edge
    at all.
    """
    source = torch.Generator().manual_seed(seed)
    linked = nodes - 1
    pairs = torch.cartesian_prod(torch.arange(linked), torch.arange(linked))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    chosen = pairs[torch.randperm(len(pairs), generator=source)[:edges]].t()
    by_receiver = torch.argsort(chosen[1] * nodes + chosen[0])
    return Graph(
        torch.randn(nodes, node, generator=source),
        chosen[:, by_receiver],
        torch.randn(edges, edge, generator=source),
    )
