"""GraphSAGE as a node update: a graph network of one's own."""

from torch import Generator, Tensor
from torch_geometric.nn import SAGEConv

from lagbench.baselines.operators.operator import Losses, Operator


class Sage(Operator):
    """Mean of the neighbours (Hamilton et al. 2017); edges come in by their sum in ``node``."""

    method = "GNS + SAGEConv"

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__(latent, hidden)
        self.conv = SAGEConv(2 * latent, latent)

    def forward(
        self, node: Tensor, edge_index: Tensor, edge: Tensor, *, generator: Generator | None = None
    ) -> tuple[Tensor, Losses]:
        """Return the update of each node, and no loss of its own."""
        return self.conv(node, edge_index), {}
