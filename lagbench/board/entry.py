"""An entry of the leaderboard: one method on one split and size, as its YAML file says it.

Everything but the score block is written by whoever submits; the score block is written by
``lagbench submit`` alone. Strangers write these files, so every text has a length, every
number a range, links are http(s) and nothing else, and unknown keys are refused.
"""

from __future__ import annotations

import datetime
import enum
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    model_validator,
)

from lagbench.floors import FLOORS

from .folder import entry_path, score_paths

__all__ = [
    "ID",
    "LONGEST_TEXT",
    "MOST_SEEDS",
    "PATTERNS",
    "About",
    "CostEntry",
    "DataSet",
    "Entry",
    "FlagEntry",
    "PredictionEntry",
    "ScoreBlock",
    "ScoredFile",
    "Status",
    "Summary",
]

ID = r"^[a-z0-9]+(-[a-z0-9]+)*$"
"""What names a method: in file names, addresses and the page."""

WEB = r"^https?://[A-Za-z0-9][!#-&(-;=?-\[\]_a-z~]*$"
"""An address of the web, without spaces, quotes and what could end an HTML attribute."""

SHA256 = r"^[0-9a-f]{64}$"
RELEASE = r"^[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}$"
LABEL = r"^[a-z0-9_]+$"

PATTERNS: Mapping[str, str] = MappingProxyType(
    {
        ID: "small letters, digits and single hyphens, as in my-model",
        WEB: "an http:// or https:// address, without spaces and quotes",
        SHA256: "64 hexadecimal digits",
        RELEASE: "a version, as in 1.0.0",
        LABEL: "small letters, digits and underscores",
    }
)
"""What texts have to be, in words; people do not read regular expressions."""

LONGEST_ID = 60
LONGEST_TEXT = 1000
"""Longest text of an entry [characters]."""

MOST_SEEDS = 20
"""Most predictions, one per seed, of an entry."""

MOST_BYTES = 2**40


def _line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("holds characters that cannot be printed, such as line breaks")
    return text


def _lines(text: str) -> str:
    if not text.replace("\n", "").isprintable():
        raise ValueError("holds characters that cannot be printed")
    return text


def _inside(path: str) -> str:
    if path.startswith("/") or "\\" in path or any(part in ("", ".", "..") for part in path.split("/")):
        raise ValueError("is no path inside the leaderboard's folder: relative, without '..', parted by '/'")
    return path


def _date(value: object) -> object:
    return datetime.date.fromisoformat(value) if isinstance(value, str) else value


Name = Annotated[str, StringConstraints(pattern=ID, max_length=LONGEST_ID)]
Short = Annotated[str, StringConstraints(min_length=1, max_length=100), AfterValidator(_line)]
Long = Annotated[str, StringConstraints(max_length=LONGEST_TEXT), AfterValidator(_lines)]
Link = Annotated[str, StringConstraints(pattern=WEB, max_length=300)]
InnerPath = Annotated[
    str, StringConstraints(min_length=1, max_length=200), AfterValidator(_line), AfterValidator(_inside)
]
Hash = Annotated[str, StringConstraints(pattern=SHA256)]
Version = Annotated[str, StringConstraints(pattern=RELEASE)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Seconds = Annotated[float, Field(ge=1e-7, lt=1e9, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]


class Status(enum.StrEnum):
    """Where an entry stands in its life."""

    ACTIVE = "active"
    SUPERSEDED = "superseded"
    WITHDRAWN = "withdrawn"


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class DataSet(_Strict):
    """The data set that was predicted."""

    version: Version
    sha256: Hash


class PredictionEntry(_Strict):
    """One predictions.nc: where it is kept, if anywhere, and what it holds."""

    seed: Seed | None = None
    sha256: Hash = Field(description="content hash of the positions, as `lagbench score` prints it")
    url: Link | None = None
    path: InnerPath | None = Field(default=None, description="inside the leaderboard's folder")
    bytes: int | None = Field(default=None, gt=0, lt=MOST_BYTES, description="length of the file")


class CostEntry(_Strict):
    """What a predicted frame costs, and what the solver takes on the same machine."""

    seconds_per_frame: Seconds
    device: Short
    solver_seconds_per_frame: Seconds | None = None


class FlagEntry(_Strict):
    """A flag of the scorer or a warning of the validation."""

    name: Annotated[str, StringConstraints(pattern=LABEL, max_length=LONGEST_ID)]
    reasons: Annotated[tuple[Long, ...], Field(max_length=20, strict=False)] = ()


class Summary(_Strict):
    """A metric over scenarios and seeds; null where undefined."""

    mean: Number | None
    std: Number | None = Field(description="sample standard deviation over seeds; null for one")
    low: Number | None = Field(description="lower bound of the 95 % interval over scenarios")
    high: Number | None


class ScoredFile(_Strict):
    """The score file of one predictions.nc, and what the scorer said beside its numbers."""

    sha256: Hash = Field(description="of the score file")
    predictions_sha256: Hash
    diverged_at: Annotated[dict[int, int], Field(max_length=10_000)] = Field(default_factory=dict)
    flags: Annotated[tuple[FlagEntry, ...], Field(max_length=20, strict=False)] = ()
    warnings: Annotated[tuple[FlagEntry, ...], Field(max_length=100, strict=False)] = ()


class ScoreBlock(_Strict):
    """What `lagbench submit` writes; `lagbench leaderboard check` finds any change to it."""

    scored_by: Short
    lagbench: Short = Field(description="version of the scorer")
    dataset_sha256: Hash
    ranking_metric: Annotated[str, StringConstraints(pattern=LABEL, max_length=LONGEST_ID)]
    files: Annotated[tuple[ScoredFile, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)]
    metrics: Annotated[dict[str, Summary], Field(max_length=500)]
    digest: Hash = Field(description="of this block and the predictions it belongs to")


class About(_Strict):
    """What a submitter says of a method; `lagbench submit --from` reads a file of these keys."""

    name: Short | None = Field(default=None, description="what the method is called")
    authors: Annotated[tuple[Short, ...], Field(max_length=50, strict=False)] = ()
    affiliation: Annotated[str, StringConstraints(max_length=200), AfterValidator(_line)] = ""
    licence: Annotated[str, StringConstraints(max_length=60), AfterValidator(_line)] = ""
    code: Link | None = None
    paper: Link | None = None
    date: Annotated[datetime.date, BeforeValidator(_date)] | None = None
    notes: Long = ""
    training: Long = Field(default="", description="what it was trained on, in words")
    parameters: int | None = Field(default=None, ge=0, lt=10**15, description="trainable parameters")
    hardware: Annotated[str, StringConstraints(max_length=200), AfterValidator(_line)] = Field(
        default="", description="machine of the training"
    )
    command: Long = Field(default="", description="shell commands that make the predictions again")
    cost: CostEntry | None = None


class Entry(About):
    """The whole file leaderboard/submissions/<split>/<size>/<method>.yaml."""

    format: Literal[1]
    split: Name
    size: Name
    method: Name
    name: Short
    authors: Annotated[tuple[Short, ...], Field(min_length=1, max_length=50, strict=False)]
    date: Annotated[datetime.date, BeforeValidator(_date)]
    command: Annotated[str, StringConstraints(min_length=1, max_length=LONGEST_TEXT), AfterValidator(_lines)]
    status: Annotated[Status, Field(strict=False)] = Status.ACTIVE
    superseded_by: Name | None = None
    reason: Long = Field(default="", description="why it was superseded or withdrawn")
    dataset: DataSet
    predictions: Annotated[
        tuple[PredictionEntry, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    score: ScoreBlock

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        seeds = [made.seed for made in self.predictions]
        if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
            raise ValueError("predictions: several need seeds that differ")
        if [made.sha256 for made in self.predictions] != [f.predictions_sha256 for f in self.score.files]:
            raise ValueError("predictions: their hashes are not those of score.files, in the same order")
        if (self.status is Status.SUPERSEDED) != (self.superseded_by is not None):
            raise ValueError("superseded_by: goes with status: superseded, and only with it")
        return self

    @property
    def floor(self) -> bool:
        """Whether it is one of the scorer's own floors."""
        return self.method in FLOORS

    @property
    def place(self) -> tuple[str, str, str]:
        """Split, size and method."""
        return self.split, self.size, self.method

    @property
    def yaml_path(self) -> Path:
        """Where the entry lies, relative to the leaderboard's folder."""
        return entry_path(self.place)

    @property
    def score_paths(self) -> tuple[Path, ...]:
        """Where its score files lie, relative to the folder, in the order of the predictions."""
        return score_paths(self.place, [made.seed for made in self.predictions])

    def plain(self) -> dict[str, Any]:
        """Return the entry as what YAML holds; optional keys at their default are left out."""
        plain: dict[str, Any] = _plain(self.model_dump(mode="python", exclude_defaults=True))
        return {key: plain[key] for key in _ORDER if key in plain}


_ORDER = (
    *("format", "split", "size", "method", "name", "authors", "affiliation", "licence", "code", "paper"),
    *("date", "notes", "status", "superseded_by", "reason", "training", "parameters", "hardware", "command"),
    *("dataset", "predictions", "cost", "score"),
)
"""Keys in the order in which they are written."""


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(held) for key, held in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(held) for held in value]
    return str(value) if isinstance(value, enum.Enum) else value
