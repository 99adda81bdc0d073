"""Commands that make and check data: generate, verify.

Commands that say what there is: list, info, cite. Commands that look after the
installation: doctor, clean.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import lagbench
from lagbench.errors import LagbenchError

from .options import (
    DeviceOption,
    JsonFlag,
    NewSizeOption,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SchedulerOption,
    SplitArgument,
    SplitOption,
    SubsetOption,
    WorkersOption,
    chosen,
    option,
)
from .output import (
    print_json,
    print_table,
    progress_bar,
    show,
    spell_bytes,
    spell_seconds,
)

if TYPE_CHECKING:
    from lagbench.make.generate import GenerationResult
    from lagbench.make.inventory import Overview
    from lagbench.make.verify import VerificationResult

TITLE = (
    "lagbench: bit-reproducible data sets and benchmarks "
    "for neural surrogates of Lagrangian continuum simulators"
)
ESTIMATED = "estimated; measured after the first generate"
MEASURED = "at the rate measured here"  # where an expected time comes from
RELEASED = 2026  # year of this version; it and the title as in CITATION.cff


def generate(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: NewSizeOption = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = "cpu",
    scheduler: SchedulerOption = None,
    gather: Annotated[
        list[Path] | None,
        option("--gather FOLDER", "Take what another root has finished; repeatable."),
    ] = None,
    force: Annotated[bool, option("--force", "Simulate anew what is there.")] = False,
    dry_run: Annotated[
        bool, option("--dry-run", "Say what it takes: bytes, time, free disk.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Simulate a split to files; goes on where an earlier call stopped."""
    from lagbench.make.generate import generate as run

    with progress_bar(quiet=quiet or dry_run) as draw:
        result = run(
            chosen(name, split),
            size,
            subset=subset,
            scenarios=scenarios,
            root=root,
            workers=workers,
            device=device,
            scheduler=scheduler,
            gather=gather or (),
            force=force,
            dry_run=dry_run,
            progress=draw,
            on_wait=lambda holder: typer.echo(
                f"lagbench: waiting for {holder}", err=True
            ),
        )
    show(result, _generated(result), as_json=as_json, quiet=quiet)


def _generated(result: GenerationResult) -> list[str]:
    from lagbench.data.layout import url_of
    from lagbench.data.registry import format_ids

    to_do = len(result.simulated)
    if result.dry_run:
        return [
            f"{result.split} {result.size}: {to_do} scenarios to simulate, "
            f"{len(result.kept)} are there",
            f"  disk    at most {spell_bytes(result.bytes_needed)} "
            f"({result.bytes_needed} bytes);"
            f" {spell_bytes(result.bytes_free)} free in {result.root}",
            f"  time    about {spell_seconds(result.seconds_expected)} with "
            f"{result.workers} workers"
            f" ({MEASURED if result.measured else ESTIMATED})",
        ]
    took = f"in {result.seconds:.1f} s"
    done = f"{to_do} scenarios simulated {took}, {len(result.kept)} kept"
    if not to_do:
        done = f"nothing to simulate, {len(result.kept)} scenarios are there; checked {took}"
    lines = [f"{result.split} {result.size}: {done}", f"  folder  {result.folder}"]
    if (url := url_of(result.root)) is not None:
        lines.append(
            f"  store   {url}/{result.folder.relative_to(result.root).as_posix()}"
        )
    if result.missing:
        lines.append(
            f"  missing {format_ids(result.missing)}: the data set is incomplete"
        )
    if result.dataset_sha256:
        lines.append(f"  hash    {result.dataset_sha256}")
    return [*lines, f"  check   {result.verdict}"]


def verify(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: PresentSizeOption = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    regenerate: Annotated[
        int, option("--regenerate K", "Simulate K scenarios anew and compare.", min=0)
    ] = 0,
    complete: Annotated[
        bool, option("--complete", "Fail if anything is missing.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Hash the files of a split again and compare them with datasets.yaml."""
    from lagbench.make.verify import verify as run

    with progress_bar(quiet=quiet) as draw:
        result = run(
            chosen(name, split),
            size,
            subset=subset,
            scenarios=scenarios,
            root=root,
            workers=workers,
            regenerate=regenerate,
            complete=complete,
            progress=draw,
        )
    value = {**vars(result), "complete": result.complete}
    show(value, _verified(result), as_json=as_json, quiet=quiet)
    for warning in result.warnings:
        typer.echo(f"warning: {warning}", err=True)
    result.check()


def _verified(result: VerificationResult) -> Iterator[str]:
    rows = [
        (r.name, r.present, *map(len, (r.missing, r.wrong, r.extra)), r.verdict)
        for r in result.subsets
    ]
    columns = ("subset", "present", "missing", "wrong", "extra", "hash")
    print_table(f"{result.split} {result.size} in {result.folder}", columns, rows)
    if result.regenerated:
        listing = ", ".join(
            f"scenario {i} {word}" for i, word in result.regenerated.items()
        )
        yield f"regenerated: {listing}"
    yield f"data set hash: {result.verdict}"


def list_splits(root: RootOption = None, as_json: JsonFlag = False) -> None:
    """List the splits and sizes, what they cost, and what is generated here."""
    from lagbench.data.layout import url_of
    from lagbench.data.local import load_rooted_registry, resolve_root
    from lagbench.data.registry import load
    from lagbench.make.inventory import overview

    folder = resolve_root(root)
    registry = load_rooted_registry(folder, load())
    found = [
        overview(registry.size(name, s), folder)
        for name, one in registry.splits.items()
        for s in one.sizes
    ]
    for name in registry.local_names():
        try:
            found += [
                overview(registry.size(name, size), folder)
                for size in registry.split(name).sizes
            ]
        except (LagbenchError, OSError) as error:  # of one split; the others are told
            typer.echo(f"warning: {name} is left out: {error}", err=True)

    def listed() -> Iterator[str]:
        print_table("", ("split", "size", *_COLUMNS), [_row(entry) for entry in found])
        yield from _origin(found)
        yield f"data sets live in {url_of(folder) or folder}"

    show({"root": folder, "sizes": found}, listed(), as_json=as_json)


_COLUMNS = ("scenarios", "particles", "frames", "disk <=", "time", "here")


def _origin(found: list[Overview]) -> list[str]:
    """Say where the times of a table come from."""
    timed = [one for one in found if one.seconds]
    guessed = dict.fromkeys(one.split for one in timed if not one.measured)
    if not guessed:
        if timed:
            return [f"time: {MEASURED}"]
        return []
    if all(not one.measured for one in timed):
        others = ""
    else:
        others = f" of {', '.join(guessed)}"
    return [f"time{others}: {ESTIMATED}"]


def _row(entry: Overview) -> tuple[object, ...]:
    counts = "/".join(str(count) for count in entry.scenarios.values())
    cost = (
        spell_bytes(entry.bytes),
        spell_seconds(entry.seconds) if entry.seconds else "-",
    )
    return (
        entry.split,
        entry.size,
        counts,
        entry.particles,
        entry.frames,
        *cost,
        entry.state,
    )


def info(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: Annotated[
        str | None, option("--size NAME", "One size in full; all in brief by default.")
    ] = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Show a split: parameters with units, sizes in bytes, time to generate, local
    state.
    """
    from lagbench.data.local import locate_split
    from lagbench.data.registry import format_ids
    from lagbench.make.inventory import overview

    split_name, folder, registry = locate_split(chosen(name, split), root=root)
    entry = registry.split(split_name)
    sizes = [
        registry.size(split_name, one) for one in ([size] if size else entry.sizes)
    ]
    found = [overview(one, folder) for one in sizes]

    def told() -> Iterator[str]:
        text = textwrap.fill(entry.description, 79, break_on_hyphens=False)
        yield f"{entry.title} ({split_name} {entry.version}, {entry.licence})\n{text}\n"
        print_table("Sizes", ("split", "size", *_COLUMNS), [_row(one) for one in found])
        yield from (*_origin(found), "")
        tiers = [registry.size(split_name, one) for one in entry.sizes]
        parameters = [
            (
                name,
                *(tier.value(name) for tier in tiers),
                f"[{parameter.unit}] {parameter.description}",
            )
            for name, parameter in entry.parameters.items()
        ]
        print_table("Parameters", ("name", *entry.sizes, "[unit] meaning"), parameters)
        for one, tier in zip(found, sizes, strict=True):
            subsets = "; ".join(
                f"{name} {format_ids(ids)}" for name, ids in tier.subsets.items()
            )
            given = tier.task.input_frames
            horizon = tier.task.horizon
            radius = tier.task.radius
            yield f"{one.split} {one.size}"
            yield f"  scenarios  {subsets}"
            yield f"  task       {given} frames given, {horizon} to predict, radius {radius}"
            substeps = f"{tier.substeps_per_frame} substeps of {tier.dt:.6g} s"
            yield f"  frame      {tier.frame_interval:.6g} s, {substeps}"
            yield f"  hash       {one.dataset_sha256 or 'not measured yet'}"
            yield f"  folder     {one.folder} (there: {one.state})"
            yield f"  picture    {one.picture or 'none'}"

    described = {
        tier.name: {
            "overview": one,
            "parameters": {name: p.model_dump() for name, p in tier.parameters.items()},
            "task": tier.task.model_dump(),
            **{
                key: getattr(tier, key)
                for key in ("subsets", "bounds", "dt", "frame_interval")
            },
        }
        for tier, one in zip(sizes, found, strict=True)
    }
    head = {
        key: getattr(entry, key)
        for key in ("version", "title", "description", "citation", "licence")
    }
    show({"split": split_name, **head, "sizes": described}, told(), as_json=as_json)


def cite(
    name: SplitArgument = None,
    split: SplitOption = None,
    bibtex: Annotated[
        bool, option("--bibtex", "Print BibTeX; without a split, of lagbench itself.")
    ] = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print how to cite a split: version, hashes of its sizes, and the works behind
    it.
    """
    from lagbench.data.local import locate_split

    if bibtex and not (name or split):
        text = _bibtex(
            "software", "lagbench", title=TITLE, version=lagbench.__version__
        )
        show({"bibtex": text}, [text], as_json=as_json)
        return
    split_name, _, registry = locate_split(chosen(name, split), root=root)
    entry = registry.split(split_name)
    measured = registry.measured.get(split_name, {})
    hashes = {size: values.dataset_sha256 for size, values in measured.items()}
    head = {
        key: getattr(entry, key) for key in ("version", "title", "licence", "citation")
    }
    if bibtex:
        held = ", ".join(f"{size} {value}" for size, value in hashes.items())
        note = f"After {entry.citation}. SHA-256 of the data sets: {held}"
        title = f"{entry.title}: split {split_name} of lagbench"
        fields = {
            "title": title,
            "version": entry.version,
            "license": entry.licence,
            "note": note,
        }
        text = _bibtex("misc", f"lagbench-{split_name}", **fields)
        show({"bibtex": text}, [text], as_json=as_json)
        return
    words = [
        f"lagbench, split {split_name!r} ({entry.title}), version {entry.version}, "
        f"{entry.licence}.",
        f"After: {entry.citation}.",
        *(f"Data set hash of size {size}: {value}" for size, value in hashes.items()),
    ]
    show(
        {"split": split_name, **head, "dataset_sha256": hashes}, words, as_json=as_json
    )


def _bibtex(kind: str, key: str, **fields: str) -> str:
    """Return a BibTeX entry by the authors of lagbench; what TeX would read as a
    command is escaped.
    """
    plain = str.maketrans(
        {character: f"\\{character}" for character in "&%$#_{}"} | {"\\": "/"}
    )
    told = {**fields, "year": str(RELEASED)}
    lines = [
        f"  {name} = {{{value.translate(plain)}}}," for name, value in told.items()
    ]
    # The inner braces keep BibTeX from taking the name apart.
    return "\n".join(
        [f"@{kind}{{{key},", "  author = {{The lagbench authors}},", *lines, "}"]
    )


def doctor(root: RootOption = None, as_json: JsonFlag = False) -> None:
    """Check this machine: libraries, cores, disk, registry."""
    from lagbench.errors import ChecksFailedError

    from .machine import doctor as run

    diagnosis = run(root)
    if as_json:
        print_json(diagnosis)
    else:
        print_table(
            "",
            ("check", "state", "detail"),
            [(c.name, c.state, c.detail) for c in diagnosis.checks],
        )
    if not diagnosis.healthy:
        broken = ", ".join(
            check.name for check in diagnosis.checks if check.state == "broken"
        )
        raise ChecksFailedError(
            "this machine cannot run lagbench", got=f"broken: {broken}"
        )


def clean(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: PresentSizeOption = None,
    root: RootOption = None,
    leftovers: Annotated[
        bool, option("--leftovers", "Only temporary files of killed writers.")
    ] = False,
    dry_run: Annotated[bool, option("--dry-run", "Say what would go.")] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Remove a generated data set, or only what killed writers left of it."""
    from lagbench.make.clean import clean as run

    result = run(
        chosen(name, split), size, root=root, leftovers=leftovers, dry_run=dry_run
    )
    if dry_run:
        word = "would be removed"
    else:
        word = "removed"
    words = [
        *map(str, result.removed),
        f"{len(result.removed)} files, {spell_bytes(result.bytes)} {word}",
    ]
    show(result, words, as_json=as_json, quiet=quiet)
