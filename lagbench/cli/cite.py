"""The command cite."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version

from lagbench.data.local import locate_split
from lagbench.data.registry import default_path

from .options import RootOption
from .output import print_line

# Title and year of this version, as in CITATION.cff.
TITLE = (
    "lagbench: bit-reproducible data sets and benchmarks "
    "for neural surrogates of Lagrangian continuum simulators"
)
# The inner braces keep BibTeX from taking the name of the authors apart.
RELEASE_LINES = ("  author = {{The lagbench authors}},", "  year = {2026},")
"""Lines of the entries of lagbench and of its splits."""

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


def cite_command(split: str | None = None, *, root: RootOption = None) -> None:
    """Print how to cite a split, as an entry of BibTeX: version, hashes, works.

    Without a split it is the entry of lagbench itself. The authors of other people's
    splits are those who made the data, so no author is printed for them.

    Args:
        split: Name of the split; without it, lagbench itself.
    """
    if split is None:
        fields = {"title": TITLE, "version": version("lagbench")}
        _print_bibtex("@software{lagbench,", fields, is_ours=True)
        return

    name, _, registry = locate_split(split, root=root)
    entry = registry.split(name)
    path = registry.files.get(name)
    is_ours = path is not None and path.resolve() == default_path().resolve()
    fields = {"title": entry.title, "version": entry.version}
    key = name
    if is_ours:
        fields["title"] = f"{entry.title}: split {name} of lagbench"
        key = f"lagbench-{name}"
    if entry.licence != UNKNOWN_LICENCE:
        fields["license"] = entry.licence
    notes = []
    if entry.citation != NO_CITATION:
        notes.append(f"After {entry.citation}")
    for size in entry.sizes:
        measured = registry.size(name, size).measured
        if measured is not None:
            notes.append(f"SHA-256 of size {size}: {measured.dataset_sha256}")
    if notes:
        fields["note"] = ". ".join(notes)
    _print_bibtex(f"@misc{{{key},", fields, is_ours=is_ours)


def _print_bibtex(first_line: str, fields: Mapping[str, str], *, is_ours: bool) -> None:
    """Print an entry; characters that TeX would read as commands are replaced."""
    escapes = str.maketrans(TEX_ESCAPES)
    print_line(first_line)
    for name, value in fields.items():
        words = " ".join(value.split())
        print_line(f"  {name} = {{{words.translate(escapes)}}},")
    if is_ours:
        for line in RELEASE_LINES:
            print_line(line)
    print_line("}")
