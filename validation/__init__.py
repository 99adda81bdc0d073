"""Validate the closed-box solver: Ghia's cavity, energy, decay; run from the clone."""
