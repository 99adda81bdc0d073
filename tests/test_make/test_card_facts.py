"""What a card says of files that state some numbers only, and of unlike scenarios."""

from __future__ import annotations

import math
from pathlib import Path

from scenario_factory import make_key, write_scenario

from lagbench.data.manifest import Manifest, describe_file, merge_entries
from lagbench.data.registry import load
from lagbench.make.cards import card_texts


def describe(root: Path) -> Manifest:
    """Write test scenarios of 8 and 16 particles; return their manifest."""
    size = load().size("cavity", "tiny")
    entries = []
    for scenario, particles in ((3, 8), (4, 16)):
        write_scenario(root, make_key(scenario), particles=particles)
        entries.append(describe_file(root, size.key(scenario)))
    return merge_entries(size, None, entries)


def rows_of(manifest: Manifest) -> list[list[str]]:
    """Return the cells of all rows of the tables of a card."""
    registry = load()
    size = registry.size("cavity", "tiny")
    texts = card_texts(size, registry.split("cavity"), manifest)
    rows = []
    for line in texts["README.md"].decode().splitlines():
        if line.startswith("| "):
            rows.append(line.strip("| ").split(" | "))
    return rows


def test_numbers_of_particles_are_a_range_where_scenarios_differ(
    tmp_path: Path,
) -> None:
    assert ["particles", "8 to 16"] in rows_of(describe(tmp_path))


def test_a_file_that_states_some_numbers_counts_with_these(tmp_path: Path) -> None:
    """Files of others need not state all that ours do."""
    manifest = describe(tmp_path)
    first, second = manifest.files
    some = first.model_copy(update={"facts": {"mach_999": 0.25}})
    more = second.model_copy(update={"facts": {"mach_999": 0.125, "mach_max": 0.5}})
    rows = rows_of(manifest.model_copy(update={"files": (some, more)}))
    numbers = []
    for row in rows:
        if row[0].startswith("speed over speed of sound"):
            numbers.append(row[1])
    assert numbers == ["0.25", "0.5"]


def test_limits_whose_sum_is_no_float_have_an_endless_mean(tmp_path: Path) -> None:
    """A manifest is the word of whoever wrote it."""
    manifest = describe(tmp_path)
    limited = []
    for entry in manifest.files:
        limited.append(entry.model_copy(update={"twin_floor": (1e-3, 1e308)}))
    manifest = manifest.model_copy(update={"files": tuple(limited)})
    assert manifest.mean_twin_floor() == (1e-3, math.inf)
    limits = []
    for row in rows_of(manifest):
        if row[0].startswith("perturbed run"):
            limits.append(row[1])
    assert len(limits) == 1
    assert limits[0].endswith("inf at the last")
