"""The command line: each command is a thin shell over the function of its name.

Commands import what they need inside their bodies, so that ``lagbench --help`` loads
typer and rich only.
"""
