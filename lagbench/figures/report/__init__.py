"""The report: one HTML page with the figures of the thesis.

It is made from score reports and predictions. ``report.write_report`` needs no plotting
library, no network and no script: charts are SVG, pictures small PNG files in the page.
"""
