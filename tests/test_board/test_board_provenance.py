"""Provenance of predictions: data, sentence, and what older entries say."""

from __future__ import annotations

from pathlib import Path

import pytest
from board_bench import BoardBench, copied, nearer
from hypothesis import given
from hypothesis import strategies as st

from lagbench.board.entry_file import read_entry
from lagbench.submission import open_predictions
from lagbench.submission.provenance import StartWeights, TrainingProvenance

LEADERBOARD = Path(__file__).parents[2] / "leaderboard"

WORDS = st.from_regex(r"[a-z][a-z0-9-]{0,9}", fullmatch=True)
VALUES = st.sampled_from(["0.5", "true", "[15, 30, 60]", '["train", "extra"]'])
OVERRIDES = st.lists(
    st.builds("model.{}={}".format, st.sampled_from(["width", "noise_std"]), VALUES),
    max_size=3,
).map(tuple)
STARTS = st.builds(StartWeights, recipe=WORDS, weights=st.just("0123456789ab"))
PROVENANCES = st.builds(
    TrainingProvenance,
    split=WORDS,
    size=WORDS,
    subsets=st.lists(WORDS, min_size=1, max_size=2).map(tuple),
    recipe=WORDS,
    step=st.integers(0, 10**9),
    overrides=OVERRIDES,
    start=st.none() | STARTS,
    prediction_overrides=OVERRIDES,
)


@given(PROVENANCES)
def test_sentence_and_json_hold_the_same(provenance: TrainingProvenance) -> None:
    """Both come back, whichever changes there are."""
    assert TrainingProvenance.from_sentence(provenance.describe()) == provenance
    assert TrainingProvenance.from_json(provenance.to_json()) == provenance


@pytest.mark.parametrize(
    "sentence",
    [
        "",
        "three nights on my own cluster",
        "a tiny model, recipe my own, step by step",
        "cavity mini train, recipe cavity/mini",
    ],
)
def test_words_of_a_person_are_no_provenance(sentence: str) -> None:
    """Nothing is guessed from them."""
    assert TrainingProvenance.from_sentence(sentence) is None


def test_every_committed_entry_has_a_provenance() -> None:
    """Entries have the sentence alone, and it comes back letter by letter.

    An ONNX file does not state its training.
    """
    paths = sorted((LEADERBOARD / "submissions").glob("*/*/*.yaml"))
    assert len(paths) > 50
    for path in paths:
        entry = read_entry(path)
        weights = entry.predictions[0].weights
        if weights is not None and weights.path.endswith(".onnx"):
            assert entry.provenance is None
            continue
        assert entry.provenance is not None
        assert entry.provenance.describe() == entry.training


def test_the_attribute_wins_over_the_sentence(home: Path, tmp_path: Path) -> None:
    """An entry keeps the provenance of its predictions, and the sentence beside it."""
    bench: BoardBench = copied(home, tmp_path)
    provenance = TrainingProvenance(
        split="cavity", size="tiny", subsets=("train",), recipe="cavity/tiny", step=6
    )
    path = bench.predict(
        nearer, "mine", training="in words", provenance=provenance.to_json()
    )
    with open_predictions(path) as opened:
        assert opened.header.provenance == provenance
    bench.submit(path)
    entry = read_entry(bench.entry("mine"))
    assert entry.training == "in words"
    assert entry.predictions[0].provenance == provenance
    assert entry.provenance == provenance
