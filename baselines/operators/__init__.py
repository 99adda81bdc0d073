"""Aggregations of the graph network: one operator, one file.

A processor layer first updates its edges, ``m_ij = MLP(e_ij, x_i, x_j)``, then lets the operator
gather, ``a_i = Operator(s, m)_i``, then updates its nodes by an MLP of ``[x_i, a_i]``: the same MLP
after every operator. The one rule for edges: every operator gets the same two things, node inputs
``s_i = [x_i, sum_j m_ij]``, into which the layer's edge updates are summed, and the edge updates
``m_ij`` themselves. A convolution that takes edge features (``edge_dim``; the relative position
of PointNet) is given the latter too; one that takes none (SuperGATConv) has the sums. The
network's option ``sum_messages: false`` leaves the sums out, ``s_i = x_i``.

Encoder, edge update, node MLP with its LayerNorm, residuals of nodes and edges and decoder are the
network's, the same for all.
"""
