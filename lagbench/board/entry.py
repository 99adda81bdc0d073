"""An entry of the leaderboard: one method on one split and size, as its YAML file.

A submitter writes everything but the score block; ``lagbench submit`` alone writes the
score block. Unknown keys are refused. Whether the maintainers scored the predictions
again stands elsewhere: in verified.yaml.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from lagbench.data.checksums import round_digits
from lagbench.references.predictor import Kind
from lagbench.submission.budget import Budget, Track, track_of
from lagbench.submission.format import Header
from lagbench.submission.provenance import TrainingProvenance

from .fields import (
    MOST_BYTES,
    MOST_SEEDS,
    Command,
    Date,
    Hash,
    InnerPath,
    Label,
    Line,
    Link,
    Long,
    Name,
    Number,
    PlaceName,
    Seconds,
    Seed,
    Short,
    Version,
)
from .folder import Place, entry_path, score_paths, weights_path

OUTSIDE = "in_domain"  # the warning that comes with a share of the positions

LEAST_SCORE = 1e-38
"""Size of a score, at least, to which a difference is relative: about the smallest
normal number of float32.
"""

RELATIVE_TOLERANCE = 1e-6
"""Relative difference up to which two numbers are equal; NumPy versions may differ in
the last bits.
"""

BUDGET_COUNTS = ("windows", "steps", "start_steps")
BUDGET_AMOUNTS = ("epochs", "cpu_hours", "validation_hours", "gpu_hours")
BUDGET_LABELS = ("device", "threads", "metric")


def relative_difference(submitted: float, reproduced: float) -> float:
    """Return the difference of two scores, relative to the submitted one."""
    return abs(reproduced - submitted) / max(abs(submitted), LEAST_SCORE)


class Status(enum.StrEnum):
    """Status of an entry on the board."""

    ACTIVE = "active"
    SUPERSEDED = "superseded"
    WITHDRAWN = "withdrawn"


def _check_kind(kind: Kind) -> Kind:
    if kind is Kind.NAIVE:
        raise ValueError("is not learned, hybrid, calibrated or classical")
    return kind


class Strict(BaseModel):
    """Frozen, without other keys and without conversions."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class DataSet(Strict):
    """The data set that was predicted."""

    version: Version
    sha256: Hash


class Weights(Strict):
    """The weights that made predictions, kept in the leaderboard's folder.

    They lie beside the entry, or beside another one that keeps them. Two active entries
    predict with the same weights in two ways.
    """

    path: InnerPath = Field(description="inside the leaderboard's folder")
    sha256: Hash = Field(description="of the file")
    shared_with: PlaceName | None = Field(
        default=None,
        description="another entry that keeps the file, as in cavity/mini/gns",
    )

    def place_of(self, own: Place) -> Place:
        """Return the place of the entry that keeps the file: another's, or its own."""
        if self.shared_with is None:
            return own
        split, size, method = self.shared_with.split("/")
        return split, size, method


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
    provenance: TrainingProvenance | None = Field(
        default=None, description="the training behind it, as the file says"
    )
    weights: Weights | None = None


class EntryCost(Strict):
    """The cost of a predicted frame, and that of the solver on the same machine."""

    seconds_per_frame: Seconds
    device: Short
    solver_seconds_per_frame: Seconds | None = None

    @property
    def speed_up(self) -> float | None:
        """Solver time over model time; None without the former."""
        solver_seconds = self.solver_seconds_per_frame
        if solver_seconds is None:
            return None
        return solver_seconds / self.seconds_per_frame


def mean_cost(
    headers: Sequence[Header], solver_seconds: float | None = None
) -> dict[str, object] | None:
    """Return the mean cost over files of predictions, as keys of an EntryCost.

    The solver's time is the one that is given, else the mean of those in the files [s].
    Predictions may hold values that no entry may have, so the result is not checked.
    None unless all files name a time and the same machine.
    """
    device = headers[0].device
    if not device:
        return None

    model_times = []
    solver_times = []
    for header in headers:
        if header.seconds_per_frame is None or header.device != device:
            return None
        model_times.append(header.seconds_per_frame)
        if header.solver_seconds_per_frame is not None:
            solver_times.append(header.solver_seconds_per_frame)

    if not solver_seconds and solver_times:
        solver_seconds = _rounded_mean(solver_times)
    return {
        "seconds_per_frame": _rounded_mean(model_times),
        "device": device[:100],
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
        budgets = []
        for budget in seeds:
            if budget is not None:
                budgets.append(budget)
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


class Level(enum.StrEnum):
    """How far the maintainers followed the scores of an entry, lowest first."""

    AS_SUBMITTED = "as submitted"
    SCORED_AGAIN = "scored again"  # the submitter's predictions gave the same scores
    REPRODUCED = "reproduced"  # its model, run by the maintainers, gave them

    @property
    def rank(self) -> int:
        """0 for the lowest level."""
        return list(Level).index(self)


class Reproduction(Strict):
    """The scores of one model of an entry, predicted anew by the maintainers."""

    seed: Seed | None = None
    model: Hash = Field(description="of the file of the model")
    metric: Label = Field(description="the metric that ranks")
    scenarios: Annotated[int, Field(ge=1)] = Field(description="predicted anew")
    of: Annotated[int, Field(ge=1)] = Field(description="scenarios of the test subset")
    submitted: Number = Field(description="mean over these scenarios, as submitted")
    reproduced: Number = Field(description="mean over them, predicted anew")
    difference: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        description="of the two, relative to the submitted one"
    )
    tolerance: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    greatest: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        default=0.0, description="greatest relative difference of one scenario"
    )

    @property
    def agrees(self) -> bool:
        """Whether the scores are the same within the tolerance."""
        return self.difference <= self.tolerance

    @property
    def has_stated_difference(self) -> bool:
        """Whether the difference is that of both scores, up to the digits they have."""
        difference = relative_difference(self.submitted, self.reproduced)
        return math.isclose(difference, self.difference, rel_tol=0.1, abs_tol=1e-8)

    @property
    def is_complete(self) -> bool:
        """Whether all test scenarios were predicted anew."""
        return self.scenarios == self.of


class MeasuredCost(Strict):
    """Processor time of a frame on one core, all rows measured in one run."""

    machine: Short
    date: Date
    repeats: Annotated[int, Field(ge=1)] = Field(description="the least counts")
    seconds_per_frame: Seconds = Field(description="of the model [s]")
    solver: Seconds | None = Field(default=None, description="of our solver [s]")
    classical: Annotated[dict[str, Seconds], Field(max_length=50)] = Field(
        default_factory=dict, description="of the classical reference predictors [s]"
    )
    naive: Annotated[dict[str, Seconds], Field(max_length=50)] = Field(
        default_factory=dict, description="of the naive reference predictors [s]"
    )

    @property
    def speed_up(self) -> float | None:
        """Solver time over model time; None without the former."""
        if self.solver is None:
            return None
        return self.solver / self.seconds_per_frame

    def is_of_same_run(self, other: MeasuredCost) -> bool:
        """Return whether both were measured in one run, and so can be compared."""
        own_time = {"seconds_per_frame": other.seconds_per_frame}
        return self.model_copy(update=own_time) == other


class Verification(Strict):
    """A line of verified.yaml: what the maintainers found out about an entry."""

    scores: Annotated[
        tuple[Hash, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    lagbench: Short
    date: Date
    level: Annotated[Level, Field(strict=False)] = Level.SCORED_AGAIN
    reproduced: Annotated[
        tuple[Reproduction, ...], Field(max_length=MOST_SEEDS, strict=False)
    ] = ()
    cost: MeasuredCost | None = None

    @property
    def is_reproduced(self) -> bool:
        """Whether the models were run again and gave the same scores."""
        return self.level.rank >= Level.REPRODUCED.rank

    @property
    def is_reproduced_wholly(self) -> bool:
        """Whether every model was run again on all test scenarios."""
        is_complete = all(model.is_complete for model in self.reproduced)
        return self.is_reproduced and is_complete

    @model_validator(mode="after")
    def _check_level(self) -> Self:
        has_models = bool(self.reproduced)
        if self.level.rank >= Level.REPRODUCED.rank and not has_models:
            raise ValueError(f"level: {self.level} needs models that were predicted")
        return self


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
    kind: Annotated[Kind, Field(strict=False), AfterValidator(_check_kind)] = Field(
        default=Kind.LEARNED,
        description="learned: a network; hybrid: a solver with a network inside; "
        "calibrated: a solver with up to a dozen fitted numbers; classical",
    )
    training: Long = Field(default="", description="what it was trained on, in words")
    budget: EntryBudget | None = None
    parameters: int | None = Field(
        default=None, ge=0, lt=10**15, description="trainable parameters"
    )
    hardware: Line = Field(default="", description="machine of the training")
    command: Command = Field(
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

    KEY_ORDER: ClassVar[tuple[str, ...]] = (
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
        "weights",
        "date",
        "notes",
        "status",
        "superseded_by",
        "reason",
        "kind",
        "training",
        "budget",
        "parameters",
        "hardware",
        "command",
        "dataset",
        "predictions",
        "cost",
        "score",
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
    command: Annotated[Command, Field(min_length=1)]
    status: Annotated[Status, Field(strict=False)] = Status.ACTIVE
    superseded_by: Name | None = None
    reason: Long = Field(default="", description="why it was superseded or withdrawn")
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

        predicted = [prediction.sha256 for prediction in self.predictions]
        scored = [file.predictions_sha256 for file in self.score.files]
        if predicted != scored:
            raise ValueError(
                "predictions: their hashes are not those of score.files, in the "
                "same order"
            )

        is_superseded = self.status is Status.SUPERSEDED
        if is_superseded != (self.superseded_by is not None):
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
    def files(self) -> tuple[Path, ...]:
        """Paths of all files beside the entry: scores, weights and training logs."""
        paths = list(self.score_paths)
        for prediction in self.predictions:
            weights = prediction.weights
            if weights is not None and weights.shared_with is None:
                path = weights_path(self.place, prediction.seed, weights.path)
                paths += [path, path.with_suffix(".json")]
        return tuple(paths)

    @property
    def shared_with(self) -> tuple[str, ...]:
        """Other entries whose weights this one predicts with, as in cavity/mini/gns."""
        keepers: dict[str, None] = {}
        for prediction in self.predictions:
            weights = prediction.weights
            if weights is not None and weights.shared_with is not None:
                keepers[weights.shared_with] = None
        return tuple(keepers)

    @property
    def provenance(self) -> TrainingProvenance | None:
        """Training behind the first seed; None where words of a person describe it."""
        provenance = self.predictions[0].provenance
        if provenance is None:
            return TrainingProvenance.from_sentence(self.training)
        return provenance

    def settings_of(self, prediction: Prediction) -> tuple[str, ...]:
        """Return the options that one of the predictions changed, as it states them."""
        provenance = prediction.provenance or self.provenance
        if provenance is None:
            return ()
        return provenance.prediction_overrides
