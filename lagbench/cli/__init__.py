"""The command line: every command is a thin shell over one function of the package.

:mod:`.commands` lists the commands. The module of a command is imported when the
command runs or shows its help.
"""
