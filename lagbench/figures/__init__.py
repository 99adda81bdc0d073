"""Drawings of data and scores: pictures, films, charts, tables and HTML.

Modules at this level know data only. The score report stands in ``figures.report``.
"""
