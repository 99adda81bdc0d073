"""The command cite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import lagbench
from lagbench.data.local import locate_split
from lagbench.data.registry import Split, load
from lagbench.errors import escape_line

from .options import (
    JsonFlag,
    RootOption,
    SplitArgument,
    SplitOption,
    choose_split,
    option,
)
from .output import print_result

# Title and year of this version, as in CITATION.cff.
TITLE = (
    "lagbench: bit-reproducible data sets and benchmarks "
    "for neural surrogates of Lagrangian continuum simulators"
)
RELEASE_YEAR = 2026

# BibTeX counts braces, also those behind a backslash, so that none may stand alone.
TEX_ESCAPES = {
    "\\": "/",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\textbraceleft{}",
    "}": r"\textbraceright{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def cite_command(
    split_argument: SplitArgument = None,
    split_option: SplitOption = None,
    bibtex: Annotated[bool, option("--bibtex", "Print the BibTeX entry only.")] = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print how to cite a split: version, hashes and original works.

    Without a split it prints how to cite lagbench itself.
    """
    if split_argument is None and split_option is None:
        _cite_program(bibtex=bibtex, as_json=as_json)
        return

    split = choose_split(split_argument, split_option)
    name, _, registry = locate_split(split, root=root)
    entry = registry.split(name)
    hashes = {}
    for size in entry.sizes:
        measured = registry.size(name, size).measured
        if measured is not None:
            hashes[size] = measured.dataset_sha256
    if bibtex:
        text = _split_bibtex(name, entry, hashes)
        print_result({"bibtex": text}, [text], as_json=as_json)
        return

    citation = {
        "split": name,
        "version": entry.version,
        "title": entry.title,
        "licence": entry.licence,
        "citation": entry.citation,
        "dataset_sha256": hashes,
    }
    # strangers describe local splits
    title = escape_line(entry.title)
    licence = escape_line(entry.licence)
    lines = [
        f"lagbench, split {name!r} ({title}), version {entry.version}, {licence}.",
        f"After: {escape_line(entry.citation)}.",
    ]
    for size, sha256 in hashes.items():
        lines.append(f"Data set hash of size {size}: {sha256}")
    print_result(citation, lines, as_json=as_json)


def _cite_program(*, bibtex: bool, as_json: bool) -> None:
    """Print how to cite lagbench itself."""
    version = lagbench.__version__
    if bibtex:
        fields = {"title": TITLE, "version": version}
        text = _format_bibtex("software", "lagbench", fields)
        print_result({"bibtex": text}, [text], as_json=as_json)
        return
    citation = {"title": TITLE, "version": version, "year": RELEASE_YEAR}
    lines = [
        f"The lagbench authors, {TITLE}, version {version}, {RELEASE_YEAR}.",
        f"Splits: {', '.join(load().splits)}; `lagbench cite cavity` cites one.",
    ]
    print_result(citation, lines, as_json=as_json)


def _split_bibtex(name: str, entry: Split, hashes: Mapping[str, str]) -> str:
    note = f"After {entry.citation}"
    if hashes:
        listing = ", ".join(f"{size} {sha256}" for size, sha256 in hashes.items())
        note += f". SHA-256 of the data sets: {listing}"
    fields = {
        "title": f"{entry.title}: split {name} of lagbench",
        "version": entry.version,
        "license": entry.licence,
        "note": note,
    }
    return _format_bibtex("misc", f"lagbench-{name}", fields)


def _format_bibtex(kind: str, key: str, fields: Mapping[str, str]) -> str:
    """Return a BibTeX entry by the authors of lagbench.

    Characters that TeX would read as commands are escaped.
    """
    escapes = str.maketrans(TEX_ESCAPES)

    # The inner braces keep BibTeX from taking the name of the authors apart.
    lines = [f"@{kind}{{{key},", "  author = {{The lagbench authors}},"]
    for name, value in {**fields, "year": str(RELEASE_YEAR)}.items():
        line = " ".join(value.split())
        lines.append(f"  {name} = {{{line.translate(escapes)}}},")
    lines.append("}")
    return "\n".join(lines)
