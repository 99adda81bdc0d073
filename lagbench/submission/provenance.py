"""Provenance of predictions: the training behind them, as data and as a sentence.

A predictions.nc holds the provenance as the JSON attribute ``provenance``, and as the
attribute ``training``, a sentence for people. Older files and entries of the
leaderboard have the sentence alone.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

MOST_OVERRIDES = 200
"""Most changed options of one training or prediction."""

Word = Annotated[str, StringConstraints(pattern=r"^[!-~]{1,200}$")]
Override = Annotated[str, StringConstraints(pattern=r"^[ -~]{1,1000}$")]
Overrides = Annotated[tuple[Override, ...], Field(max_length=MOST_OVERRIDES)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class StartWeights(_Strict):
    """The weights that a training started from."""

    recipe: Word = Field(description="recipe of the training that made them")
    weights: Word = Field(description="first digits of the SHA-256 of their file")


class TrainingProvenance(_Strict):
    """The training behind predictions, and the options that the prediction changed."""

    split: Word
    size: Word
    subsets: Annotated[tuple[Word, ...], Field(min_length=1, max_length=20)] = Field(
        description="subsets that gave training windows"
    )
    recipe: Word
    step: Annotated[int, Field(ge=0, lt=10**15)] = Field(
        description="optimiser step of the weights"
    )
    overrides: Overrides = Field(
        default=(), description="options of the recipe that the training changed"
    )
    start: StartWeights | None = None
    prediction_overrides: Overrides = Field(
        default=(), description="options that the prediction changed"
    )

    def to_json(self) -> str:
        """Return the provenance as compact JSON; defaults are left out."""
        return self.model_dump_json(exclude_defaults=True)

    def describe(self) -> str:
        """Return the provenance as a sentence for people."""
        subsets = "+".join(self.subsets)
        sentence = (
            f"{self.split} {self.size} {subsets}, recipe {self.recipe}, "
            f"step {self.step}"
        )
        changes = self.describe_changes()
        if changes:
            return f"{sentence}, {changes}"
        return sentence

    def describe_changes(self) -> str:
        """Return the differences from the recipe in words; empty if there are none."""
        changes = list(self.overrides)
        if self.start is not None:
            start = self.start
            changes.append(f"started from {start.recipe}, weights {start.weights}")
        if self.prediction_overrides:
            settings = ", ".join(self.prediction_overrides)
            changes.append(f"predicted with {settings}")
        return ", ".join(changes)
