"""An entry of the leaderboard: one method on one split and size, as its YAML file says
it.

Everything but the score block is written by whoever submits; the score block is written
by ``lagbench submit`` alone. Strangers write these files, so every text has a length,
every number a range, links are http(s) and nothing else, and unknown keys are refused.
Whether the maintainers scored the predictions again is said elsewhere: verified.yaml.
"""

from __future__ import annotations

import datetime
import enum
import ipaddress
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    model_validator,
)

from lagbench.data.checksums import round_digits
from lagbench.submission.budget import Budget, Track, track_of
from lagbench.submission.format import Header

from .folder import Place, entry_path, score_paths, weights_path

ID = r"^[a-z0-9]+(-[a-z0-9]+)*$"
# nothing that could end an HTML attribute
WEB = r"^https?://[A-Za-z0-9][!#-&(-;=?-\[\]_a-z~]*$"
SHA256 = r"^[0-9a-f]{64}$"
RELEASE = r"^[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}$"
LABEL = r"^[a-z0-9_]+$"

PATTERNS: Mapping[str, str] = {
    ID: "small letters, digits and single hyphens, as in my-model",
    WEB: "an http:// or https:// address, without spaces and quotes",
    SHA256: "64 hexadecimal digits",
    RELEASE: "a version, as in 1.0.0",
    LABEL: "small letters, digits and underscores",
}
"""What texts have to be, in words; people do not read regular expressions."""

LONGEST_ID = 60
LONGEST_TEXT = 1000
MOST_SEEDS = 20
MOST_BYTES = 2**40
# combining marks on one letter; no script needs more, piles of them cover the
# neighbours
MOST_MARKS = 3

OUTSIDE = "in_domain"  # the warning that comes with a share of the positions

BLANKS = frozenset("\u115f\u1160\u2800\u3164\uffa0")
"""Letters and symbols that show nothing, though Unicode counts them as printable."""


def last_day() -> datetime.date:
    """Return the last day that an entry may be of: somewhere it is tomorrow."""
    return datetime.datetime.now(datetime.UTC).date() + datetime.timedelta(days=1)


def _line(text: str) -> str:
    marks = 0
    for letter in unicodedata.normalize("NFC", text):
        if unicodedata.category(letter).startswith("M"):
            marks = marks + 1
        else:
            marks = 0
        if marks > MOST_MARKS:
            raise ValueError("holds letters under piles of marks")
    if not text.isprintable() or BLANKS.intersection(text):
        raise ValueError("holds characters that cannot be printed, such as line breaks")
    return text


def _lines(text: str) -> str:
    _line(text.replace("\n", ""))
    return text


def _visible(text: str) -> str:
    if text != text.strip() or not any(letter.isalnum() for letter in text):
        raise ValueError("holds no letter or digit, or begins or ends with a blank")
    return text


def _named_host(address: str) -> str:
    """Refuse hosts that read as another one, or that are no name that anybody could
    look up.
    """
    labels: list[str] = []
    with suppress(
        ValueError
    ):  # of what is no address, and of a name, which is no number
        host = urlsplit(address).hostname or ""
        labels = host.split(".")
        ipaddress.ip_address(host.strip("[]"))
        labels = []
    puny = any(part.startswith("xn--") for part in labels)
    if "@" in address or "" in labels[:-1] or len(labels) < 2 or puny:
        raise ValueError(
            "is not the address of a named host, without user and punycode"
        )
    return address


def _inside(path: str) -> str:
    if (
        path.startswith("/")
        or "\\" in path
        or any(part in ("", ".", "..") for part in path.split("/"))
    ):
        raise ValueError(
            "is no path inside the leaderboard's folder: relative, without '..', "
            "parted by '/'"
        )
    return path


Name = Annotated[str, StringConstraints(pattern=ID, max_length=LONGEST_ID)]
Label = Annotated[str, StringConstraints(pattern=LABEL, max_length=LONGEST_ID)]
Short = Annotated[
    str,
    StringConstraints(min_length=1, max_length=100),
    AfterValidator(_line),
    AfterValidator(_visible),
]
Line = Annotated[str, StringConstraints(max_length=200), AfterValidator(_line)]
Long = Annotated[
    str, StringConstraints(max_length=LONGEST_TEXT), AfterValidator(_lines)
]
Link = Annotated[
    str, StringConstraints(pattern=WEB, max_length=300), AfterValidator(_named_host)
]
InnerPath = Annotated[
    str,
    StringConstraints(min_length=1, max_length=200),
    AfterValidator(_line),
    AfterValidator(_inside),
]
Hash = Annotated[str, StringConstraints(pattern=SHA256)]
Version = Annotated[str, StringConstraints(pattern=RELEASE)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Seconds = Annotated[float, Field(ge=1e-7, lt=1e9, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Date = Annotated[
    datetime.date,
    BeforeValidator(
        lambda x: datetime.date.fromisoformat(x) if isinstance(x, str) else x
    ),
]


class Status(enum.StrEnum):
    """Where an entry stands in its life."""

    ACTIVE = "active"
    SUPERSEDED = "superseded"
    WITHDRAWN = "withdrawn"


class Strict(BaseModel):
    """Frozen, without other keys and without conversions."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class DataSet(Strict):
    """The data set that was predicted."""

    version: Version
    sha256: Hash


class Weights(Strict):
    """The weights that made predictions, kept in the leaderboard's folder."""

    path: InnerPath = Field(description="inside the leaderboard's folder")
    sha256: Hash = Field(description="of the file")


class Prediction(Strict):
    """One predictions.nc: where it is kept, if anywhere, and what it holds."""

    seed: Seed | None = None
    sha256: Hash = Field(
        description="content hash of the positions, as `lagbench score` prints it"
    )
    url: Link | None = None
    path: InnerPath | None = Field(
        default=None, description="inside the leaderboard's folder"
    )
    bytes: int | None = Field(
        default=None, gt=0, lt=MOST_BYTES, description="length of the file"
    )
    budget: Budget | None = Field(
        default=None, description="what its training took, as the file says"
    )
    weights: Weights | None = None


class Cost(Strict):
    """What a predicted frame costs, and what the solver takes on the same machine."""

    seconds_per_frame: Seconds
    device: Short
    solver_seconds_per_frame: Seconds | None = None

    @staticmethod
    def told(
        headers: Sequence[Header], solver: float | None = None
    ) -> dict[str, object] | None:
        """Return the mean cost over files of predictions; None unless all tell it and
        one machine.

        The solver's time is the one that is given, else the mean of those that the
        files tell [s]. Predictions may say what no entry may, so these are keys and
        values to examine, not a cost.
        """
        times = [
            header.seconds_per_frame
            for header in headers
            if header.seconds_per_frame is not None
        ]
        device = headers[0].device
        if (
            len(times) < len(headers)
            or not device
            or any(header.device != device for header in headers)
        ):
            return None
        told = [
            held
            for one in headers
            if (held := one.solver_seconds_per_frame) is not None
        ]
        return {
            "seconds_per_frame": round_digits(sum(times) / len(times), 6),
            "device": device[:100],
            "solver_seconds_per_frame": solver
            or (round_digits(sum(told) / len(told), 6) if told else None),
        }

    @property
    def speed_up(self) -> float | None:
        """Solver time over model time; None without the former."""
        solver = self.solver_seconds_per_frame
        if solver is None:
            return None
        return solver / self.seconds_per_frame


class EntryBudget(Budget):
    """What the training of one seed took: of several the mean, and the track that all
    of them belong to.
    """

    track: Track | None = Field(
        default=None,
        description="follows from the budgets of all predictions, never stated",
    )

    @classmethod
    def of(cls, size: str, seeds: Sequence[Budget | None]) -> Self | None:
        """Return the mean over seeds, with the track that all belong to; None unless
        each has a budget.
        """
        known = [seed for seed in seeds if seed is not None]
        if len(known) < len(seeds):
            return None
        held: dict[str, Any] = {}
        counts = ("windows", "steps", "start_steps")
        for name in (*counts, "epochs", "cpu_hours", "validation_hours", "gpu_hours"):
            values = [
                value for seed in known if (value := getattr(seed, name)) is not None
            ]
            if len(values) == len(known):
                mean = sum(values) / len(values)
                if name in counts:
                    held[name] = round(mean)
                else:
                    held[name] = round_digits(mean, 6)
        for name in ("device", "threads", "metric"):
            if len({getattr(seed, name) for seed in known}) == 1:
                held[name] = getattr(known[0], name)
        tracks = {track_of(size, seed) for seed in known}
        return cls(**held, track=tracks.pop() if len(tracks) == 1 else None)


class Flag(Strict):
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
    """The score file of one predictions.nc, and what the scorer said beside its
    numbers.
    """

    sha256: Hash = Field(description="of the score file")
    predictions_sha256: Hash
    diverged_at: Annotated[dict[int, int], Field(max_length=10_000)] = Field(
        default_factory=dict
    )
    flags: Annotated[tuple[Flag, ...], Field(max_length=20, strict=False)] = ()
    warnings: Annotated[tuple[Flag, ...], Field(max_length=100, strict=False)] = ()


class ScoreBlock(Strict):
    """What `lagbench submit` writes; `lagbench leaderboard check` forms its numbers
    again.
    """

    lagbench: Short = Field(description="version of the scorer")
    dataset_sha256: Hash
    ranking_metric: Label
    files: Annotated[
        tuple[ScoredFile, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    metrics: Annotated[dict[str, Summary], Field(max_length=500)]


class Verification(Strict):
    """What the maintainers found of an entry when they scored its predictions again."""

    scores: Annotated[
        tuple[Hash, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    lagbench: Short
    date: Date


class About(Strict):
    """What a submitter says of a method."""

    name: Short | None = Field(default=None, description="what the method is called")
    authors: Annotated[tuple[Short, ...], Field(max_length=50, strict=False)] = ()
    affiliation: Line = ""
    licence: Annotated[Line, Field(max_length=60)] = ""
    code: Link | None = None
    paper: Link | None = None
    weights: Link | None = None
    date: Date | None = None
    notes: Long = ""
    training: Long = Field(default="", description="what it was trained on, in words")
    budget: EntryBudget | None = None
    parameters: int | None = Field(
        default=None, ge=0, lt=10**15, description="trainable parameters"
    )
    hardware: Line = Field(default="", description="machine of the training")
    command: Long = Field(
        default="", description="shell commands that make the predictions again"
    )
    cost: Cost | None = None


class Meta(About):
    """What a submitter says of a method and of this submission of it: keys of
    ``--from``.
    """

    method: Name | None = Field(
        default=None, description="names the entry; by default what the predictions say"
    )
    urls: Annotated[tuple[Link, ...], Field(max_length=MOST_SEEDS, strict=False)] = ()
    solver_seconds_per_frame: Seconds | None = None


class Entry(About):
    """The whole file leaderboard/submissions/<split>/<size>/<method>.yaml."""

    ORDER: ClassVar[tuple[str, ...]] = (
        *(
            "format",
            "split",
            "size",
            "method",
            "name",
            "authors",
            "affiliation",
            "licence",
            "code",
            "paper",
        ),
        *(
            "weights",
            "date",
            "notes",
            "status",
            "superseded_by",
            "reason",
            "training",
            "budget",
        ),
        *(
            "parameters",
            "hardware",
            "command",
            "dataset",
            "predictions",
            "cost",
            "score",
        ),
    )

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
    status: Annotated[Status, Field(strict=False)] = Status.ACTIVE
    superseded_by: Name | None = None
    reason: Long = Field(default="", description="why it was superseded or withdrawn")
    dataset: DataSet
    predictions: Annotated[
        tuple[Prediction, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    score: ScoreBlock

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        seeds = [made.seed for made in self.predictions]
        if len(seeds) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
            raise ValueError("predictions: several need seeds that differ")
        if [made.sha256 for made in self.predictions] != [
            f.predictions_sha256 for f in self.score.files
        ]:
            raise ValueError(
                "predictions: their hashes are not those of score.files, in the "
                "same order"
            )
        if (self.status is Status.SUPERSEDED) != (self.superseded_by is not None):
            raise ValueError(
                "superseded_by: goes with status: superseded, and only with it"
            )
        return self

    @property
    def place(self) -> Place:
        """Split, size and method."""
        return self.split, self.size, self.method

    @property
    def yaml_path(self) -> Path:
        """Where the entry lies, relative to the leaderboard's folder."""
        return entry_path(self.place)

    @property
    def score_paths(self) -> tuple[Path, ...]:
        """Where its score files lie, relative to the folder, in the order of the
        predictions.
        """
        return score_paths(self.place, [made.seed for made in self.predictions])

    @property
    def files(self) -> tuple[Path, ...]:
        """Score files, then weights with what their trainings recorded: all that lies
        beside the entry.
        """
        weights = [
            weights_path(self.place, made.seed)
            for made in self.predictions
            if made.weights
        ]
        return (
            *self.score_paths,
            *(path.with_suffix(end) for path in weights for end in (".pt", ".json")),
        )
