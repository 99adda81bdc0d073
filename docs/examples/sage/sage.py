"""GraphSAGE as the operator of a graph network: an example of your own model."""

from torch import Generator, Tensor
from torch_geometric.nn import SAGEConv

from lagbench.baselines.operators.operator import Losses, Operator


class Sage(Operator):
    """Mean over the neighbours (Hamilton et al. 2017).

    SAGEConv takes no edge features. But the input ``node`` contains the sum of the
    messages to each particle, and the messages depend on the edge features.
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
        """Return the aggregated features of each node, and no further loss term."""
        return self.conv(node, edge_index), {}
