"""The command cite."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version

from lagbench.data.local import locate_split
from lagbench.data.registry import Split, default_path, load
from lagbench.errors import escape_line

from .options import JsonFlag, RootOption
from .output import print_result

# Title and year of this version, as in CITATION.cff.
TITLE = (
    "lagbench: bit-reproducible data sets and benchmarks "
    "for neural surrogates of Lagrangian continuum simulators"
)
RELEASE_YEAR = 2026

RELEASE_FIELDS = {"author": "The lagbench authors", "year": str(RELEASE_YEAR)}
"""Fields of BibTeX entries of lagbench and of its splits."""

UNKNOWN_LICENCE = "unknown"
NO_CITATION = "none"
"""What the description of a local split has where nothing is stated."""

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
    split: str | None = None,
    *,
    bibtex: bool = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print how to cite a split: version, hashes and original works.

    Without a split it prints how to cite lagbench itself. The authors of other people's
    splits are those who made the data, so no author is printed for them.

    Args:
        split: Name of the split; without it, lagbench itself.
        bibtex: Print the BibTeX entry only.
    """
    if split is None:
        _cite_program(bibtex=bibtex, as_json=as_json)
        return

    name, _, registry = locate_split(split, root=root)
    entry = registry.split(name)
    hashes = {}
    for size in entry.sizes:
        measured = registry.size(name, size).measured
        if measured is not None:
            hashes[size] = measured.dataset_sha256
    path = registry.files.get(name)
    # of a user or another package
    is_foreign = path is None or path.resolve() != default_path().resolve()
    if bibtex:
        text = _split_bibtex(name, entry, hashes, is_foreign=is_foreign)
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
    of_lagbench = f"lagbench, split {name!r} ({title})"
    if is_foreign:
        of_lagbench = f"split {name!r} ({title})"
    words = [of_lagbench, f"version {entry.version}"]
    if entry.licence != UNKNOWN_LICENCE:
        words.append(escape_line(entry.licence))
    lines = [", ".join(words) + "."]
    if entry.citation != NO_CITATION:
        lines.append(f"After: {escape_line(entry.citation)}.")
    if is_foreign and len(lines) == 1:
        lines.append(
            "Its description names no work to cite: see `citation` and `licence` in "
            "its split.yaml."
        )
    for size, sha256 in hashes.items():
        lines.append(f"Data set hash of size {size}: {sha256}")
    print_result(citation, lines, as_json=as_json)


def _cite_program(*, bibtex: bool, as_json: bool) -> None:
    """Print how to cite lagbench itself."""
    program_version = version("lagbench")
    if bibtex:
        fields = {"title": TITLE, "version": program_version, **RELEASE_FIELDS}
        text = _format_bibtex("software", "lagbench", fields)
        print_result({"bibtex": text}, [text], as_json=as_json)
        return
    citation = {"title": TITLE, "version": program_version, "year": RELEASE_YEAR}
    lines = [
        f"The lagbench authors, {TITLE}, version {program_version}, {RELEASE_YEAR}.",
        f"Splits: {', '.join(load().splits)}; `lagbench cite cavity` cites one.",
    ]
    print_result(citation, lines, as_json=as_json)


def _split_bibtex(
    name: str, entry: Split, hashes: Mapping[str, str], *, is_foreign: bool
) -> str:
    title = f"{entry.title}: split {name} of lagbench"
    if is_foreign:
        title = entry.title
    fields = {"title": title, "version": entry.version}
    if entry.licence != UNKNOWN_LICENCE:
        fields["license"] = entry.licence
    notes = []
    if entry.citation != NO_CITATION:
        notes.append(f"After {entry.citation}")
    if hashes:
        listing = ", ".join(f"{size} {sha256}" for size, sha256 in hashes.items())
        notes.append(f"SHA-256 of the data sets: {listing}")
    if notes:
        fields["note"] = ". ".join(notes)
    if is_foreign:
        return _format_bibtex("misc", name, fields)
    return _format_bibtex("misc", f"lagbench-{name}", {**fields, **RELEASE_FIELDS})


def _format_bibtex(kind: str, key: str, fields: Mapping[str, str]) -> str:
    """Return a BibTeX entry; characters that TeX would read as commands are replaced.

    The author is kept as it is, in braces.
    """
    escapes = str.maketrans(TEX_ESCAPES)

    lines = [f"@{kind}{{{key},"]
    if "author" in fields:
        # The inner braces keep BibTeX from taking the name of the authors apart.
        lines.append(f"  author = {{{{{fields['author']}}}}},")
    for name, value in fields.items():
        if name == "author":
            continue
        line = " ".join(value.split())
        lines.append(f"  {name} = {{{line.translate(escapes)}}},")
    lines.append("}")
    return "\n".join(lines)
