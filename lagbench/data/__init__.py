"""What a data set is, on disk."""

MATERIALS = ("liquid", "jelly", "snow", "rope")
"""Meaning of the values 0, 1, 2, 3 of ``material``."""

WALLS = ("left", "right", "bottom", "top")
"""Order of the walls in two dimensions; :data:`lagbench.data.box.WALL_NAMES` in any."""
