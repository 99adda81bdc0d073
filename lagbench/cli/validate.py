"""The command validate, and the option that says which split predictions are for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lagbench.submission.validation import validate

from .options import JsonFlag, QuietFlag, RootOption, option
from .output import print_result

ExpectedSplitOption = Annotated[
    str | None,
    option(
        "--split NAME",
        "Refuse predictions for another split; a local split is named by its folder.",
    ),
]


def validate_command(
    predictions: Annotated[
        Path, typer.Argument(metavar="FILE", help="A predictions.nc.")
    ],
    split: ExpectedSplitOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check a predictions.nc; print every error and how to fix it."""
    result = validate(predictions, split=split, root=root)
    print_result(result, [str(result)], as_json=as_json, quiet=quiet)
    raise typer.Exit(result.exit_code)
