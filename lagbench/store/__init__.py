"""Data sets in a store: a root that is a URL, as ``s3://``, ``https://``, ``file://``.

``--root s3://bucket/prefix`` means a folder of the user's cache that holds copies of
the store's objects, see :mod:`lagbench.data.layout`. *Fetching* moves bytes over a line
(:mod:`.fetch`) into the working copy (:mod:`.copy`), a *publication* puts them back
(there too); :mod:`.objects` reads, lists and puts. docs/scaling.md has the
rules.
"""
