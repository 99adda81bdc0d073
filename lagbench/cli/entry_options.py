"""Options of ``lagbench submit`` that describe an entry, each of the name of its key."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = [
    "AffiliationOption",
    "AuthorsOption",
    "CodeOption",
    "CommandOption",
    "DateOption",
    "FilesArgument",
    "FloorOption",
    "FloorSizeOption",
    "HardwareOption",
    "LicenceOption",
    "MethodOption",
    "NameOption",
    "NotesOption",
    "PaperOption",
    "ParametersOption",
    "ReplaceFlag",
    "ScoredByOption",
    "SolverOption",
    "SourceOption",
    "TrainingOption",
    "UrlsOption",
    "option",
]


def option(name: str, metavar: str, text: str) -> Any:  # noqa: ANN401 (what typer says of it)
    """Return what typer wants to know of an option."""
    return typer.Option(name, metavar=metavar, help=text)


FilesArgument = Annotated[
    list[Path] | None, typer.Argument(metavar="FILE...", help="A predictions.nc; one per seed.")
]
SourceOption = Annotated[Path | None, option("--from", "FILE", "YAML of the keys below; options win.")]
MethodOption = Annotated[str | None, option("--method", "ID", "Names the entry, as in my-model.")]
NameOption = Annotated[str | None, option("--name", "TEXT", "What the method is called.")]
AuthorsOption = Annotated[list[str] | None, option("--author", "NAME", "Repeatable.")]
AffiliationOption = Annotated[str | None, option("--affiliation", "TEXT", "Of the authors.")]
LicenceOption = Annotated[str | None, option("--licence", "NAME", "Of the code, as in MIT.")]
CodeOption = Annotated[str | None, option("--code", "URL", "Where the code is.")]
PaperOption = Annotated[str | None, option("--paper", "URL", "Where the paper is.")]
DateOption = Annotated[str | None, option("--date", "YYYY-MM-DD", "Of the submission; today by default.")]
NotesOption = Annotated[str | None, option("--notes", "TEXT", "What readers should know.")]
TrainingOption = Annotated[str | None, option("--training", "TEXT", "What it was trained on.")]
ParametersOption = Annotated[int | None, option("--parameters", "N", "Trainable parameters.")]
HardwareOption = Annotated[str | None, option("--hardware", "TEXT", "Machine of the training.")]
CommandOption = Annotated[str | None, option("--command", "TEXT", "What makes the predictions again.")]
SolverOption = Annotated[
    float | None,
    option("--solver-seconds-per-frame", "S", "Of our solver on the same machine: lagbench bench solver."),
]
UrlsOption = Annotated[list[str] | None, option("--url", "URL", "Where FILE can be had; one per FILE.")]
ScoredByOption = Annotated[str | None, option("--scored-by", "NAME", "Who runs this; else the author.")]
FloorOption = Annotated[str | None, option("--floor", "NAME", "Instead of FILE: the name of a floor.")]
FloorSizeOption = Annotated[str | None, option("--size", "NAME", "With --floor: tiny, mini or full.")]
ReplaceFlag = Annotated[bool, typer.Option("--replace", help="Replace the entry of that name.")]
