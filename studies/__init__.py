"""Studies made with the package: what one paper or thesis needs and no user installs.

Run them from a clone: ``python -m studies.results``, ``python -m studies.thesis``.
"""
