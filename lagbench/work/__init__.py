"""Who computes: processes, clusters, progress."""
