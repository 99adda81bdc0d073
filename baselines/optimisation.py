"""The optimiser steps of a training: loss, gradient, AdamW, and the mean of weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager

import torch
from torch import Tensor
from torch.optim import AdamW

from lagbench.errors import UsageError, WorkFailedError

from .baseline import Baseline
from .recipe import TrainingOptions
from .rollout import replace_parameters

MEAN = "mean"  # name of a weight's running mean in the optimiser's state
TOTAL = "total"  # name of the weighted sum among the loss terms


class Optimisation:
    """Makes the optimiser steps of a baseline.

    Args:
        model: the baseline.
        options: options of the training.
        steps: steps of the whole training.
        processes: processes that share the training; the learning rate is multiplied
            by their number.
        step: steps that an earlier run made.
        state: tensors of the optimiser after those, by "<parameter>/<name>".

    Raises:
        UsageError: the model has no parameters.
    """

    def __init__(
        self,
        model: Baseline,
        options: TrainingOptions,
        *,
        steps: int,
        processes: int = 1,
        step: int = 0,
        state: Mapping[str, Tensor] | None = None,
    ) -> None:
        if next(model.parameters(), None) is None:
            raise UsageError(
                f"{model.method} has no parameters to train; write its predictions "
                "with lagbench.submission.write"
            )
        self.model = model
        self.options = options
        self.steps = steps
        self.step = step  # optimiser steps made
        # raw loss terms of the last step, and their weighted sum as 'total'
        self.terms: dict[str, Tensor] = {}
        self._base_rate = options.learning_rate * processes
        # AdamW is Adam where weights do not decay.
        self.optimizer = AdamW(
            model.parameters(),
            lr=self._base_rate,
            weight_decay=options.weight_decay,
            fused=True,
        )
        parameters = dict(model.named_parameters())
        for key, value in (state or {}).items():
            name, _, kind = key.rpartition("/")
            parameter = parameters[name]
            self.optimizer.state[parameter][kind] = value.to(parameter.device)

    def state_tensors(self) -> dict[str, Tensor]:
        """Return the state of the optimiser, by "<parameter>/<name>"."""
        tensors = {}
        for name, parameter in self.model.named_parameters():
            for kind, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"{name}/{kind}"] = value
        return tensors

    @property
    def learning_rate(self) -> float:
        """Rate of the next step."""
        return self._base_rate * self.options.rate_factor(self.step, steps=self.steps)

    def weigh(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Return the loss, the weighted sum of the terms; keep the terms.

        Raises:
            UsageError: no term with a weight above 0 depends on a parameter.
        """
        weighted = []
        for name, term in terms.items():
            weight = self.model.weights.get(name, 1.0)
            if weight != 0:
                weighted.append(term.reshape(()) * weight)
        total = torch.stack(weighted).sum() if weighted else torch.zeros(())
        if not total.requires_grad:
            raise UsageError(
                f"nothing can be learned from the loss of {self.model.method}: none of "
                f"{', '.join(terms)} has a weight above 0 and depends on a parameter"
            )
        self.terms = {name: term.detach() for name, term in terms.items()}
        self.terms[TOTAL] = total.detach()
        return total

    def make_step(self, loss: Tensor) -> None:
        """Make a step down the gradient of a loss; move the mean towards the weights.

        Raises:
            WorkFailedError: the gradient is not finite; the weights stay as they are.
        """
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        # Over several processes the gradient is their mean by now, so all of them stop
        # where it is not finite.
        parameters = list(self.model.parameters())
        gradients = [p.grad for p in parameters if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients, foreach=None)
        if not math.isfinite(float(norm)):
            raise self.not_finite()
        if self.options.clip is not None:
            torch.nn.utils.clip_grads_with_norm_(parameters, self.options.clip, norm)

        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.optimizer.step()
        self.step += 1
        if self.options.ema == 0.0:
            return
        # The running mean is in the optimiser's state, which checkpoints hold. At first
        # it moves faster, so that it soon forgets the weights of the start.
        early_share = self.step / (self.step + 9.0)
        share = min(self.options.ema, early_share)
        for parameter, state in self.optimizer.state.items():
            if MEAN not in state:
                state[MEAN] = parameter.detach().clone()
            state[MEAN].lerp_(parameter.detach(), 1.0 - share)

    def use_mean(self) -> AbstractContextManager[None]:
        """Replace the weights by their running means for a while, if there are any."""
        means = {}
        for parameter, state in self.optimizer.state.items():
            if MEAN in state:
                means[parameter] = state[MEAN]
        return replace_parameters(means)

    def not_finite(self) -> WorkFailedError:
        """Return the error that names step and terms."""
        broken = []
        for name, value in self.terms.items():
            if name != TOTAL and not torch.isfinite(value).all():
                broken.append(name)
        return WorkFailedError(
            f"the loss is not finite at step {self.step + 1}: "
            f"{', '.join(broken) or 'the gradient'}; lower training.learning_rate or "
            "set training.clip=1; checkpoint.safetensors holds the last good weights"
        )
