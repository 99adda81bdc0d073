"""Made-up models, data sets and motions whose training and rollouts are known, for
tests of baselines.
"""

from __future__ import annotations

import json
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
from lagbench.baselines.checkpoint import Checkpoint, save
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
        no_calls = torch.zeros((), dtype=torch.int64)
        self.register_buffer("calls", no_calls)

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
        drift = self.a * (now - before)
        error = (1e3 * (after - now - drift)).square().mean()
        swirl = error
        if int(self.calls) == self.options.fail_at:
            swirl = error * float("nan")
        return {"motion": error, "swirl": swirl}

    def start(self, given: Batch) -> State:
        """Return the last two frames and the number of the next."""
        before = given.position[:, -2]
        now = given.position[:, -1]
        return before, now, 1

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
        first_x = now[:: self.info.particles, 0]
        if frame > 4 and bool((first_x < 0.5).any()):
            position = torch.full_like(after, float("inf"))
        return (now, position, frame), position


def install(monkeypatch: pytest.MonkeyPatch, **models: type) -> None:
    """Let packages seem installed that add baselines, by name."""
    own = tuple(catalogue.list_entry_points(catalogue.GROUP))
    added = []
    for name, model in models.items():
        place = f"{model.__module__}:{model.__name__}"
        added.append(EntryPoint(name, place, catalogue.GROUP))
    points = (*own, *added)
    monkeypatch.setattr(catalogue, "list_entry_points", lambda group: points)


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
        defaults = {
            "root": root,
            "split": "curl-noise",
            "registry": registry,
            "output": folder / to,
        }
        full_settings = []
        for setting in settings:
            if setting.startswith(("model.", "training.")):
                full_settings.append(setting)
            else:
                full_settings.append(f"training.{setting}")
        return run(
            baseline,
            size="tiny",
            settings=tuple(full_settings),
            threads=1,
            **(defaults | options),
        )

    return call


def info_of(scenarios: Sequence[Floats]) -> DatasetInfo:
    """Return info whose statistics are those of some scenarios of shape [frame,
    particle, 2].
    """
    statistics = {}
    for name, order in (
        ("position", 0),
        ("velocity", 1),
        ("acceleration", 2),
    ):
        differences = []
        for positions in scenarios:
            difference = np.diff(positions.astype(float), order, axis=0)
            differences.append(difference.reshape(-1, 2))
        values = np.concatenate(differences)
        mean_x, mean_y = values.mean(axis=0)
        std_x, std_y = values.std(axis=0)
        statistics[f"{name}_mean"] = (float(mean_x), float(mean_y))
        statistics[f"{name}_std"] = (float(std_x), float(std_y))
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
    rows = []
    for window in windows:
        by_particle = window.swapaxes(0, 1)
        row = np.ascontiguousarray(by_particle, dtype=np.float32)
        rows.append(torch.from_numpy(row))
    window_numbers = torch.arange(len(windows))
    particle_counts = torch.tensor([len(row) for row in rows])
    return Batch(
        position=torch.cat(rows),
        sample=window_numbers.repeat_interleave(particle_counts),
        material=torch.cat(list(kinds)),
        wall_velocity=walls,
        scenario=window_numbers,
        frame=torch.zeros_like(window_numbers),
    )


def batch_of(windows: Sequence[Floats], material: Sequence[int] | None = None) -> Batch:
    """Put windows side by side; materials repeat in every window, all is liquid by
    default.
    """
    kinds = []
    for window in windows:
        particle_count = window.shape[1]
        if material is None:
            kinds.append(torch.zeros(particle_count, dtype=torch.int64))
        else:
            kinds.append(torch.tensor(material))
    return side_by_side(windows, kinds, None)


def batch(*windows: NDArray[np.float64] | Floats, walls: bool = False) -> Batch:
    """Put windows of all materials side by side; walls slide at 0.01 to 0.08 if
    asked.
    """
    kinds = [torch.arange(window.shape[1]) % 4 for window in windows]
    if not walls:
        return side_by_side(windows, kinds, None)
    of_a_frame = torch.arange(1.0, 9.0).reshape(4, 2) / 100.0
    frame_count = len(windows[0])
    wall_velocity = of_a_frame.expand(len(windows), frame_count, 4, 2)
    return side_by_side(windows, kinds, wall_velocity.clone())


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
    middle = np.array([0.25, 0.0])
    cloud = middle + rng.normal(0.0, 0.06, (particles, 2))
    start = rng.uniform(0.0, 2 * np.pi, scenarios)
    angle = start[:, None] + 0.1 * np.arange(frames)
    c = np.cos(angle)
    s = np.sin(angle)
    first_row = np.stack([c, s], -1)
    second_row = np.stack([-s, c], -1)
    turn = np.stack([first_row, second_row], -2)
    turned = np.einsum("pi,sfij->sfpj", cloud, turn)
    return list((0.5 + turned).astype(np.float32))


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
    starts = len(scenarios[0]) - length + 1
    for _ in range(steps):
        windows = []
        for _ in range(batch):
            scenario, first = rng.integers([len(scenarios), starts])
            window = scenarios[scenario][first : first + length]
            windows.append(window)
        terms = model(batch_of(windows), generator)
        loss = torch.zeros(())
        for name, term in terms.items():
            loss = loss + model.weights.get(name, 1.0) * term
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()


def save_untrained(path: Path, name: str, model: Baseline, info: DatasetInfo) -> None:
    """Write the weights of a model that has made no step of a training."""
    checkpoint = Checkpoint(
        baseline=name,
        options=model.options.model_dump(mode="json"),
        info=info,
        weights=model.state_dict(),
        training={},
    )
    save(path, checkpoint)


def rolled(model: Baseline, given: Batch, frames: int) -> Tensor:
    """Return predicted positions, shape [particle, frame, 2]."""
    state: Any = model.eval().start(given)
    predicted = []
    with torch.no_grad():
        for _ in range(frames):
            state, position = model.advance(state)
            predicted.append(position)
    return torch.stack(predicted, dim=1)


def greatest_difference(first: Tensor, second: Tensor) -> float:
    """Return the greatest difference of two tensors, in absolute value."""
    difference = first - second
    return float(difference.abs().max())


def read_training_log(folder: Path) -> dict[str, Any]:
    """Return what a training wrote beside its weights."""
    content = (folder / "training.json").read_text()
    return dict(json.loads(content))


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
    future = scenario[given : given + frames]
    truth = torch.from_numpy(future.swapaxes(0, 1).copy())
    start = batch_of([scenario[:given]])
    last_given = start.position[:, -1:]
    error_of_rest = (truth - last_given).square().mean()
    error = (rolled(model, start, frames) - truth).square().mean()
    return float(error / error_of_rest)


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
        "velocity_mean": (0.0, 0.0),
        "velocity_std": (0.004, 0.003),
        "acceleration_mean": (0.0, 0.0),
        "acceleration_std": (0.0002, 0.0001),
    }
    plain: dict[str, Any] = {
        "split": "cavity",
        "particles": 256,
        "radius": RADIUS,
        "frame_interval": 0.5,
        "bounds": ((0.0625, 0.9375), (0.0625, 0.9375)),
        "statistics": statistics,
    }
    return replace(INFO, **(plain | changes))


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
    x, y = np.meshgrid(axis, axis, indexing="ij")
    lattice = np.stack([x, y], axis=-1).reshape(-1, 2)
    jitter = rng.uniform(-0.3, 0.3, lattice.shape)
    return lattice + jitter * spacing


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
    cos = np.cos(angle)
    sin = np.sin(angle)
    turn = np.stack([cos, -sin, sin, cos], axis=-1)
    rotation = turn.reshape(-1, 2, 2)
    return 0.5 + np.einsum("fij,pj->fpi", rotation, arm)


def network(
    *,
    awake: bool = False,
    changes: Mapping[str, object] | None = None,
    **options: object,
) -> Any:
    """Return a small GNS in float32; awake ones have a decoder that is not zero."""
    torch.manual_seed(0)
    figures = info(**(changes or {}))
    model = GraphNetwork.with_operator(GNS).build(SMALL | options, figures)
    if awake:
        last_layer = model.network.decoder[-1]
        torch.nn.init.normal_(last_layer.weight, std=0.1)
        torch.nn.init.normal_(last_layer.bias, std=0.1)
    return model


def oracle(truth: torch.Tensor) -> Any:
    """Return a simulator whose network is the truth, [particle, frame, 2],
    standardised; six are given.
    """
    exact = truth.diff(dim=1).diff(dim=1)[:, 4:]

    class Oracle(GraphNetwork):
        operator = GNS
        method = "oracle"
        frame = 0

        def predict(
            self, state: Moving, *_: object
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            output = self.acceleration(exact[:, self.frame].float())
            self.frame += 1
            return output.to(state.position.dtype), {}

    means = {
        "velocity_mean": (1e-3, -2e-3),
        "acceleration_mean": (1e-5, 2e-5),
    }
    shifted = info(statistics=dict(info().statistics) | means)
    return Oracle.build(SMALL, shifted)


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
    numbers = torch.arange(linked)
    pairs = torch.cartesian_prod(numbers, numbers)
    is_loop = pairs[:, 0] == pairs[:, 1]
    pairs = pairs[~is_loop]
    order = torch.randperm(len(pairs), generator=source)
    chosen = pairs[order[:edges]].t()
    sender, receiver = chosen
    by_receiver = torch.argsort(receiver * nodes + sender)
    return Graph(
        torch.randn(nodes, node, generator=source),
        chosen[:, by_receiver],
        torch.randn(edges, edge, generator=source),
    )
