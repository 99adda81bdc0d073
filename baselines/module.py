"""A baseline as pytorch-lightning trains it: one loss, one optimiser, seeded steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from pytorch_lightning import LightningModule
from torch import Tensor
from torch.optim import AdamW, Optimizer
from torch.utils.data import DataLoader

from lagbench.errors import WorkFailedError
from lagbench.torch import Window

from .baseline import Baseline, Batch
from .recipe import TrainingOptions
from .seeding import reseed, seed_of

__all__ = ["TOTAL", "TrainingModule", "weighted_sum"]

TOTAL = "total"
"""Name of the weighted sum among the loss terms."""


def weighted_sum(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Return sum_i w_i L_i; terms that no weight is given for have 1, those of weight 0 are left out."""
    parts = [value * weights.get(name, 1.0) for name, value in terms.items() if weights.get(name, 1.0) != 0]
    if not parts:
        raise WorkFailedError("every term of the loss has weight 0", got=", ".join(terms))
    return torch.stack(parts).sum()


class TrainingModule(LightningModule):
    """Trains a baseline."""

    def __init__(
        self,
        model: Baseline,
        options: TrainingOptions,
        *,
        loader: Callable[[int, int], DataLoader[Window]],
        steps: int,
        processes: int = 1,
        step: int = 0,
        optimizer: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.model = model  # the baseline
        self.recipe = options
        self.steps = steps  # steps of the whole training
        self.step = step  # optimiser steps made
        # raw loss terms of the last step, and their weighted sum as 'total'
        self.terms: dict[str, Tensor] = {}
        self._rate = options.learning_rate * processes
        self._loader = loader  # returns the batches of a process, by its rank among so many
        self._resumed = optimizer
        self._noise: torch.Generator | None = None

    @property
    def learning_rate(self) -> float:
        """Rate of the next step."""
        plan = self.recipe.schedule
        return self._rate * plan.at(self.step, steps=self.steps, warmup=self.recipe.warmup_steps)

    def train_dataloader(self) -> DataLoader[Window]:
        """Return the batches of this process, from the next step on."""
        return self._loader(self.global_rank, self.trainer.world_size)

    def configure_optimizers(self) -> Optimizer:
        """Return AdamW, which is Adam where weights do not decay, as an earlier run left it."""
        optimizer = AdamW(
            self.model.parameters(), lr=self._rate, weight_decay=self.recipe.weight_decay, fused=True
        )
        if self._resumed is not None:
            optimizer.load_state_dict(dict(self._resumed))
        return optimizer

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Return the batch on the device; Lightning knows no dataclasses."""
        del dataloader_idx
        return batch.to(device)

    def training_step(self, batch: Batch, index: int) -> Tensor:
        """Return the loss of a batch, and keep its raw terms."""
        del index
        seed = seed_of(self.recipe.seed, self.step, self.global_rank)
        reseed(seed)
        if self._noise is None:
            self._noise = torch.Generator(device=self.device)
        terms = self.model(batch, self._noise.manual_seed(seed))
        total = weighted_sum(terms, self.model.weights)
        self.terms = {name: value.detach() for name, value in (*terms.items(), (TOTAL, total))}
        return total

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradient; refuse one that is not finite before it reaches the weights.

        Over several processes the gradient is their mean by now, so that all of them stop.
        """
        del gradient_clip_val, gradient_clip_algorithm
        gradients = [p.grad for p in self.model.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients, foreach=None)
        if not math.isfinite(float(norm)):
            raise self.not_finite()
        if self.recipe.clip is not None:
            torch.nn.utils.clip_grads_with_norm_(self.model.parameters(), self.recipe.clip, norm)
        for group in optimizer.param_groups:
            group["lr"] = self.learning_rate

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401 (Lightning's)
        """Make a step and count it."""
        super().optimizer_step(*args, **kwargs)
        self.step += 1

    def not_finite(self) -> WorkFailedError:
        """Return the error that names step and terms."""
        broken = [name for name, value in self.terms.items() if not torch.isfinite(value).all()]
        named = [name for name in broken if name != TOTAL] or ["none of the terms: the gradient"]
        return WorkFailedError(
            "the loss is not finite",
            where=f"step {self.step + 1}",
            got=f"NaN or infinite: {', '.join(named)}",
            fix="lower training.learning_rate or set training.clip=1;"
            " checkpoint.pt holds the last good weights",
        )
