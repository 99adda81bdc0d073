"""Read the data of a leaderboard's page back, as its script does."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.board.encoding import MISSING, decode

LONGEST = 2**26  # bytes


@dataclass(frozen=True)
class PageData:
    """The data of a page."""

    tabs: list[dict[str, Any]]
    hero: dict[str, Any] | None
    levels: NDArray[np.int16]
    starts: dict[str, int]  # place of the first number by kind of array

    def array(self, reference: dict[str, Any]) -> NDArray[np.float64]:
        """Return an array, shape [row, column], NaN where missing."""
        return read_array(self.levels, self.starts, reference)


def read_page_data(page: str) -> PageData:
    """Return the data that stand in a page."""
    data = json.loads(decode(element_text(page, "page-data"), longest=LONGEST))
    arrays = decode(element_text(page, "page-arrays"), longest=LONGEST)
    levels = read_levels(arrays)
    for tab in data["tabs"]:
        tab["columns"] = [data["columns"][place] for place in tab["columns"]]
    return PageData(
        tabs=data["tabs"], hero=data["hero"], levels=levels, starts=data["starts"]
    )


def read_levels(data: bytes) -> NDArray[np.int16]:
    """Return the stored differences, number by number."""
    count = len(data) // 2
    levels = np.empty(count, np.int16)
    for place in range(count):
        folded = data[place] + 256 * data[count + place]
        levels[place] = -(folded + 1) // 2 if folded % 2 else folded // 2
    return levels


def element_text(page: str, name: str) -> str:
    """Return the text of an element that holds encoded data."""
    pattern = f'<script type="text/plain" id="{name}">(.*?)</script>'
    (text,) = re.findall(pattern, page, re.DOTALL)
    return str(text)


def read_array(
    levels: NDArray[np.int16], starts: dict[str, int], reference: dict[str, Any]
) -> NDArray[np.float64]:
    """Return an array from all levels and the reference to it, number by number."""
    if "numbers" in reference:  # too great for levels
        return np.array(reference["numbers"], np.float64)[:, None]
    rows = reference["rows"]
    columns = reference["columns"]
    start = starts[reference["kind"]] + reference["start"]
    values = np.empty((rows, columns))
    for column in range(columns):
        level = 0
        for row in range(rows):
            place = start + row * columns + column
            # differences wrap around at 16 bits
            level = (level + int(levels[place]) + 2**15) % 2**16 - 2**15
            value = reference["zero"] + reference["step"] * level
            if reference["log"]:
                value = np.exp(value)
            values[row, column] = np.nan if level == MISSING else value
    return values
