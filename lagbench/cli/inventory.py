"""The commands list and info: the splits, their cost, and the data on this machine."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lagbench.data.box import describe_bounds
from lagbench.data.layout import (
    format_ids,
    url_of,
)
from lagbench.data.local import load_rooted_registry, locate_split, resolve_root
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import LagbenchError, escape_line, hide_credentials
from lagbench.make.cards import describe_truth_error
from lagbench.make.inventory import Overview, overview

from .options import JsonFlag, RootOption
from .output import (
    format_bytes,
    format_seconds,
    print_json,
    print_line,
    print_table,
    print_warning,
)

COLUMNS = (
    "split",
    "size",
    "scenarios",
    "particles",
    "frames",
    "disk",
    "time",
    "here",
)
"""Columns of a table of sizes."""

TEXT_WIDTH = 79  # characters of a line of text

LEGEND = (
    "scenarios: of train/valid/test, then of extra and shift",
    "particles: of the largest scenario; frames: of all scenarios",
    "disk: space that the scenarios need at most",
    "time: about, on all cores of this machine",
    "here: whether the scenarios are on this machine, or how many of them are",
)
"""Lines that say what the columns mean."""


def list_command(*, root: RootOption = None, as_json: JsonFlag = False) -> None:
    """List all splits and sizes, their cost, and the data on this machine."""
    folder = resolve_root(root)
    registry = load_rooted_registry(folder, load())
    overviews: list[Overview] = []
    for name in registry.splits:
        overviews += _overviews_of_split(registry, name, folder)
    for name in registry.local_names():
        try:
            overviews += _overviews_of_split(registry, name, folder)
        except (LagbenchError, OSError) as error:
            print_warning(f"{name} is left out: {error}")
    if as_json:
        print_json({"root": folder, "sizes": overviews})
        return
    print_table("", COLUMNS, map(_format_row, overviews))
    for line in LEGEND:
        print_line(line)
    print_line(
        f"folder of all data sets: {hide_credentials(url_of(folder) or str(folder))}"
    )


def _overviews_of_split(registry: Registry, split: str, folder: Path) -> list[Overview]:
    """Return the overviews of a split; a size that may not be read gives a warning."""
    overviews = []
    for size_name in registry.split(split).sizes:
        try:
            overviews.append(overview(registry.size(split, size_name), folder))
        except OSError as error:
            print_warning(f"{split} {size_name} is left out: {error}")
    return overviews


def _format_row(entry: Overview) -> tuple[object, ...]:
    duration = "-"
    if entry.seconds:
        duration = format_seconds(entry.seconds)
    return (
        entry.split,
        entry.size,
        "/".join(map(str, entry.scenarios.values())),
        entry.particles,
        entry.frames,
        format_bytes(entry.bytes),
        duration,
        entry.state,
    )


def info_command(
    split: str,
    *,
    size: str | None = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Show the task, sizes, parameters and local data of a split.

    Args:
        split: Name of the split, or folder of a local one.
        size: One size; all sizes by default.
    """
    name, folder, registry = locate_split(split, root=root)
    entry = registry.split(name)
    all_sizes = [registry.size(name, size_name) for size_name in entry.sizes]
    if size:
        shown_sizes = [registry.size(name, size)]
    else:
        shown_sizes = all_sizes
    overviews = [overview(shown_size, folder) for shown_size in shown_sizes]
    if as_json:
        sizes = {}
        for shown_size, size_overview in zip(shown_sizes, overviews, strict=True):
            sizes[shown_size.name] = _size_as_json(shown_size, size_overview)
        facts = ("version", "title", "description", "citation", "licence")
        stated = {fact: getattr(entry, fact) for fact in facts}
        print_json({"split": name, **stated, "sizes": sizes})
        return

    description = textwrap.fill(entry.description, TEXT_WIDTH, break_on_hyphens=False)
    # Strangers describe local splits.
    title = escape_line(entry.title)
    licence = escape_line(entry.licence)
    print_line(f"{title} ({name} {entry.version}, {licence})")
    for shown_size, size_overview in zip(shown_sizes, overviews, strict=True):
        for line in _describe_size(shown_size, size_overview):
            print_line(line)
    print_line("")
    print_table("Sizes", COLUMNS, map(_format_row, overviews))
    print_line(f"\n{description}\n")
    rows = []
    for parameter_name, parameter in entry.parameters.items():
        values = []
        for one in all_sizes:
            known = one.parameters.get(parameter_name)
            values.append(known.value if known else "-")
        meaning = escape_line(f"[{parameter.unit}] {parameter.description}")
        rows.append((escape_line(parameter_name), *values, meaning))
    columns = ("name", *entry.sizes, "[unit] meaning")
    print_table("Parameters", columns, rows)


def _size_as_json(size: Size, size_overview: Overview) -> dict[str, Any]:
    parameters = {}
    for name, parameter in size.parameters.items():
        parameters[name] = parameter.model_dump()
    return {
        "overview": size_overview,
        "parameters": parameters,
        "task": size.task.model_dump(),
        "subsets": size.subsets,
        "bounds": size.bounds,
        "periodic": size.periodic,
        "dt": size.dt,
        "frame_interval": size.frame_interval,
        "refinement": size.refinement,
        "truth_error": size.truth_error,
    }


def _describe_size(size: Size, size_overview: Overview) -> Iterator[str]:
    subsets = []
    for name, ids in size.subsets.items():
        subsets.append(f"{name} {format_ids(ids)}")
    task = size.task
    yield f"{size_overview.split} {size_overview.size}"
    yield (
        f"  task       {task.input_frames} frames given, {task.horizon} to predict, "
        f"radius {task.radius}"
    )
    yield f"  scenarios  {'; '.join(subsets)}"
    yield (
        f"  frame      {size.frame_interval:.6g} s, "
        f"{size.substeps_per_frame} substeps of {size.dt:.6g} s"
    )
    yield (
        f"  truth      refinement {size.refinement}, error {describe_truth_error(size)}"
    )
    yield f"  box        {describe_bounds(size.bounds, size.periodic)}"
    yield f"  hash       {size_overview.dataset_sha256 or 'not measured yet'}"
    yield f"  folder     {size_overview.folder} (there: {size_overview.state})"
    yield f"  picture    {size_overview.picture or 'none'}"
