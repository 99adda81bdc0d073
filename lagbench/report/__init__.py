"""The report: one HTML page with the figures of the thesis, from score cards and predictions.

``write_report`` needs no plotting library, no network and no script: charts are SVG, pictures
small PNG files inside the page.
"""

from __future__ import annotations

from .report import FILE_NAME, render, write_report

__all__ = ["FILE_NAME", "render", "write_report"]
