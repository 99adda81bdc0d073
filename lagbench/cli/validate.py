"""The command validate."""

from __future__ import annotations

from pathlib import Path

from lagbench.submission.validation import validate

from .options import ExpectedSplitOption, JsonFlag, QuietFlag, RootOption
from .output import print_result


def validate_command(
    predictions: Path,
    /,
    *,
    split: ExpectedSplitOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Check a predictions.nc; print every error and how to fix it.

    Args:
        predictions: A predictions.nc.
    """
    result = validate(predictions, split=split, root=root)
    print_result(result, [str(result)], as_json=as_json, quiet=quiet)
    return result.exit_code
