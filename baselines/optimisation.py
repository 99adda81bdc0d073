"""The optimiser steps of a training: loss, gradient, AdamW, and the mean of weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager

import torch
from torch import Tensor
from torch.optim import AdamW

from lagbench.errors import UnreadableFileError, UsageError, WorkFailedError

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
        optimizer_state: state of the optimiser after those; None at the start.

    Raises:
        UsageError: the model has no parameters.
        UnreadableFileError: the state of the optimiser is not that of this model.
    """

    def __init__(
        self,
        model: Baseline,
        options: TrainingOptions,
        *,
        steps: int,
        processes: int = 1,
        step: int = 0,
        optimizer_state: Mapping[str, Tensor] | None = None,
    ) -> None:
        if next(model.parameters(), None) is None:
            raise UsageError(
                "a model without parameters",
                where=type(model).__qualname__,
                expected="one that learns",
                got="no parameters",
                fix="write its predictions without a training: "
                "lagbench.submission.write",
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
        if optimizer_state is not None:
            self._load_optimizer_state(optimizer_state)

    def _load_optimizer_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue with the state that an optimiser of an earlier run had."""
        parameters = dict(self.model.named_parameters())
        for key, value in tensors.items():
            name, _, kind = key.rpartition("/")
            parameter = parameters.get(name)
            shape = (
                torch.Size() if kind == "step" else getattr(parameter, "shape", None)
            )
            if parameter is None or value.shape != shape:
                raise UnreadableFileError(
                    f"the state {key} of the optimiser does not fit the model; train "
                    "anew with --fresh"
                )
            device = "cpu" if kind == "step" else parameter.device
            self.optimizer.state[parameter][kind] = value.to(device)

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
        factor = self.options.schedule.factor_at(
            self.step, steps=self.steps, warmup=self.options.warmup_steps
        )
        return self._base_rate * factor

    def weigh(self, terms: object) -> Tensor:
        """Return the loss, the weighted sum of the terms; keep the terms.

        Raises:
            UsageError: the terms are no dict of scalars by name, one has the name of
                their sum, or no parameter changes them.
            WorkFailedError: every term has weight 0.
        """
        where = f"{type(self.model).__qualname__}.forward"
        checked_terms = _check_terms(terms, where=where)
        weighted = []
        for name, term in checked_terms.items():
            weight = self.model.weights.get(name, 1.0)
            if weight != 0:
                weighted.append(term.reshape(()) * weight)
        names = ", ".join(checked_terms)
        if not weighted:
            raise WorkFailedError(
                "every term of the loss has weight 0",
                where="model.loss",
                expected="a term with a weight above 0",
                got=names,
                fix="raise one of them, as in --set model.loss.acceleration=1",
            )
        total = torch.stack(weighted).sum()
        if not total.requires_grad:
            raise UsageError(
                "nothing can be learned from the loss",
                where=where,
                expected="a term, of a weight above 0, that depends on the model's "
                "parameters",
                got=names,
                fix="mend that class, or the weights",
            )
        self.terms = {}
        for name, term in checked_terms.items():
            self.terms[name] = term.detach()
        self.terms[TOTAL] = total.detach()
        return total

    def make_step(self, loss: Tensor) -> None:
        """Make a step down the gradient of a loss.

        Raises:
            WorkFailedError: the gradient is not finite; the weights stay as they are.
        """
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._clip_gradient()
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.optimizer.step()
        self.step += 1
        if self.options.ema > 0.0:
            self._update_mean()

    def _clip_gradient(self) -> None:
        """Clip the gradient, which over several processes is their mean by now.

        So all processes stop at a gradient that is not finite.
        """
        parameters = list(self.model.parameters())
        gradients = [p.grad for p in parameters if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients, foreach=None)
        if not math.isfinite(float(norm)):
            raise self.not_finite()
        if self.options.clip is not None:
            torch.nn.utils.clip_grads_with_norm_(parameters, self.options.clip, norm)

    def _update_mean(self) -> None:
        """Move the running mean towards the weights.

        It is in the optimiser's state, which checkpoints hold. At first it moves
        faster, so that it soon forgets the weights of the start.
        """
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
        if not broken:
            broken = ["none of the terms: the gradient"]
        return WorkFailedError(
            "the loss is not finite",
            where=f"step {self.step + 1}",
            expected="finite terms",
            got=f"NaN or infinite: {', '.join(broken)}",
            fix="lower training.learning_rate or set training.clip=1;"
            " checkpoint.safetensors holds the last good weights",
        )


def _check_terms(terms: object, *, where: str) -> Mapping[str, Tensor]:
    """Return loss terms; refuse anything but a dict of tensors of one number each.

    The log has the sum of the terms beside them, so no term may have its name.
    """
    if isinstance(terms, Mapping):
        values: Mapping[object, object] = terms
    else:
        values = {"no dict": terms}
    is_fit = isinstance(terms, Mapping) and len(terms) > 0
    shapes = []
    for name, value in values.items():
        if not isinstance(name, str) or name == TOTAL:
            is_fit = False
        if isinstance(value, Tensor):
            is_fit = is_fit and value.numel() == 1
            shapes.append(f"{name}: {value.shape}")
        else:
            is_fit = False
            shapes.append(f"{name}: {type(value).__name__}")
    if isinstance(terms, Mapping) and is_fit:
        return terms
    raise UsageError(
        "a model returned no loss",
        where=where,
        expected="a dict of terms, tensors of one number each, by names that are texts "
        f"and not {TOTAL!r}",
        got=", ".join(shapes) or "an empty dict",
        fix="mend that class; docs/baselines.md has an example",
    )
