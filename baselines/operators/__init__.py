"""Aggregations of the graph network: one operator, one file.

All operators share the rest of the network. Every operator gets the same two inputs of
a processor layer: the node inputs ``s_i = [x_i, sum_j m_ij]``, with the sums of the
layer's edge updates, and the edge updates ``m_ij`` themselves. A convolution that takes
edge features (``edge_dim``; the relative position of PointNet) is given the latter too;
one that takes none (SuperGATConv) has the sums.
"""
