"""Encode, process, decode: the graph network that all six operators share, and its
layers for CPUs.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from lagbench.baselines.operators.operator import Losses, Operator, summed
from lagbench.errors import UsageError


class ProcessorLayer(nn.Module):
    r"""One round of message passing; everything but the aggregation is fixed.

    .. math::

        m_{ij} &= \mathrm{MLP}(e_{ij}, x_i, x_j) \\
        e_{ij} &\leftarrow e_{ij} + m_{ij} \\
        s_i &= [x_i \Vert \textstyle\sum_j m_{ij}] \\
        a_i &= \mathrm{Operator}(s, m)_i \\
        x_i &\leftarrow x_i + \mathrm{LayerNorm}(\mathrm{MLP}([x_i \Vert a_i]))

    MLPs have two hidden layers. Where messages are not summed, :math:`s_i = x_i`.
    """

    def __init__(
        self,
        operator: type[Operator],
        *,
        latent: int,
        hidden: int,
        sum_messages: bool = True,
    ) -> None:
        super().__init__()
        self.sum_messages = sum_messages
        self.message = EdgeMLP(latent, hidden)
        self.operator = operator((1 + sum_messages) * latent, latent, hidden)
        self.update = mlp([2 * latent, hidden, hidden, latent])

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor, Losses]:
        """Return updated nodes and edges and the operator's own losses."""
        message = self.message(edge, node, edge_index)
        given = node
        if self.sum_messages and self.operator.reads_nodes:
            given = torch.cat([node, summed(edge_index, message, len(node))], dim=-1)
        answer = self.operator(given, edge_index, message, generator=generator)
        if (
            not torch.compiler.is_compiling()
        ):  # an operator of a user's own may return anything
            pair = (
                isinstance(answer, tuple)
                and len(answer) == 2
                and isinstance(answer[1], Mapping)
            )
            if pair:
                held = [answer[0], *answer[1].values()]
            else:
                held = [answer]
            shapes = [
                tuple(one.shape) if isinstance(one, Tensor) else type(one).__name__
                for one in held
            ]
            wanted = (len(node), self.operator.latent)
            if (
                not pair
                or shapes[0] != wanted
                or any(shape != () for shape in shapes[1:])
            ):
                raise UsageError(
                    "an operator returned no pair of what is gathered and losses",
                    where=f"{type(self.operator).__qualname__}.forward",
                    expected=f"a tensor of shape {wanted}, and a dict of losses of "
                    f"shape (),"
                    " which may be empty",
                    got=("" if pair else "alone: ") + ", ".join(map(str, shapes)),
                    fix="mend that class; docs/extending.md has an example",
                )
        gathered, losses = answer
        update = self.update(torch.cat([node, gathered], dim=-1))
        return node + update, edge + message, losses


class EncodeProcessDecode(nn.Module):
    """A graph network after Sanchez-Gonzalez et al. (2020), section 3.

    Two MLPs encode nodes and edges, processor layers of their own weights update both,
    an MLP decodes the nodes. With latent 128 and 10 layers it has about 1.6 M
    parameters.
    """

    def __init__(
        self,
        operator: type[Operator],
        *,
        node_features: int,
        edge_features: int,
        latent: int = 128,
        layers: int = 10,
        sum_messages: bool = True,
    ) -> None:
        super().__init__()
        self.node_encoder = mlp([node_features, latent, latent, latent])
        self.edge_encoder = mlp([edge_features, latent, latent, latent])
        self.processor = nn.ModuleList(
            ProcessorLayer(
                operator, latent=latent, hidden=latent, sum_messages=sum_messages
            )
            for _ in range(layers)
        )
        self.decoder = mlp([latent, latent, latent, 2], norm=False)

    def compile_layers(self) -> None:
        """Compile the edges' encoder and the processor layers, for any number of edges.

        The layers are compiled once for all: their code is the same. All hidden layers
        are then kept.
        """
        for part in (self.edge_encoder, *self.processor):
            part.compile(dynamic=True)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the prediction, shape [particle, 2], and the operators' own losses,
        layer means.
        """
        given = node.dtype
        node = self.node_encoder(node)
        edge = self.edge_encoder(edge)
        losses: list[Losses] = []
        for layer in self.processor:
            node, edge, own = layer(node, edge_index, edge, generator)
            losses.append(own)
        means = {
            name: torch.stack([own[name] for own in losses]).mean()
            for name in losses[0]
        }
        # Three digits of bfloat16 are too few for what is added to velocities every
        # frame.
        with torch.autocast(node.device.type, enabled=False):
            return self.decoder(node.to(given)), means


class _OneDNNLinear(torch.autograd.Function):
    """A product by oneDNN, whose kernels go by what a CPU can do.

    MKL, which torch calls for float32, keeps to AVX2 on CPUs that are not Intel's: half
    as fast.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        (grad,), (x, weight) = grads, ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        return (
            _product(grad, weight.t(), None) if of_x else None,
            grad.t() @ x if of_weight else None,
            grad.sum(dim=0) if of_bias else None,
        )


def _product(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    # Views of wider matrices would take a path a thousand times slower.
    x = x.contiguous()
    weight = weight.contiguous()
    product: Tensor = torch.ops.mkldnn._linear_pointwise(
        x, weight, bias, "none", [], ""
    )
    return product


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return ``x W^T + b``, as ``torch.nn.functional.linear`` does; shapes [row,
    input], [output, input].
    """
    if _fast(x, weight):
        product: Tensor = _OneDNNLinear.apply(x, weight, bias)  # type: ignore[no-untyped-call]
        return product
    return nn.functional.linear(x, weight, bias)


def _fast(x: Tensor, weight: Tensor) -> bool:
    """Return whether oneDNN can and should do it: rows of float32 on a CPU."""
    rows = x.device.type == "cpu" and x.dim() == 2 and x.numel() > 0
    exact = x.dtype == weight.dtype == torch.float32 and not torch.is_autocast_enabled(
        "cpu"
    )
    known = not torch.compiler.is_compiling() and hasattr(
        torch.ops.mkldnn, "_linear_pointwise"
    )
    return rows and exact and known


class Linear(nn.Linear):
    """A linear layer by :func:`linear`; its weights are those of torch's."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the product, shape [row, output]."""
        return linear(input, self.weight, self.bias)


class LayerNorm(nn.LayerNorm):
    """A LayerNorm whose weights learn in bfloat16 too.

    On CPUs, torch sums their gradients over the rows in bfloat16: 5,000 ones sum to
    512. Here they are those of a product and a sum, which torch adds up in float32.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Return rows of mean 0 and deviation 1, times weight, plus bias."""
        if input.device.type != "cpu" or input.dtype != torch.bfloat16:
            return super().forward(input)
        normal = nn.functional.layer_norm(input, self.normalized_shape, eps=self.eps)
        return torch.addcmul(
            self.bias.to(input.dtype), normal, self.weight.to(input.dtype)
        )


# edges at a time: a hidden layer of 128 then has 4 MB and stays in the cache
PIECE = 8192


def edge_map(
    rest: nn.Module,
    edge_index: Tensor,
    edge: Tensor,
    sender: Tensor,
    receiver: Tensor,
    weight: Tensor,
) -> Tensor:
    """Return ``f(s_j + r_i + W_e e_ij)``, shape [edge, output].

    f is the rest of an MLP from its first hidden layer on, of which s and r, shape
    [particle, hidden], are the parts of a particle.
    """
    hidden = _gathered(edge_index, sender, receiver)
    hidden += linear(
        edge, weight
    )  # In place: an edge tensor of a full scenario is 32 MB.
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
        """Return the update of each edge; arguments are those of :func:`edge_map` and
        f's parameters.
        """
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
        of_sender = torch.zeros_like(sender)
        of_receiver = torch.zeros_like(receiver)
        of_weights = [torch.zeros_like(weight) for weight in (weight, *parameters)]
        enabled, dtype = ctx.autocast
        for piece in _pieces(len(edge)):
            index = edge_index[:, piece]
            with torch.enable_grad(), torch.autocast("cpu", dtype, enabled=enabled):
                some = edge[piece].detach().requires_grad_()
                hidden = _gathered(
                    index, sender.detach(), receiver.detach()
                ).requires_grad_()
                update = ctx.rest(hidden + linear(some, weight))
            wanted = [hidden, some, weight, *parameters]
            of_hidden, of_edge[piece], *own = torch.autograd.grad(
                update, wanted, grads[0][piece]
            )
            of_sender.index_add_(0, index[0], of_hidden)
            of_receiver.index_add_(0, index[1], of_hidden)
            torch._foreach_add_(of_weights, own)
        return None, None, of_edge, of_sender, of_receiver, *of_weights


# edge tensors above this size on a CPU are recomputed, not kept [byte]
LARGEST_KEPT = 24e6


def mlp(widths: list[int], *, norm: bool = True) -> nn.Sequential:
    """Return linear layers with ReLU between them, LayerNorm after the last."""
    layers: list[nn.Module] = []
    for width, following in pairwise(widths):
        layers += [Linear(width, following), nn.ReLU(inplace=True)]
    if norm:
        layers[-1:] = [LayerNorm(widths[-1])]
    else:
        layers[-1:] = []
    return nn.Sequential(*layers)


class EdgeMLP(nn.Module):
    r"""An MLP of an edge and its two ends, with a first layer per node.

    .. math:: m_{ij} = f(W_e e_{ij} + (W_r x_i + b) + W_s x_j)

    The first layer of an MLP on the concatenation :math:`[e_{ij}, x_i, x_j]` is linear
    in each part, so the products with nodes are taken once per node, not once per edge.

    Where one edge tensor on a CPU has more than 24 MB (a full scenario in float32),
    hidden layers are computed again in the backward pass, edges by pieces that fit the
    cache: a little time for half of the memory. Above 32 MB, glibc would also hand
    every tensor back to the system and pay for its pages again.
    """

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(3 * latent, hidden)
        self.rest = nn.Sequential(nn.ReLU(inplace=True), *mlp([hidden, hidden, latent]))

    def forward(self, edge: Tensor, node: Tensor, edge_index: Tensor) -> Tensor:
        """Return the update of each edge, shape [edge, latent]."""
        of_edge, of_receiver, of_sender = self.first.weight.tensor_split(3, dim=1)
        ends = linear(node, of_sender), linear(node, of_receiver, self.first.bias)
        mixed = torch.is_autocast_enabled(edge.device.type)
        if mixed:
            dtype = torch.get_autocast_dtype(edge.device.type)
        else:
            dtype = edge.dtype
        kept = len(edge) * self.first.out_features * dtype.itemsize
        if (
            edge.device.type == "cpu"
            and kept > LARGEST_KEPT
            and not torch.compiler.is_compiling()
        ):
            tensors = edge_index, edge, *ends, of_edge, *self.rest.parameters()
            update: Tensor = Recomputed.apply(self.rest, *tensors)  # type: ignore[no-untyped-call]
            return update
        return edge_map(self.rest, edge_index, edge, *ends, of_edge)
