"""What a data set is, on disk."""

MATERIALS = ("liquid", "jelly", "snow", "rope")
"""Meaning of the values 0, 1, 2, 3 of ``material``."""

WALLS = ("left", "right", "bottom", "top")
"""Order of the walls wherever an array has a wall axis."""
