"""The draft of an entry: everything but its scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.errors import ChecksFailedError
from lagbench.submission.format import Header
from lagbench.submission.issues import ValidationResult

from .entry import About, Entry, Prediction
from .entry_file import Model, examine, format_issues
from .folder import Place


@dataclass(frozen=True, kw_only=True)
class PredictionsFile:
    """A valid file of predictions."""

    path: Path
    header: Header
    sha256: str  # content hash
    validation: ValidationResult
    # share of positions beyond the box, where the validation warns
    outside_share: float | None


@dataclass(frozen=True, kw_only=True)
class Draft:
    """An entry before its predictions are scored."""

    place: Place
    about: About
    predictions: Sequence[Prediction]  # of the files that are submitted
    weight_paths: Sequence[Path | None]  # weights of each of them
    rivals: Mapping[Path, Entry]  # other active entries of the data set
    extended: Entry | None  # the entry that gets more seeds

    @property
    def entries_to_differ_from(self) -> Mapping[Path, Entry]:
        """Entries whose predictions this one cannot have."""
        return find_entries_to_differ_from(self.rivals, self.extended)


def find_entries_to_differ_from(
    rivals: Mapping[Path, Entry], extended: Entry | None
) -> Mapping[Path, Entry]:
    """Return the entries whose predictions a new one cannot have."""
    if extended is None:
        return rivals
    return {**rivals, extended.yaml_path: extended}


def require_valid(
    kind: type[Model],
    keys: Mapping[str, object],
    *,
    where: Path | None = None,
    fix: str = "say it otherwise in --from meta.yaml; docs/submitting.md describes "
    "the keys",
) -> Model:
    """Return an entry, or a part of one, from its keys.

    Raises:
        ChecksFailedError: a key does not fit the schema.
    """
    model, issues = examine(kind, keys)
    if model is None:
        raise ChecksFailedError(
            "the entry does not fit the schema",
            where="the description" if where is None else str(where),
            expected="known keys, with values of their kinds",
            got=format_issues(issues),
            fix=fix,
        )
    return model
