"""What a data set is, on disk."""

MATERIALS = ("liquid", "jelly", "snow", "rope")
"""Meaning of the values 0, 1, 2, 3 of ``material``."""

WALL = 4
"""Value of ``material`` of the particles of a fixed wall: models see them at their
places, and scores leave them out.
"""

PARTICLE_KINDS = (*MATERIALS, "wall")
"""Meaning of all values of ``material``."""

WALLS = ("left", "right", "bottom", "top")
"""Order of the walls in two dimensions; :data:`lagbench.data.box.WALL_NAMES` in any."""
