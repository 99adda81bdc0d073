"""An entry of the leaderboard: one method on one split and size, as its YAML file.

A submitter writes everything but the score block; ``lagbench submit`` alone writes the
score block. Unknown keys are refused. Strangers write these files, so every text has a
length, every number has a range, and links are http(s) and nothing else.
"""

from __future__ import annotations

import datetime
import enum
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    model_validator,
)

from lagbench.data.checksums import file_sha256, round_digits
from lagbench.data.layout import major_of
from lagbench.data.registry import Size
from lagbench.data.yamlfile import format_yaml, read_yaml
from lagbench.errors import ChecksFailedError, UsageError, escape_line
from lagbench.references.predictor import Kind
from lagbench.submission.budget import Budget, Track, track_of
from lagbench.submission.format import Header
from lagbench.submission.provenance import TrainingProvenance

from .folder import Folder, Place, entry_path, score_paths

MOST_SEEDS = 20
LONGEST_TEXT = 1000

RELATIVE_TOLERANCE = 1e-6
"""Relative difference up to which two numbers are equal; NumPy versions may differ in
the last bits.
"""

MOST_ISSUES = 10
"""Mistakes of one file that a message lists."""

BUDGET_COUNTS = ("windows", "steps", "start_steps")
BUDGET_AMOUNTS = ("epochs", "cpu_hours", "validation_hours", "gpu_hours")
BUDGET_LABELS = ("device", "threads", "metric")


def _check_printable(text: str) -> str:
    if not text.replace("\n", "").isprintable():
        raise ValueError("holds characters that cannot be printed")
    return text


def _check_line(text: str) -> str:
    if not text.isprintable() or text != text.strip():
        raise ValueError("is no line of printable text")
    return text


def _check_inner_path(path: str) -> str:
    if path.startswith("/") or "\\" in path or ".." in path.split("/"):
        raise ValueError("is no path inside the leaderboard's folder")
    return path


def _parse_date(value: object) -> object:
    if isinstance(value, str):
        return datetime.date.fromisoformat(value)
    return value


def _check_date(date: datetime.date) -> datetime.date:
    # somewhere on Earth it is tomorrow
    if date > today() + datetime.timedelta(days=1):
        raise ValueError("lies in the future")
    return date


def today() -> datetime.date:
    """Return the date of an entry or a record that is written now."""
    return datetime.datetime.now(datetime.UTC).date()


Name = Annotated[
    str, StringConstraints(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$", max_length=60)
]
Label = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]+$", max_length=60)]
Short = Annotated[
    str, StringConstraints(min_length=1, max_length=100), AfterValidator(_check_line)
]
Line = Annotated[str, StringConstraints(max_length=200), AfterValidator(_check_line)]
Long = Annotated[
    str, StringConstraints(max_length=LONGEST_TEXT), AfterValidator(_check_printable)
]
# nothing that could end an HTML attribute
Link = Annotated[
    str,
    StringConstraints(
        pattern=r"^https?://[A-Za-z0-9][!#-&(-;=?-\[\]_a-z~]*$", max_length=300
    ),
]
InnerPath = Annotated[
    str,
    StringConstraints(min_length=1, max_length=200),
    AfterValidator(_check_line),
    AfterValidator(_check_inner_path),
]
Hash = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Version = Annotated[str, StringConstraints(pattern=r"^[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}$")]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Seconds = Annotated[float, Field(ge=1e-7, lt=1e9, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Date = Annotated[
    datetime.date, BeforeValidator(_parse_date), AfterValidator(_check_date)
]


class Strict(BaseModel):
    """Frozen, without other keys and without conversions."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class DataSet(Strict):
    """The data set that was predicted."""

    version: Version
    sha256: Hash


class Weights(Strict):
    """The weights that made predictions, a file in the leaderboard's folder.

    Two entries may name the same file: at two sizes, or with other options.
    """

    path: InnerPath = Field(description="inside the leaderboard's folder")
    sha256: Hash = Field(description="of the file")


class Prediction(Strict):
    """One predictions.nc: where it is kept, if anywhere, and what it holds."""

    seed: Seed | None = None
    sha256: Hash = Field(
        description="content hash of the positions, as `lagbench score` prints it"
    )
    url: Link | None = None
    bytes: int | None = Field(
        default=None, gt=0, lt=2**40, description="length of the file"
    )
    budget: Budget | None = Field(
        default=None, description="what its training took, as the file says"
    )
    provenance: TrainingProvenance | None = Field(
        default=None, description="the training behind it, as the file says"
    )
    weights: Weights | None = None

    @property
    def settings(self) -> tuple[str, ...]:
        """Options that the prediction changed."""
        if self.provenance is None:
            return ()
        return self.provenance.prediction_overrides


class EntryCost(Strict):
    """The cost of a predicted frame, and that of the solver on the same machine."""

    seconds_per_frame: Seconds
    device: Short
    solver_seconds_per_frame: Seconds | None = None


def mean_cost(
    headers: Sequence[Header], solver_seconds: float | None = None
) -> dict[str, object] | None:
    """Return the mean cost over files of predictions, as keys of an EntryCost.

    The solver's time is the one that is given, else the mean of those in the files [s].
    None unless all files name a time and the same machine.
    """
    device = headers[0].device
    model_times = []
    solver_times = []
    for header in headers:
        if header.seconds_per_frame is None or not device or header.device != device:
            return None
        model_times.append(header.seconds_per_frame)
        if header.solver_seconds_per_frame is not None:
            solver_times.append(header.solver_seconds_per_frame)
    if not solver_seconds and solver_times:
        solver_seconds = _rounded_mean(solver_times)
    return {
        "seconds_per_frame": _rounded_mean(model_times),
        "device": str(device)[:100],
        "solver_seconds_per_frame": solver_seconds,
    }


def _rounded_mean(values: Sequence[float]) -> float:
    return round_digits(math.fsum(values) / len(values), 6)


class EntryBudget(Budget):
    """The mean training budget over seeds, and the track that all of them belong to."""

    track: Track | None = Field(
        default=None,
        description="follows from the budgets of all predictions, never stated",
    )

    @classmethod
    def mean_over_seeds(cls, size: str, seeds: Sequence[Budget | None]) -> Self | None:
        """Return the mean over seeds, with the track of all of them.

        None unless each seed has a budget.
        """
        budgets = [budget for budget in seeds if budget is not None]
        if len(budgets) < len(seeds):
            return None

        fields: dict[str, Any] = {}
        for name in (*BUDGET_COUNTS, *BUDGET_AMOUNTS):
            values = [getattr(budget, name) for budget in budgets]
            if None in values:
                continue
            if name in BUDGET_COUNTS:
                fields[name] = round(sum(values) / len(values))
            else:
                fields[name] = _rounded_mean(values)
        for name in BUDGET_LABELS:
            labels = {getattr(budget, name) for budget in budgets}
            if len(labels) == 1:
                fields[name] = labels.pop()
        tracks = {track_of(size, budget) for budget in budgets}
        if len(tracks) == 1:
            fields["track"] = tracks.pop()
        return cls(**fields)


class EntryFlag(Strict):
    """A flag of the scorer or a warning of the validation."""

    name: Label
    reasons: Annotated[tuple[Long, ...], Field(max_length=20, strict=False)] = ()
    share: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None, description="of what it is about"
    )


class Summary(Strict):
    """A metric over scenarios and seeds; null where undefined."""

    mean: Number | None
    std: Number | None = Field(
        description="sample standard deviation over seeds; null for one"
    )
    low: Number | None = Field(description="lower bound of the 95 % interval")
    high: Number | None


class ScoredFile(Strict):
    """The score file of one predictions.nc, with flags and warnings of the scorer."""

    sha256: Hash = Field(description="of the score file")
    predictions_sha256: Hash
    diverged_at: Annotated[dict[int, int], Field(max_length=10_000)] = Field(
        default_factory=dict
    )
    flags: Annotated[tuple[EntryFlag, ...], Field(max_length=20, strict=False)] = ()
    warnings: Annotated[tuple[EntryFlag, ...], Field(max_length=100, strict=False)] = ()


class ScoreBlock(Strict):
    """The scores in an entry; `lagbench submit` alone writes them."""

    lagbench: Short = Field(description="version of the scorer")
    dataset_sha256: Hash
    ranking_metric: Label
    files: Annotated[
        tuple[ScoredFile, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    metrics: Annotated[dict[str, Summary], Field(max_length=500)]


class About(Strict):
    """The description of a method by its submitter."""

    name: Short | None = Field(default=None, description="what the method is called")
    authors: Annotated[tuple[Short, ...], Field(max_length=50, strict=False)] = ()
    affiliation: Line = ""
    licence: Annotated[Line, Field(max_length=60)] = ""
    code: Link | None = None
    paper: Link | None = None
    weights: Link | None = None
    date: Date | None = None
    notes: Long = ""
    kind: Annotated[Kind, Field(strict=False)] = Field(
        default=Kind.LEARNED,
        description="learned, hybrid (a solver with a network inside), calibrated (a "
        "solver with fitted constants) or classical",
    )
    training: Long = Field(default="", description="what it was trained on, in words")
    budget: EntryBudget | None = None
    parameters: int | None = Field(
        default=None, ge=0, lt=10**15, description="trainable parameters"
    )
    hardware: Line = Field(default="", description="machine of the training")
    command: Long = Field(
        default="", description="shell commands that make the predictions again"
    )
    cost: EntryCost | None = None


class Meta(About):
    """The description of a method and of one submission of it: keys of ``--from``."""

    method: Name | None = Field(
        default=None, description="names the entry; by default what the predictions say"
    )
    urls: Annotated[tuple[Link, ...], Field(max_length=MOST_SEEDS, strict=False)] = ()
    solver_seconds_per_frame: Seconds | None = None


class Entry(About):
    """The whole file leaderboard/submissions/<split>/<size>/<method>.yaml."""

    format: Literal[2]
    split: Name
    size: Name
    method: Name
    name: Short
    authors: Annotated[
        tuple[Short, ...], Field(min_length=1, max_length=50, strict=False)
    ]
    date: Date
    command: Annotated[Long, Field(min_length=1)]
    dataset: DataSet
    predictions: Annotated[
        tuple[Prediction, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    score: ScoreBlock

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        seeds = self.seeds
        if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
            raise ValueError("predictions: several need seeds that differ")
        if self.kind is Kind.NAIVE:
            raise ValueError("kind: learned, hybrid, calibrated or classical")
        predicted = [prediction.sha256 for prediction in self.predictions]
        scored = [file.predictions_sha256 for file in self.score.files]
        if predicted != scored:
            raise ValueError("predictions: their hashes are not those of score.files")
        return self

    @property
    def place(self) -> Place:
        """Split, size and method."""
        return self.split, self.size, self.method

    @property
    def yaml_path(self) -> Path:
        """Path of the entry, relative to the leaderboard's folder."""
        return entry_path(self.place)

    @property
    def seeds(self) -> tuple[int | None, ...]:
        """Seed of each of the predictions."""
        return tuple(prediction.seed for prediction in self.predictions)

    @property
    def score_paths(self) -> tuple[Path, ...]:
        """Paths of the score files, relative to the folder, one per prediction."""
        return score_paths(self.place, self.seeds)

    @property
    def flags(self) -> tuple[str, ...]:
        """Names of the flags that the scorer raised for any seed."""
        names = (flag.name for file in self.score.files for flag in file.flags)
        return tuple(dict.fromkeys(names))

    @property
    def score_hashes(self) -> tuple[str, ...]:
        """Hashes of the score files."""
        return tuple(file.sha256 for file in self.score.files)

    @property
    def weight_paths(self) -> set[Path]:
        """Paths of weights and of logs of their trainings, relative to the folder."""
        paths = set()
        for prediction in self.predictions:
            if prediction.weights is not None:
                path = Path(prediction.weights.path)
                paths |= {path, path.with_suffix(".json")}
        return paths

    @property
    def models(self) -> set[tuple[int | None, str]]:
        """Seed and hash of the models that lie on the board."""
        return {
            (prediction.seed, prediction.weights.sha256)
            for prediction in self.predictions
            if prediction.weights is not None
        }


KEY_ORDER = (
    *("format", "split", "size", "method", "name", "authors", "affiliation"),
    *("licence", "code", "paper", "weights", "date", "notes", "kind", "training"),
    *("budget", "parameters", "hardware", "command", "dataset", "predictions"),
    *("cost", "score"),
)
"""Order of the keys of an entry's file."""

Model = TypeVar("Model", bound=BaseModel)


def validate(kind: type[Model], content: object, where: object) -> Model:
    """Return the model that plain values describe.

    Args:
        kind: the model.
        content: plain values, as a YAML file holds them.
        where: the file, for the message.

    Raises:
        ChecksFailedError: a key is unknown or missing, or a value does not fit.
    """
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        mistakes = []
        for item in error.errors(include_url=False)[:MOST_ISSUES]:
            key = ".".join(map(str, item["loc"])) or "the file"
            mistakes.append(f"{escape_line(key)[:100]}: {item['msg']}")
        raise ChecksFailedError(
            f"{where} does not fit: {'; '.join(mistakes)}; docs/submitting.md "
            "describes the keys"
        ) from None


def read_entry(path: Path) -> Entry:
    """Read the entry of a YAML file.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it does not fit the schema.
    """
    return validate(Entry, read_yaml(path), path)


def read_meta(path: Path | None, method: str | None = None) -> Meta:
    """Return the description of a method from a YAML file; a method replaces its own.

    Raises:
        UsageError: the file does not fit `Meta`.
        UnreadableFileError: no plain YAML.
    """
    content = {} if path is None else read_yaml(path)
    if not isinstance(content, dict):
        raise UsageError(f"{path} holds no lines of `key: value`; see submitting.md")
    if method is not None:
        content["method"] = method
    try:
        return validate(Meta, content, path or "--method")
    except ChecksFailedError as error:
        raise UsageError(error.text) from None


def entry_bytes(entry: Entry) -> bytes:
    """Return the bytes of an entry's YAML file; equal entries give equal bytes."""
    values = entry.model_dump(mode="python", exclude_defaults=True)
    return yaml_bytes({key: values[key] for key in KEY_ORDER if key in values})


def yaml_bytes(value: object) -> bytes:
    """Return plain values as the bytes of a YAML file."""
    return format_yaml(_to_plain(value), default_flow_style=None).encode()


def _to_plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _to_plain(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_plain(member) for member in value]
    if isinstance(value, enum.Enum):
        return str(value)
    return value


def schema_bytes() -> bytes:
    """Return the JSON schema of an entry as the bytes of leaderboard/schema.json."""
    schema = Entry.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "Entry of the lagbench leaderboard"
    return f"{json.dumps(schema, indent=1, ensure_ascii=False)}\n".encode()


def find_model(folder: Folder, weights: Weights) -> Path:
    """Return the file of a model, which must be the one that its entry names.

    Raises:
        ChecksFailedError: the file is another one, or missing.
    """
    path = folder.path / weights.path
    if path.is_symlink() or not path.is_file():
        raise ChecksFailedError(f"{path}: no such file; restore the weights")
    sha256 = file_sha256(path)
    if sha256 != weights.sha256:
        raise ChecksFailedError(
            f"{path} has SHA-256 {sha256[:16]}, its entry names {weights.sha256[:16]}; "
            "restore the weights, or submit again"
        )
    return path


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today.

    It has the same MAJOR version, and the same hash where one is recorded.
    """
    if major_of(dataset.version) != size.major:
        return False
    return size.measured is None or dataset.sha256 == size.measured.dataset_sha256
