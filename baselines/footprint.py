"""How large a model would be, told before it takes any memory.

Options come with a checkpoint, which may be a stranger's: a few bytes of text can ask for a model
of any size. Built on torch's device ``meta``, it has shapes and no numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import chain

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook
from torch.nn.parameter import is_lazy

from lagbench.errors import UnreadableFileError

from .baseline import Baseline
from .facts import Facts

__all__ = ["check_footprint"]

SPARE = 2**20
"""Numbers that a model may have beside those of its file: buffers that are not stored."""

PARTS = 1000
"""Tensors that it may have beside those of its file."""


def check_footprint(
    model: type[Baseline],
    options: Mapping[str, object],
    facts: Facts,
    weights: Mapping[str, Tensor],
    *,
    where: str,
) -> None:
    """Refuse to build a model that is larger than the weights that are meant for it.

    A model that cannot be built without numbers, as a stranger's baseline may be, passes.

    Args:
        model: the baseline.
        options: its options, plain values.
        facts: public figures of the data set.
        weights: parameters and buffers of the file.
        where: what to call the file in messages.

    Raises:
        UnreadableFileError: the options ask for more than the file holds.
    """
    held = _held(weights)
    try:
        with _parts_bound(len(weights) + PARTS), torch.device("meta"):
            built = model.build(options, facts)
        asked = _numbers(built)
    except _TooManyPartsError as error:
        raise _too_large(where, f"weights for {len(weights)} tensors", f"options for {error}") from None
    except (RuntimeError, TypeError) as error:
        if "overflow" not in str(error):
            return
        raise _too_large(where, f"weights of {held} numbers", str(error).split("\n")[0][:200]) from None
    if asked > held + SPARE:
        raise _too_large(where, f"weights of {held} numbers", f"options for {asked}")


class _TooManyPartsError(Exception):
    """More parameters than the file has tensors."""


def _held(weights: Mapping[str, Tensor]) -> int:
    """Return how many numbers a file holds: tensors that share their bytes count once."""
    stored = {
        value.untyped_storage().data_ptr(): value.untyped_storage().nbytes() // value.element_size()
        for value in weights.values()
    }
    return sum(stored.values())


def _numbers(model: nn.Module) -> int:
    tensors = chain(model.parameters(), model.buffers())
    return sum(tensor.numel() for tensor in tensors if not is_lazy(tensor))


@contextmanager
def _parts_bound(most: int) -> Iterator[None]:
    """Stop whoever registers more parameters than so many: layers without number take memory too."""
    count = 0

    def counted(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal count
        count += parameter is not None
        if count > most:
            raise _TooManyPartsError(f"more than {most}")

    hook = register_module_parameter_registration_hook(counted)
    try:
        yield
    finally:
        hook.remove()


def _too_large(where: str, expected: str, got: str) -> UnreadableFileError:
    return UnreadableFileError(
        "the options ask for a larger model than the weights that come with them",
        where=where,
        expected=expected,
        got=got,
        fix="do not trust the file, or train anew",
    )
