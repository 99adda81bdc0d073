"""Groups of commands whose modules are imported only when a command is called."""

from __future__ import annotations

import functools
import importlib
from dataclasses import dataclass
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command


@dataclass(frozen=True, kw_only=True)
class CommandEntry:
    """A command as its group lists it, without its code."""

    name: str
    # "module:function", the module below lagbench.cli
    target: str
    # line of the group's help; the docstring of the function begins with it too
    summary: str
    # words of a call that the help of the command shows, without "lagbench"
    example: str


class LazyCommand(TyperCommand):
    """Stands for a command in its group and loads it when it is called."""

    def __init__(self, entry: CommandEntry) -> None:
        super().__init__(entry.name, help=entry.summary)
        self._entry = entry

    @functools.cached_property
    def loaded(self) -> Any:  # noqa: ANN401 (typer does not export its class of commands)
        """The command itself, with its options."""
        module_name, _, function_name = self._entry.target.partition(":")
        module = importlib.import_module(f"lagbench.cli.{module_name}")
        function = getattr(module, function_name)
        app = typer.Typer(add_completion=False)
        register = app.command(
            self._entry.name, epilog=f"Example: lagbench {self._entry.example}"
        )
        register(function)
        return get_command(app)

    def make_context(self, *args: Any, **options: Any) -> Any:  # noqa: ANN401
        """Return a context of the command itself, which runs instead of this one."""
        return self.loaded.make_context(*args, **options)


class LazyGroup(TyperGroup):
    """A group of lazy commands; other commands of the group come after them."""

    entries: ClassVar[tuple[CommandEntry, ...]] = ()

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        commands: dict[str, Any] = {}
        for entry in self.entries:
            commands[entry.name] = LazyCommand(entry)
        commands.update(self.commands)
        self.commands = commands
