"""Aggregations of the graph network: one operator, one file; all else is the network's,
the same for all.

The one rule for edges: every operator gets the same two things of a processor layer,
node inputs ``s_i = [x_i, sum_j m_ij]``, into which the layer's edge updates are summed,
and the edge updates ``m_ij`` themselves. A convolution that takes edge features
(``edge_dim``; the relative position of PointNet) is given the latter too; one that
takes none (SuperGATConv) has the sums. The network's option ``sum_messages: false``
leaves the sums out, ``s_i = x_i``.
"""
