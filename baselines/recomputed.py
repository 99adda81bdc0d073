"""An edge update that keeps no hidden layer: the backward pass computes them again."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from .dense import linear

__all__ = ["Recomputed", "edge_map"]

PIECE = 8192
"""Edges at a time: a hidden layer of 128 then has 4 MB and stays in the cache."""


def edge_map(
    rest: nn.Module, edge_index: Tensor, edge: Tensor, sender: Tensor, receiver: Tensor, weight: Tensor
) -> Tensor:
    r"""Return :math:`f(s_j + r_i + W_e e_{ij})`, shape [edge, output].

    Args:
        rest: f, from the first hidden layer on.
        edge_index: senders and receivers, shape [2, edge].
        edge: edge latents, shape [edge, latent].
        sender: first layer of each particle as a sender, shape [particle, hidden].
        receiver: first layer of each particle as a receiver, shape [particle, hidden].
        weight: W_e, shape [hidden, latent].
    """
    hidden = _gathered(edge_index, sender, receiver)
    hidden += linear(edge, weight)  # In place: an edge tensor of a full scenario is 32 MB.
    update: Tensor = rest(hidden)
    return update


def _gathered(edge_index: Tensor, sender: Tensor, receiver: Tensor) -> Tensor:
    both = receiver.index_select(0, edge_index[1])
    both += sender.index_select(0, edge_index[0])
    return both


def _pieces(edges: int) -> list[slice]:
    return [slice(start, start + PIECE) for start in range(0, edges, PIECE)]


class Recomputed(torch.autograd.Function):
    """:func:`edge_map` by pieces of edges, which keeps its arguments only."""

    @staticmethod
    def forward(ctx: Any, rest: nn.Module, *tensors: Tensor) -> Tensor:  # noqa: ANN401
        """Return the update of each edge; arguments are those of :func:`edge_map` and f's parameters."""
        ctx.save_for_backward(*tensors)
        ctx.rest = rest
        ctx.autocast = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")
        edge_index, edge, sender, receiver, weight = tensors[:5]
        updates = [
            edge_map(rest, edge_index[:, piece], edge[piece], sender, receiver, weight)
            for piece in _pieces(len(edge))
        ]
        return torch.cat(updates)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        """Return the gradients of all tensors."""
        edge_index, edge, sender, receiver, weight, *parameters = ctx.saved_tensors
        of_edge = torch.empty_like(edge)
        of_sender, of_receiver = torch.zeros_like(sender), torch.zeros_like(receiver)
        of_weights = [torch.zeros_like(weight) for weight in (weight, *parameters)]
        enabled, dtype = ctx.autocast
        for piece in _pieces(len(edge)):
            index = edge_index[:, piece]
            with torch.enable_grad(), torch.autocast("cpu", dtype, enabled=enabled):
                some = edge[piece].detach().requires_grad_()
                hidden = _gathered(index, sender.detach(), receiver.detach()).requires_grad_()
                update = ctx.rest(hidden + linear(some, weight))
            wanted = [hidden, some, weight, *parameters]
            of_hidden, of_edge[piece], *own = torch.autograd.grad(update, wanted, grads[0][piece])
            of_sender.index_add_(0, index[0], of_hidden)
            of_receiver.index_add_(0, index[1], of_hidden)
            torch._foreach_add_(of_weights, own)
        return None, None, of_edge, of_sender, of_receiver, *of_weights
