"""Reference models: what they are, how they are trained, what they predict.

Nothing here is imported by ``import lagbench``; this package needs the extra
``baselines``.
"""
