"""A trained NeuralMPM in the place of the simulator of a design task.

It is given the start of a run as two frames. Gradients reach the parameters through all
frames; what a start does with them (places, velocities, programs of walls) is
linearised by central differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lagbench.baselines.checkpoint import load, restore
from lagbench.design.search import Objective
from lagbench.design.tasks import MODES, POUR_WINDOW, DesignTask
from lagbench.tensors import Batch

STEP = 0.01  # of central differences, as a share of a parameter's range
RATE = 0.05  # of Adam, as a share of a parameter's range
STEPS = 10  # after which a descent starts at another place


class Surrogate:
    """A trained model in the place of a task's simulator."""

    def __init__(self, weights: Path, task: DesignTask) -> None:
        self.model = restore(load(weights)).requires_grad_(requires_grad=False)
        self.task = task
        self.gradient = np.zeros(len(task.parameters))  # of the last error

    @torch.no_grad()
    def objective(self, values: Sequence[float]) -> float:
        """Return the objective of parameters, as the model sees it."""
        positions = self.roll_out(torch.tensor(values, dtype=torch.float64))
        objective = self.task.objective_of(positions.double().numpy(), values)
        return objective if math.isfinite(objective) else math.inf

    def objective_and_gradient(self, values: Sequence[float]) -> float:
        """Return the objective of parameters, and keep its gradient."""
        leaf = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        error = self.measure(self.roll_out(leaf))
        (slope,) = torch.autograd.grad(error, leaf)
        self.gradient = np.nan_to_num(slope.numpy(), posinf=0.0, neginf=0.0)
        value = error.item()
        return value if math.isfinite(value) else math.inf

    def roll_out(self, values: Tensor) -> Tensor:
        """Return positions [length], shape [frame, particle, axis]."""
        task = self.task
        interval = task.size.frame_interval
        array = task.check(values.tolist())
        state = task.start(task.size, array)
        position, velocity, walls = self._start(values)
        before = position - interval * velocity
        wall_velocity = None
        if self.model.info.moving_walls:
            if walls.dim() == 2:  # constant
                walls = walls.expand(task.frames + 1, -1, -1)
            # the frame before the start comes first
            wall_velocity = torch.cat([walls[:1], walls])[None]
        batch = Batch(
            position=torch.stack([before, position], dim=1),
            sample=torch.zeros(len(position), dtype=torch.int64),
            material=torch.from_numpy(state.material).long(),
            wall_velocity=wall_velocity,
            scenario=torch.zeros(1, dtype=torch.int64),
            frame=torch.zeros(1, dtype=torch.int64),
            viscosity=torch.tensor([task.size.viscosity(state.viscosity or None)]),
        )
        rollout = self.model.start(batch)
        positions = [position]
        for _ in range(task.frames):
            rollout, position = self.model.advance(rollout)
            positions.append(position)
        return torch.stack(positions)

    def _start(self, values: Tensor) -> list[Tensor]:
        """Return positions, velocities and wall velocities of the start."""
        task = self.task
        array = task.check(values.tolist())
        tensors = [torch.from_numpy(each).float() for each in _arrays(task, array)]
        if not values.requires_grad:
            return tensors
        zeros = (values - values.detach()).float()
        for number, parameter in enumerate(task.parameters):
            step = STEP * (parameter.high - parameter.low)
            higher = array.copy()
            lower = array.copy()
            higher[number] += step
            lower[number] -= step
            pairs = zip(_arrays(task, higher), _arrays(task, lower), strict=True)
            for place, (high, low) in enumerate(pairs):
                slope = torch.from_numpy((high - low) / (2.0 * step)).float()
                tensors[place] = tensors[place] + slope * zeros[number]
        return tensors

    def measure(self, positions: Tensor) -> Tensor:
        """Return the error of a task of ``pour`` or ``stir``, with its gradient."""
        task = self.task
        if task.bucket is not None:
            low, high = torch.from_numpy(task.bucket).float()
            last = positions[-POUR_WINDOW:]
            beyond = torch.maximum(low - last, last - high).clamp(min=0.0)
            return (beyond.square().sum(dim=-1) + 1e-12).sqrt().mean()
        low, high = task.size.bounds[0]
        places = (positions - low) / (high - low)
        mark = torch.where(places[0, :, task.marked_axis] < 0.5, 1.0, -1.0)
        first, last = (_mix_norm(places[frame], mark) for frame in (0, -1))
        return last / first


def _arrays(task: DesignTask, values: np.ndarray) -> list[np.ndarray]:
    state = task.start(task.size, values)
    return [state.position, state.velocity, state.wall_velocity]


def _mix_norm(places: Tensor, mark: Tensor) -> Tensor:
    """Return the mix-norm; :func:`lagbench.design.tasks.mix_norm` explains it."""
    wave = torch.arange(MODES)
    scale = torch.where(wave > 0, math.sqrt(2.0), 1.0)
    modes_x = scale * torch.cos(math.pi * wave * places[:, :1])
    modes_y = scale * torch.cos(math.pi * wave * places[:, 1:])
    centred = mark - mark.mean()
    coefficients = torch.einsum("p,pi,pj->ij", centred, modes_x, modes_y) / len(mark)
    square = wave[:, None] ** 2 + wave[None, :] ** 2
    weight = 1.0 / torch.sqrt(1.0 + math.pi**2 * square)
    return (weight * coefficients.square()).sum().sqrt()


def descend(
    task: DesignTask,
    objective: Objective,
    *,
    runs: int,
    seed: int,
    surrogate: Surrogate,
) -> list[float]:
    """Return the best that Adam finds in so many steps through the surrogate.

    It starts in the middle of the bounds, and after some steps anew at a random place.

    Args:
        task: the task, of ``pour`` or ``stir``.
        objective: calls the surrogate's :meth:`Surrogate.objective_and_gradient`.
        runs: steps.
        seed: of the random places.
        surrogate: the model.
    """
    rng = np.random.default_rng(seed)
    ranges = np.array([each.high - each.low for each in task.parameters])
    results: list[tuple[float, list[float]]] = []
    shares = torch.full((len(ranges),), 0.5, dtype=torch.float64)
    for step in range(runs):
        if step % STEPS == 0:
            if step:
                shares = torch.from_numpy(rng.random(len(ranges)))
            optimiser = torch.optim.Adam([shares], lr=RATE)
        values = task.at(shares.numpy())
        results.append((objective(values), values))
        shares.grad = torch.from_numpy(surrogate.gradient * ranges)
        optimiser.step()
        shares.clamp_(0.0, 1.0)
    return min(results)[1]
