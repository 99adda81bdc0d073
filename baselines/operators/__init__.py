"""Node updates of the graph network: one operator, one file.

A processor layer first updates its edges, ``m_ij = MLP(e_ij, x_i, x_j)``, then its nodes by the
operator. The one rule for edge features: every operator gets the same two things, node inputs
``[x_i, sum_j m_ij]``, into which the layer's edge updates are summed, and the edge updates
``m_ij`` themselves. A convolution that takes edge features (``edge_dim``; the relative position
of PointNet) is given the latter too; one that takes none (SuperGATConv) has the sums.

Encoder, edge update, LayerNorm after the operator, residuals of nodes and edges and decoder are
the network's, the same for all.
"""
