"""Linear and normalising layers, made fast and exact on CPUs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["LayerNorm", "Linear", "linear"]


class _OneDNNLinear(torch.autograd.Function):
    """A product by oneDNN, whose kernels go by what a CPU can do.

    MKL, which torch calls for float32, keeps to AVX2 on CPUs that are not Intel's: half as fast.
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
    x, weight = x.contiguous(), weight.contiguous()
    product: Tensor = torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
    return product


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    r"""Return :math:`x W^T + b`, as ``torch.nn.functional.linear`` does.

    Args:
        x: rows, shape [row, input].
        weight: shape [output, input].
        bias: shape [output].
    """
    if _fast(x, weight):
        product: Tensor = _OneDNNLinear.apply(x, weight, bias)  # type: ignore[no-untyped-call]
        return product
    return nn.functional.linear(x, weight, bias)


def _fast(x: Tensor, weight: Tensor) -> bool:
    """Return whether oneDNN can and should do it: rows of float32 on a CPU."""
    return (
        x.device.type == "cpu"
        and x.dim() == 2
        and x.numel() > 0
        and x.dtype == weight.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and not torch.compiler.is_compiling()
        and hasattr(torch.ops.mkldnn, "_linear_pointwise")
    )


class Linear(nn.Linear):
    """A linear layer by :func:`linear`; its weights are those of torch's."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the product, shape [row, output]."""
        return linear(input, self.weight, self.bias)


class LayerNorm(nn.LayerNorm):
    """A LayerNorm whose weights learn in bfloat16 too.

    On CPUs, torch sums their gradients over the rows in bfloat16: 5,000 ones sum to 512. Here
    they are those of a product and a sum, which torch adds up in float32.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Return rows of mean 0 and deviation 1, times weight, plus bias."""
        if input.device.type != "cpu" or input.dtype != torch.bfloat16:
            return super().forward(input)
        normal = nn.functional.layer_norm(input, self.normalized_shape, eps=self.eps)
        return torch.addcmul(self.bias.to(input.dtype), normal, self.weight.to(input.dtype))
