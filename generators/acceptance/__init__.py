"""Is the physics of the closed box right: Ghia, energy, decay."""
