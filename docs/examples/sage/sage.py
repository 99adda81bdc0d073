"""GraphSAGE as an aggregation: a graph network of one's own."""

from torch import Generator, Tensor
from torch_geometric.nn import SAGEConv

from lagbench.baselines.operators.operator import Losses, Operator


class Sage(Operator):
    """Mean of the neighbours (Hamilton et al. 2017); edges come in by their sum in
    ``node``.
    """

    method = "GNS + SAGEConv"

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
        super().__init__(inputs, latent, hidden)
        self.conv = SAGEConv(inputs, latent)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return what each node gathers, and no loss of its own."""
        return self.conv(node, edge_index), {}
