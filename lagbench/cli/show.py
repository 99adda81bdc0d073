"""Commands that say what there is: list, info, cite."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from .options import JsonFlag, RootOption, SplitArgument, SplitOption, chosen
from .output import print_json, print_table, say, spell_bytes, spell_seconds

if TYPE_CHECKING:
    from lagbench.overview import Overview
    from lagbench.registry import Registry, Size

__all__ = ["cite", "info", "list_splits"]


def list_splits(root: RootOption = None, as_json: JsonFlag = False) -> None:
    """List the splits and sizes, what they cost, and what is generated here."""
    from lagbench.layout import resolve_root
    from lagbench.locating import rooted
    from lagbench.overview import overview
    from lagbench.registry import load
    from lagbench.working_copy import url_of

    folder = resolve_root(root)
    registry = rooted(folder, load())
    found = [
        overview(registry.size(name, size), folder)
        for name in (*registry.splits, *registry.local_names())
        for size in _sizes(registry, name)
    ]
    if as_json:
        print_json({"root": folder, "sizes": found})
        return
    rows = [_row(entry) for entry in found]
    print_table("", ("split", "size", *_COLUMNS), rows)
    say(f"data sets live in {url_of(folder) or folder}")


_COLUMNS = ("scenarios", "particles", "frames", "disk", "time", "here")


def _sizes(registry: Registry, split: str) -> list[str]:
    return list(registry.split(split).sizes)


def _row(entry: Overview) -> tuple[object, ...]:
    return (
        entry.split,
        entry.size,
        "/".join(str(count) for count in entry.scenarios.values()),
        entry.particles,
        entry.frames,
        spell_bytes(entry.bytes),
        spell_seconds(entry.seconds) if entry.seconds else "-",
        entry.state,
    )


def info(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="NAME", help="One size in full; all in brief by default.")
    ] = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Show a split: parameters with units, sizes in bytes, time to generate, local state."""
    from lagbench.locating import home
    from lagbench.overview import overview

    split_name, folder, registry = home(chosen(name, split), root=root)
    entry = registry.split(split_name)
    sizes = [registry.size(split_name, one) for one in ([size] if size else entry.sizes)]
    found = [overview(one, folder) for one in sizes]
    if as_json:
        print_json(_facts(registry, split_name, sizes, found))
        return
    say(f"{entry.title} ({split_name} {entry.version}, {entry.licence})\n{entry.description}\n")
    print_table("Sizes", ("split", "size", *_COLUMNS), [_row(one) for one in found])
    print_table("Parameters", ("name", *entry.sizes, "unit", "meaning"), _parameters(registry, split_name))
    for one, tier in zip(found, sizes, strict=True):
        say("\n".join(_details(one, tier)))


def _parameters(registry: Registry, split: str) -> list[tuple[object, ...]]:
    entry = registry.split(split)
    tiers = [registry.size(split, size) for size in entry.sizes]
    return [
        (name, *(tier.value(name) for tier in tiers), parameter.unit, parameter.description)
        for name, parameter in entry.parameters.items()
    ]


def _details(entry: Overview, size: Size) -> list[str]:
    from lagbench.scenario_ids import spell_ids

    task = size.task
    subsets = "; ".join(f"{name} {spell_ids(ids)}" for name, ids in size.subsets.items())
    return [
        f"{entry.split} {entry.size}",
        f"  scenarios  {subsets}",
        f"  task       {task.input_frames} frames given, {task.horizon} to predict, radius {task.radius}",
        f"  frame      {size.frame_interval:.6g} s, {size.substeps_per_frame} substeps of {size.dt:.6g} s",
        f"  hash       {entry.dataset_sha256 or 'not measured yet'}",
        f"  folder     {entry.folder} (there: {entry.state})",
        f"  picture    {entry.picture or 'none'}",
    ]


def _facts(registry: Registry, split: str, sizes: list[Size], found: list[Overview]) -> dict[str, object]:
    entry = registry.split(split)
    described = {
        tier.name: {
            "overview": one,
            "parameters": {name: p.model_dump() for name, p in tier.parameters.items()},
            "subsets": tier.subsets,
            "task": tier.task.model_dump(),
            "bounds": tier.bounds,
            "dt": tier.dt,
            "frame_interval": tier.frame_interval,
        }
        for tier, one in zip(sizes, found, strict=True)
    }
    head = {key: getattr(entry, key) for key in ("version", "title", "description", "citation", "licence")}
    return {"split": split, **head, "sizes": described}


def cite(
    name: SplitArgument = None,
    split: SplitOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print how to cite a split: version, hashes of its sizes, and the works behind it."""
    from lagbench.locating import home

    split_name, _, registry = home(chosen(name, split), root=root)
    entry = registry.split(split_name)
    measured = registry.measured.get(split_name, {})
    hashes = {size: values.dataset_sha256 for size, values in measured.items()}
    facts = {
        "split": split_name,
        "version": entry.version,
        "title": entry.title,
        "licence": entry.licence,
        "citation": entry.citation,
        "dataset_sha256": hashes,
    }
    if as_json:
        print_json(facts)
        return
    say(f"lagbench, split {split_name!r} ({entry.title}), version {entry.version}, {entry.licence}.")
    say(f"After: {entry.citation}.")
    for size, value in hashes.items():
        say(f"Data set hash of size {size}: {value}")
