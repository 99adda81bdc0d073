"""Data sets in an object store: objects by URL, their lock, the working copy that files are read from.

``--root s3://bucket/prefix`` means a folder of the user's cache that holds copies of the store's
objects, see :mod:`lagbench.data.layout`. :mod:`.bringing` fills it for readers,
:mod:`.publication` empties it into the store for writers. docs/scaling.md has the rules.
"""
