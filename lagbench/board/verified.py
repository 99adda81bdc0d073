"""The records of the maintainers, leaderboard/verified.yaml.

They say how far the maintainers followed the scores of an entry: they scored its
predictions again, or ran its models, and what a frame of a model costs. They lie apart
from the entries, so that no submitter can claim them. A record holds while the entry
has the very score files and models that the record names. ``leaderboard check
--predictions FILE --record`` and ``leaderboard reproduce`` write them.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from typing import Annotated

from pydantic import Field, RootModel

from lagbench.atomic import write_atomically
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import LagbenchError

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
    validate,
    yaml_bytes,
)
from .folder import VERIFIED, Folder

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


class Verification(Strict):
    """The record of an entry."""

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
    def is_complete(self) -> bool:
        """Whether the models were run again on all test scenarios."""
        return bool(self.reproduced) and all(
            model.scenarios == model.of for model in self.reproduced
        )


class VerifiedFile(RootModel[dict[str, Verification]]):
    """Records by path of the entry, relative to the leaderboard's folder."""


def read_verified(folder: Folder) -> dict[str, Verification]:
    """Return the records by path of the entry; empty without the file.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it holds something else.
    """
    path = folder.path / VERIFIED
    content = read_yaml(path) if path.exists() else None
    return validate(VerifiedFile, content or {}, path).root


def verification_of(
    entry: Entry, verified: Mapping[str, Verification]
) -> Verification | None:
    """Return the record of an entry.

    None without one, and where it is about other score files or models.
    """
    line = verified.get(entry.yaml_path.as_posix())
    if line is None or line.scores != entry.score_hashes:
        return None
    if entry.models.issuperset((one.seed, one.model) for one in line.reproduced):
        return line
    return None


def record(
    folder: Folder, entry: Entry, change: Callable[[Verification], Verification]
) -> Verification:
    """Change the record of an entry, an empty one where it has none; return it."""
    with folder.lock():
        verified = read_verified(folder)
        line = verification_of(entry, verified) or empty_record(entry)
        renewed = {"lagbench": version("lagbench"), "date": today()}
        changed = change(line).model_copy(update=renewed)
        verified[entry.yaml_path.as_posix()] = changed
        _write(folder, verified)
    return changed


def empty_record(entry: Entry) -> Verification:
    """Return the record of an entry that nobody followed."""
    return Verification(
        scores=entry.score_hashes,
        lagbench=version("lagbench"),
        date=today(),
        level=Level.AS_SUBMITTED,
    )


def remove_stale_record(folder: Folder, entry: Entry) -> bool:
    """Remove the record of other score files of an entry; return whether there was."""
    verified = read_verified(folder)
    name = entry.yaml_path.as_posix()
    if name not in verified or verification_of(entry, verified) is not None:
        return False
    del verified[name]
    _write(folder, verified)
    return True


def check_verified(folder: Folder, entries: Mapping[str, Entry]) -> Iterator[str]:
    """Yield the records that belong to no entry or do not show their level.

    Args:
        folder: the leaderboard's folder.
        entries: the readable entries, by path.
    """
    try:
        verified = read_verified(folder)
    except LagbenchError as error:
        yield str(error)
        return
    for name, line in verified.items():
        entry = entries.get(name)
        if entry is None or verification_of(entry, verified) is None:
            yield (
                f"{VERIFIED}, {name}: a record of other scores or models, or of no "
                "entry; remove it"
            )
        elif line.level is Level.REPRODUCED and (
            not line.reproduced or not all(model.agrees for model in line.reproduced)
        ):
            yield f"{VERIFIED}, {name}: the level is reproduced, and no models agree"


def _write(folder: Folder, verified: Mapping[str, Verification]) -> None:
    lines = {}
    for path, line in sorted(verified.items()):
        values = line.model_dump(exclude_defaults=True)
        first_keys = {"scores": line.scores, "lagbench": line.lagbench}
        always = {"date": line.date, "level": line.level}
        lines[path] = first_keys | always | values
    write_atomically(folder.path / VERIFIED, yaml_bytes(lines), option="--board")
