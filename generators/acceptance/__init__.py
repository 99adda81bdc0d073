"""Is the physics right: Ghia, energy, settling."""
