"""Encode, process, decode: the graph network that all operators share.

The layers below it are those of torch with faster or more exact kernels for CPUs.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from lagbench.baselines.operators.operator import Losses, Operator, sum_edges
from lagbench.errors import UsageError


class ProcessorLayer(nn.Module):
    r"""One round of message passing; everything but the aggregation is fixed.

    .. math::

        m_{ij} &= \mathrm{LayerNorm}(\mathrm{MLP}(e_{ij}, x_i, x_j)) \\
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
        operator_inputs = latent
        if sum_messages:
            operator_inputs = 2 * latent
        self.operator = operator(operator_inputs, latent, hidden)
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
        operator_input = node
        if self.sum_messages and self.operator.reads_nodes:
            message_sum = sum_edges(edge_index, message, len(node))
            operator_input = torch.cat([node, message_sum], dim=-1)

        output = self.operator(operator_input, edge_index, message, generator=generator)
        if not torch.compiler.is_compiling():
            _check_output(output, self.operator, nodes=len(node))
        aggregate, losses = output

        update_input = torch.cat([node, aggregate], dim=-1)
        next_node = node + self.update(update_input)
        next_edge = edge + message
        return next_node, next_edge, losses


def _check_output(output: object, operator: Operator, *, nodes: int) -> None:
    """Refuse an operator's output that is no pair of aggregates and losses.

    The operator may be a user's own, so it may return anything.
    """
    values: list[object] = [output]
    prefix = "alone: "
    if isinstance(output, tuple) and len(output) == 2:
        aggregate, losses = output
        if isinstance(losses, Mapping):
            values = [aggregate, *losses.values()]
            prefix = ""
    shapes: list[object] = []
    for value in values:
        if isinstance(value, Tensor):
            shapes.append(tuple(value.shape))
        else:
            shapes.append(type(value).__name__)

    expected_shape = (nodes, operator.latent)
    has_scalar_losses = all(shape == () for shape in shapes[1:])
    if not prefix and shapes[0] == expected_shape and has_scalar_losses:
        return
    raise UsageError(
        "an operator returned no pair of aggregates and losses",
        where=f"{type(operator).__qualname__}.forward",
        expected=f"a tensor of shape {expected_shape}, and a dict of losses of shape "
        f"(), which may be empty",
        got=prefix + ", ".join(map(str, shapes)),
        fix="mend that class; docs/extending.md has an example",
    )


class EncodeProcessDecode(nn.Module):
    """A graph network after Sanchez-Gonzalez et al. (2020), section 3.

    Two MLPs encode nodes and edges, processor layers with weights of their own update
    both, an MLP decodes the nodes. With latent 128 and 10 layers it has about 1.6 M
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
        outputs: int = 2,
    ) -> None:
        super().__init__()
        self.node_encoder = mlp([node_features, latent, latent, latent])
        self.edge_encoder = mlp([edge_features, latent, latent, latent])
        self.processor = nn.ModuleList()
        for _ in range(layers):
            layer = ProcessorLayer(
                operator,
                latent=latent,
                hidden=latent,
                sum_messages=sum_messages,
            )
            self.processor.append(layer)
        self.decoder = mlp([latent, latent, latent, outputs], norm=False)

    def compile_layers(self) -> None:
        """Compile the edges' encoder and the processor layers, for any number of edges.

        The layers have the same code, so one compilation serves all. All hidden layers
        then stay in memory until the backward pass.
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
        """Return the prediction and the operators' own losses.

        The prediction has the shape [particle, output]. Losses are means over the
        layers.
        """
        input_dtype = node.dtype
        node = self.node_encoder(node)
        edge = self.edge_encoder(edge)
        layer_losses: list[Losses] = []
        for layer in self.processor:
            node, edge, losses = layer(node, edge_index, edge, generator)
            layer_losses.append(losses)

        mean_losses = {}
        for name in layer_losses[0]:
            values = [losses[name] for losses in layer_losses]
            of_layers = torch.stack(values)
            mean_losses[name] = of_layers.mean()

        # Every frame adds the output to velocities: the three digits of bfloat16 are
        # too few for that.
        with torch.autocast(node.device.type, enabled=False):
            node = node.to(input_dtype)
            prediction = self.decoder(node)
        return prediction, mean_losses


class _OneDNNLinear(torch.autograd.Function):
    """A product by oneDNN, which chooses its kernels by the instructions of the CPU.

    MKL, which torch calls for float32, keeps to AVX2 on CPUs that are not Intel's: half
    as fast.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(x, weight)
        return _multiply(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        (grad,) = grads
        x, weight = ctx.saved_tensors
        needs_x, needs_weight, needs_bias = ctx.needs_input_grad
        x_grad = None
        weight_grad = None
        bias_grad = None
        if needs_x:
            # By the function itself, so that gradients have gradients too.
            x_grad = _OneDNNLinear.apply(grad, weight.t(), None)  # type: ignore[no-untyped-call]
        if needs_weight:
            weight_grad = grad.t() @ x
        if needs_bias:
            bias_grad = grad.sum(dim=0)
        return x_grad, weight_grad, bias_grad


def _multiply(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Return ``x W^T + b`` by oneDNN."""
    # Views of wider matrices would take a path a thousand times slower.
    x = x.contiguous()
    weight = weight.contiguous()
    product: Tensor = torch.ops.mkldnn._linear_pointwise(
        x, weight, bias, "none", [], ""
    )
    return product


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return ``x W^T + b``, as ``torch.nn.functional.linear`` does.

    The shapes are [row, input] and [output, input].
    """
    if _suits_onednn(x, weight, bias):
        product: Tensor = _OneDNNLinear.apply(x, weight, bias)  # type: ignore[no-untyped-call]
        return product
    return nn.functional.linear(x, weight, bias)


def _suits_onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> bool:
    """Return whether oneDNN can and should multiply x by the weight.

    It can for a non-empty matrix of float32 on a CPU that the weight fits, outside
    autocast and torch.compile, and should wherever it can: see :class:`_OneDNNLinear`.
    """
    if x.device.type != "cpu" or torch.is_autocast_enabled("cpu"):
        return False
    is_matrix = x.dim() == 2 and x.numel() > 0
    is_float32 = x.dtype == weight.dtype == torch.float32
    if not is_matrix or not is_float32:
        return False
    # torch's own error for other widths is easier to understand.
    if x.shape[1:] != weight.shape[1:]:
        return False
    if bias is not None:
        is_fit = bias.dtype == torch.float32 and bias.shape == weight.shape[:1]
        if not is_fit:
            return False
    if torch.compiler.is_compiling():
        return False
    return hasattr(torch.ops.mkldnn, "_linear_pointwise")


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
        weight = self.weight.to(input.dtype)
        bias = self.bias.to(input.dtype)
        return torch.addcmul(bias, normal, weight)


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

    Args:
        rest: f, all of an MLP after its first linear layer; it begins with ReLU.
        edge_index: senders j and receivers i, shape [2, edge].
        edge: latents e of the edges, shape [edge, latent].
        sender: parts s of the hidden layer, shape [particle, hidden].
        receiver: parts r of the hidden layer, shape [particle, hidden].
        weight: W_e, shape [hidden, latent].
    """
    hidden = _sum_of_ends(edge_index, sender, receiver)
    # In place: an edge tensor of a full scenario has 32 MB.
    hidden += linear(edge, weight)
    update: Tensor = rest(hidden)
    return update


def _sum_of_ends(edge_index: Tensor, sender: Tensor, receiver: Tensor) -> Tensor:
    """Return ``s_j + r_i`` of each edge, shape [edge, hidden]."""
    senders, receivers = edge_index
    sums = receiver.index_select(0, receivers)
    sums += sender.index_select(0, senders)
    return sums


def _split_edges(edges: int) -> list[slice]:
    """Return the pieces of so many edges."""
    pieces = []
    for start in range(0, edges, PIECE):
        end = start + PIECE
        pieces.append(slice(start, end))
    return pieces


class Recomputed(torch.autograd.Function):
    """:func:`edge_map` by pieces of edges, which keeps its arguments only."""

    @staticmethod
    def forward(ctx: Any, rest: nn.Module, *tensors: Tensor) -> Tensor:  # noqa: ANN401
        """Return the update of each edge.

        The tensors are the arguments of :func:`edge_map` and the parameters of f.
        """
        ctx.save_for_backward(*tensors)
        ctx.rest = rest
        ctx.autocast_enabled = torch.is_autocast_enabled("cpu")
        ctx.autocast_dtype = torch.get_autocast_dtype("cpu")
        edge_index, edge, sender, receiver, weight = tensors[:5]
        updates = []
        for piece in _split_edges(len(edge)):
            index = edge_index[:, piece]
            update = edge_map(rest, index, edge[piece], sender, receiver, weight)
            updates.append(update)
        return torch.cat(updates)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        """Return the gradients of all tensors; they have no gradients themselves."""
        (update_grad,) = grads
        edge_index, edge, sender, receiver, weight, *parameters = ctx.saved_tensors
        edge_grad = torch.empty_like(edge)
        sender_grad = torch.zeros_like(sender)
        receiver_grad = torch.zeros_like(receiver)
        weights = [weight, *parameters]
        weight_grads = [torch.zeros_like(each) for each in weights]

        for piece in _split_edges(len(edge)):
            index = edge_index[:, piece]
            senders, receivers = index
            with (
                torch.enable_grad(),
                torch.autocast("cpu", ctx.autocast_dtype, enabled=ctx.autocast_enabled),
            ):
                piece_edge = edge[piece].detach().requires_grad_()
                ends = _sum_of_ends(index, sender.detach(), receiver.detach())
                ends = ends.requires_grad_()
                hidden = ends + linear(piece_edge, weight)
                update = ctx.rest(hidden)
            ends_grad, piece_grad, *piece_weight_grads = torch.autograd.grad(
                update, [ends, piece_edge, *weights], update_grad[piece]
            )
            edge_grad[piece] = piece_grad
            sender_grad.index_add_(0, senders, ends_grad)
            receiver_grad.index_add_(0, receivers, ends_grad)
            torch._foreach_add_(weight_grads, piece_weight_grads)
        return None, None, edge_grad, sender_grad, receiver_grad, *weight_grads


# larger edge tensors on a CPU are recomputed in the backward pass [byte]
LARGEST_KEPT = 24e6


def mlp(widths: list[int], *, norm: bool = True) -> nn.Sequential:
    """Return linear layers with ReLU between them, with ``norm`` a LayerNorm last."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers.append(Linear(inputs, outputs))
        layers.append(nn.ReLU(inplace=True))
    layers.pop()  # no ReLU after the last
    if norm:
        layers.append(LayerNorm(widths[-1]))
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
        later_layers = mlp([hidden, hidden, latent])
        self.rest = nn.Sequential(nn.ReLU(inplace=True), *later_layers)

    def forward(self, edge: Tensor, node: Tensor, edge_index: Tensor) -> Tensor:
        """Return the update of each edge, shape [edge, latent]."""
        parts = self.first.weight.tensor_split(3, dim=1)
        edge_weight, receiver_weight, sender_weight = parts
        sender = linear(node, sender_weight)
        receiver = linear(node, receiver_weight, self.first.bias)
        if self._is_too_large(edge):
            tensors = (edge_index, edge, sender, receiver, edge_weight)
            update: Tensor = Recomputed.apply(  # type: ignore[no-untyped-call]
                self.rest, *tensors, *self.rest.parameters()
            )
            return update
        return edge_map(self.rest, edge_index, edge, sender, receiver, edge_weight)

    def _is_too_large(self, edge: Tensor) -> bool:
        """Return whether a hidden layer of these edges is not to be kept in memory."""
        if edge.device.type != "cpu" or torch.compiler.is_compiling():
            return False
        dtype = edge.dtype
        if torch.is_autocast_enabled("cpu"):
            dtype = torch.get_autocast_dtype("cpu")
        hidden_bytes = len(edge) * self.first.out_features * dtype.itemsize
        return hidden_bytes > LARGEST_KEPT
