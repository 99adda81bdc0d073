"""The records of the maintainers, leaderboard/verified.yaml.

They say how far the maintainers followed the scores of an entry: they scored its
predictions again, or ran its models, and what a frame of a model costs. ``leaderboard
check --predictions FILE --record`` and ``leaderboard reproduce`` write them.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from importlib.metadata import version
from typing import Annotated

from pydantic import Field

from .entry import (
    MOST_SEEDS,
    Date,
    Entry,
    Hash,
    Label,
    Number,
    Seconds,
    Seed,
    Short,
    Strict,
    today,
)
from .folder import VERIFIED, Folder
from .records import Record, RecordFile, record_of

LEAST_SCORE = 1e-38
"""Size of a score, at least, to which a difference is relative: about the smallest
normal number of float32.
"""


def relative_difference(submitted: float, reproduced: float) -> float:
    """Return the difference of two scores, relative to the submitted one."""
    return abs(reproduced - submitted) / max(abs(submitted), LEAST_SCORE)


class Level(enum.StrEnum):
    """How far the maintainers followed the scores of an entry, lowest first."""

    AS_SUBMITTED = "as submitted"
    SCORED_AGAIN = "scored again"  # the submitter's predictions gave the same scores
    REPRODUCED = "reproduced"  # its model, run by the maintainers, gave them


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


class MeasuredCost(Strict):
    """Processor time of a frame on one core, all rows measured in one run."""

    machine: Short
    date: Date
    repeats: Annotated[int, Field(ge=1)] = Field(description="the least counts")
    seconds_per_frame: Seconds = Field(description="of the model [s]")
    solver: Seconds | None = Field(default=None, description="of our solver [s]")
    classical: Annotated[dict[str, Seconds], Field(max_length=50)] = Field(
        default_factory=dict, description="of classical and calibrated references [s]"
    )
    naive: Annotated[dict[str, Seconds], Field(max_length=50)] = Field(
        default_factory=dict, description="of the naive reference predictors [s]"
    )

    def is_of_same_run(self, other: MeasuredCost) -> bool:
        """Return whether both were measured in one run, and so can be compared."""
        own_time = {"seconds_per_frame": other.seconds_per_frame}
        return self.model_copy(update=own_time) == other


class Verification(Record):
    """The record of an entry."""

    scores: Annotated[
        tuple[Hash, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)
    ]
    lagbench: Short
    date: Date
    level: Annotated[Level, Field(strict=False)]
    reproduced: Annotated[
        tuple[Reproduction, ...], Field(max_length=MOST_SEEDS, strict=False)
    ] = ()
    cost: MeasuredCost | None = None

    def is_of(self, entry: Entry) -> bool:
        """Return whether the record is of the scores and models of an entry."""
        models = {(one.seed, one.model) for one in self.reproduced}
        return self.scores == entry.score_hashes and models <= entry.models

    @property
    def is_complete(self) -> bool:
        """Whether the models were run again on all test scenarios."""
        return bool(self.reproduced) and all(
            model.scenarios == model.of for model in self.reproduced
        )


VERIFICATIONS = RecordFile(VERIFIED, Verification)
"""The file verified.yaml."""


def record(
    folder: Folder, entry: Entry, change: Callable[[Verification], Verification]
) -> None:
    """Change the record of an entry, an empty one where it has none."""
    renewed = {"lagbench": version("lagbench"), "date": today()}
    with VERIFICATIONS.changing(folder) as records:
        line = record_of(entry, records) or empty_record(entry)
        changed = change(line).model_copy(update=renewed)
        records[entry.yaml_path.as_posix()] = changed


def empty_record(entry: Entry) -> Verification:
    """Return the record of an entry that nobody followed."""
    return Verification(
        scores=entry.score_hashes,
        lagbench=version("lagbench"),
        date=today(),
        level=Level.AS_SUBMITTED,
    )
