"""Names of the files that describe a data set beside its manifest."""

from __future__ import annotations

from collections.abc import Mapping

CARD_NAME = "README.md"
CROISSANT_NAME = "croissant.json"

# path relative to the card, and what it shows
PICTURES: Mapping[str, str] = {
    "pictures/scenarios.png": "scenarios of this data set",
    "pictures/frame.png": "one frame of a test scenario",
}
