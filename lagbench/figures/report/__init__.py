"""The report: one HTML page with the figures of the thesis, from score cards and
predictions.

``report.write_report`` needs no plotting library, no network and no script: charts are
SVG, pictures small PNG files inside the page.
"""
