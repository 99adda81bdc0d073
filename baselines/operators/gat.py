"""GAT and GATv2: attention from a node, its neighbour and their edge.

GAT adds one score of each of them; in GATv2 the ranking of neighbours depends on the
node.
"""

from __future__ import annotations

from torch_geometric.nn import GATConv, GATv2Conv

from .operator import Convolution


class GAT(Convolution):
    r"""Graph attention of Velickovic et al. (2018): PyG's GATConv.

    .. math::

        a_i &= \sum_{j \in N(i) \cup \{i\}} \alpha_{ij} \Theta s_j \\
        \alpha_{ij} &= \mathrm{softmax}_j\,\mathrm{LeakyReLU}(
            b_r^T \Theta s_i + b_s^T \Theta s_j + b_e^T \Theta_e m_{ij})

    The edge of a particle with itself is the mean of those that it receives.
    """

    method = "GNS + GATConv"
    layer = GATConv


class GATv2(Convolution):
    r"""Dynamic graph attention of Brody et al. (2022): PyG's GATv2Conv.

    .. math::

        a_i &= \sum_{j \in N(i) \cup \{i\}} \alpha_{ij} \Theta_s s_j \\
        \alpha_{ij} &= \mathrm{softmax}_j\,b^T \mathrm{LeakyReLU}(
            \Theta_r s_i + \Theta_s s_j + \Theta_e m_{ij})

    The edge of a particle with itself is the mean of those that it receives.
    """

    method = "GNS + GATv2Conv"
    layer = GATv2Conv
