"""Find a split and its data by name or folder; compare data with recorded hashes.

The *root folder* holds all data sets; a root in an object store has a working copy on
this machine.

A *local split* is a folder ``<root>/<name>/`` with its own description, ``split.yaml``
(laid out as datasets.yaml), and its data in the same places as those of any other
split. So ``--split path/to/own`` means the split ``own`` with the root folder
``path/to``; once the root is named (``--root path/to``), its name is enough. Files from
strangers carry names only: a path is understood where the user gives one, in
:func:`locate` and :func:`locate_split`, and nowhere else.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import platformdirs

from lagbench.atomic import write_atomically
from lagbench.errors import (
    SPLIT_NAMED,
    DataError,
    UnreadableFileError,
    UsageError,
    check_regular,
)

from .checksums import load_recorded_hashes, record_hashes
from .layout import (
    CACHE_VARIABLE,
    STORE_FILE,
    as_url,
    dataset_folder,
    expand_path,
    quote_root,
    refuse_homeless,
    url_of,
    working_copy_of,
)
from .manifest import read_or_empty
from .registry import (
    NO_GENERATOR,
    Measured,
    Registry,
    Size,
    Split,
    load,
    suggest_split,
)
from .scenario import check_scenario

ROOT_VARIABLE = "LAGBENCH_ROOT"
"""Environment variable that names the root folder."""

_ROOT_OPTION = f"--root or {ROOT_VARIABLE}"

_SCHEME_ALONE = re.compile(r"[a-z][a-z0-9+.-]+:/*")

DESCRIPTION = "split.yaml"
"""Name of the file that describes a local split; it stands in the split's folder."""

DEFAULT_NEW_SIZE = "mini"
"""Size to generate or download by default: minutes and some hundred MB."""

_SPLIT_NAME = re.compile(r"[a-z][a-z0-9_-]{0,63}")


# --- root folders ---------------------------------------------------------------------


def resolve_root(root: str | Path | None = None) -> Path:
    """Return the folder that holds all data sets.

    Args:
        root: root of the user; else ``LAGBENCH_ROOT``; else the platform's user data
            folder. A URL (``s3://bucket/prefix``) stands for its working copy, see
            :mod:`.layout`.

    Raises:
        UsageError: no file system can have a folder of that name, a file is in its
            place, or none is named and the user has no home folder.
        WorkFailedError: the working copy of a URL cannot be made.
    """
    named_root = _named_root(root)
    if named_root is None:
        folder = platformdirs.user_data_path("lagbench", appauthor=False)
        return refuse_homeless(folder, _ROOT_OPTION)
    url = as_url(named_root)
    if url is not None:
        copy = working_copy_of(url)
        if url_of(copy) != url:
            text = json.dumps({"url": url}, indent=1) + "\n"
            write_atomically(copy / STORE_FILE, text.encode(), option=CACHE_VARIABLE)
        return copy
    folder = expand_path(named_root, _ROOT_OPTION)
    if any(os.path.isfile(place) for place in (folder, *folder.parents)):
        raise UsageError(
            f"the root {folder} is, or lies below, a file; name a folder",
            where=_ROOT_OPTION,
        )
    return folder


def root_url(root: str | Path | None) -> str | None:
    """Return the URL of a root, without making its copy; None for a folder."""
    named_root = _named_root(root)
    if named_root is None:
        return None
    return as_url(named_root)


def _named_root(root: str | Path | None) -> str | Path | None:
    """Return the root of the user or of the environment; refuse an empty one."""
    if root is None:
        root = os.environ.get(ROOT_VARIABLE) or None
    if root is None:
        return None
    text = str(root)
    if not text.strip() or _SCHEME_ALONE.fullmatch(text):
        raise UsageError(
            f"this cannot be a root folder: {text!a}; name a folder; without a root "
            "the folder for user data is taken",
            where=_ROOT_OPTION,
        )
    return root


# --- splits of a root folder ----------------------------------------------------------


class SplitLocation(NamedTuple):
    """A split by name, the root folder of its data, and the registry with the split."""

    name: str
    root: Path
    registry: Registry


class SizeLocation(NamedTuple):
    """A size, the root folder of its data, and the registry with the split."""

    size: Size
    root: Path
    registry: Registry


class RootedRegistry(Registry):
    """A registry that also knows the local splits of one root folder.

    A local split never replaces one of the same name, and its description is read when
    it is first asked for.
    """

    def __init__(self, base: Registry, root: Path) -> None:
        super().__init__(base.splits, base.measured, base.files, base.package_splits)
        self.base = base
        self.root = root

    def split(self, name: str) -> Split:
        """Return a split by name."""
        if name not in self.splits and name in self.local_names():
            self._add(name)
        if name not in self.splits:
            known_names = (*self.splits, *self.local_names())
            raise UsageError(
                f"no split {name!r}; {suggest_split(name, known_names)}",
                where=SPLIT_NAMED,
            )
        return self.splits[name]

    def local_names(self) -> tuple[str, ...]:
        """Return the names of the root's local splits, sorted.

        Names that other splits have are left out.
        """
        try:
            descriptions = list(self.root.glob(f"*/{DESCRIPTION}"))
        except OSError:
            return ()
        names = []
        for path in descriptions:
            name = path.parent.name
            if is_split_name(name) and name not in self.base.splits:
                names.append(name)
        return tuple(sorted(names))

    def _add(self, name: str) -> None:
        path = self.root / name / DESCRIPTION
        split, measured = _read_description(path, name)
        self.splits[name] = split
        self.files[name] = path
        self.measured = {**self.measured, name: measured}


def is_split_name(text: str) -> bool:
    """Tell whether a text can name a split: a path cannot.

    >>> is_split_name("dam-break"), is_split_name("../dam-break")
    (True, False)
    """
    return _SPLIT_NAME.fullmatch(text) is not None


def suggest_split_of(name: str) -> str:
    """Return a hint which split to name for a file that states the split of a name.

    >>> suggest_split_of("dam")
    'give the split of the file, --split dam, or of a split of your own its folder; or leave --split out'
    """  # noqa: E501
    if not is_split_name(name):
        return "leave --split out"
    return (
        f"give the split of the file, --split {name}, or of a split of your own its "
        "folder; or leave --split out"
    )


def load_rooted_registry(
    root: Path, registry: Registry | None = None
) -> RootedRegistry:
    """Return a registry that also knows the local splits of a root folder, by name.

    Args:
        root: folder of all data sets.
        registry: the other splits; ours when None.
    """
    base = registry or load()
    if isinstance(base, RootedRegistry):
        base = base.base
    return RootedRegistry(base, root)


def _read_description(path: Path, name: str) -> tuple[Split, Mapping[str, Measured]]:
    """Return a local split and its measured values, from its description."""
    check_regular(path)  # a device never ends
    registry = load(path)
    if list(registry.splits) != [name]:
        raise UnreadableFileError(
            "the folder is not named like its split: got "
            f"{', '.join(registry.splits) or 'none'}, expected one split, {name!r}; "
            "rename the folder back: the name is part of every hash",
            where=str(path),
        )
    split = registry.splits[name]
    # A dotted path would be imported: a description must not choose code to run.
    if split.generator != NO_GENERATOR:
        raise UnreadableFileError(
            f"a local split cannot name a generator: got {split.generator}, expected "
            f"{NO_GENERATOR}; an installed package adds splits that are simulated: "
            "see examples/",
            where=f"{path}, key splits.{name}.generator",
        )
    return split, registry.measured.get(name, {})


# --- what a user means ----------------------------------------------------------------


def locate_split(
    split: str | Path,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> SplitLocation:
    """Return the split that a user means by ``--split``.

    The option is a name, or the path of a local split's folder, or of the split.yaml
    in it. A text with a separator (``path/to/own``, ``./own``, ``own/``) is a path, and
    so is any ``Path``. A name of no split is a path where the current folder holds a
    local split of that name.

    Args:
        split: name or path.
        root: folder of all data sets; not needed with a path, whose parent it is.
        registry: the other splits; ours when None.

    Raises:
        UsageError: unknown split, an empty name, no local split at the path, or a path
            and another root.
        DataError: the folder of the local split may not be read.
        UnreadableFileError: the description of the local split is not right.
    """
    text = os.fspath(split)
    if not text.strip():
        # As a path it would mean the current folder.
        raise UsageError(
            f"the name of the split is empty: {text!a}; name one, as in --split "
            "cavity; --split . takes the current folder",
            where=SPLIT_NAMED,
        )
    path = Path(os.path.abspath(expand_path(text, "--split")))
    has_separator = "/" in text or os.sep in text or text in {".", "..", "~"}
    if path.name == DESCRIPTION and path.is_file():
        return _locate_folder(path.parent, root, registry)
    if has_separator or not isinstance(split, str):
        return _locate_folder(path, root, registry)
    folder = resolve_root(root)
    rooted_registry = load_rooted_registry(folder, registry)
    try:
        rooted_registry.split(text)
    except UsageError:
        if root is None and (path / DESCRIPTION).is_file():
            return _locate_folder(path, root, registry)
        raise
    return SplitLocation(text, folder, rooted_registry)


def _locate_folder(
    folder: Path, root: str | Path | None, registry: Registry | None
) -> SplitLocation:
    """Return the local split of a folder."""
    name = folder.name
    parent = folder.parent
    if root is not None and resolve_root(root).resolve() != parent.resolve():
        raise UsageError(
            f"a path and another root name the split: got {root}, expected the root "
            f"{parent}; give the path alone, or the root and the split's name",
            where="the split (SPLIT or --split) and --root",
        )
    if not (folder / DESCRIPTION).is_file() or not is_split_name(name):
        raise UsageError(
            f"no local split there: got {folder}, expected the name of a split, or a "
            f"folder that holds {DESCRIPTION}, named like its split; lagbench list "
            "names the splits; lagbench import makes local ones",
            where=SPLIT_NAMED,
        )
    rooted_registry = load_rooted_registry(parent, registry)
    if name not in rooted_registry.local_names():
        raise UsageError(
            f"the name {name!r} is taken by another split; import or adopt the data "
            "again under another name",
            where=str(folder),
        )
    rooted_registry.split(name)
    return SplitLocation(name, parent, rooted_registry)


def locate(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> SizeLocation:
    """Return one size of the split that a user means, and the place of its data.

    Args:
        split: name or path, see :func:`locate_split`.
        size: name of the size. When None it is the only one of the split, or the only
            one with data; where several have data it is mini.
        root: folder of all data sets.
        registry: the other splits; ours when None.

    Raises:
        UsageError: see :func:`locate_split`; the split has no such size, or none is
            named where several sizes have data, but not mini.
        DataError: no size is named, and none of several has data.
        UnreadableFileError: the description of the local split is not right.
    """
    location = locate_split(split, root=root, registry=registry)
    if size is None:
        size = _size_with_data(location)
    tier = location.registry.size(location.name, size)
    return SizeLocation(tier, location.root, location.registry)


def locate_new(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> SizeLocation:
    """Return a size whose data are yet to be made, and their place.

    Arguments and errors are those of :func:`locate`, but for a size that is None: it
    means mini, or the first size of a split without mini.
    """
    location = locate_split(split, root=root, registry=registry)
    if size is None:
        size = _size_to_make(location)
    tier = location.registry.size(location.name, size)
    return SizeLocation(tier, location.root, location.registry)


def _size_to_make(location: SplitLocation) -> str:
    """Return mini, or the first size of a split without mini."""
    sizes = location.registry.split(location.name).sizes
    if DEFAULT_NEW_SIZE in sizes:
        return DEFAULT_NEW_SIZE
    return next(iter(sizes))


def _size_with_data(location: SplitLocation) -> str:
    """Return the only size of a split, or the only one with data; of several mini."""
    split, root, registry = location
    sizes = []
    for name in registry.split(split).sizes:
        sizes.append(registry.size(split, name))
    sizes_with_data = []
    for size in sizes:
        folder = dataset_folder(root, split, size.name, size.major)
        if any(folder.glob("*/*.nc")):
            sizes_with_data.append(size)
    names = [size.name for size in sizes_with_data]
    if len(names) == 1:
        return names[0]
    if len(sizes) == 1:
        return sizes[0].name
    if DEFAULT_NEW_SIZE in names:
        return DEFAULT_NEW_SIZE
    all_names = ", ".join(size.name for size in sizes)
    if names:
        raise UsageError(
            f"several sizes are there: {', '.join(names)}; name one, as in --size "
            f"{names[0]}",
            where="--size",
        )
    size = registry.size(split, _size_to_make(location))
    hint = suggest_repair(size, root=root)
    if url_of(root) is not None:
        hint = f"name one: --size {DEFAULT_NEW_SIZE}"
    raise DataError(
        f"no size is named, and none of {all_names} is there; {hint}", where="--size"
    )


def suggest_repair(size: Size, *options: str, root: Path | None = None) -> str:
    """Return a hint on how to make a data set whole again.

    >>> from lagbench.data.registry import load
    >>> suggest_repair(load().size("cavity", "tiny"), "--subset test")
    'lagbench generate --split cavity --size tiny --subset test'
    """
    if not size.simulated:
        return "remove the folder and make the local split again: lagbench import"
    parts = [f"lagbench generate --split {size.split} --size {size.name}", *options]
    if root is not None:
        url = url_of(root) or ""
        if url.startswith(("http://", "https://")):
            advice = "tell whoever serves the address, or name another --root"
            return f"nothing can be written over HTTP: {advice}"
        parts.append(f"--root {quote_root(root)}")
    return " ".join(parts)


# --- contents of scenario files -------------------------------------------------------


def check_contents(size: Size, root: Path, scenarios: Iterable[int]) -> None:
    """Compare the content hash of scenarios with the recorded one.

    Values are hashed, unless this machine has hashed the same file before. The recorded
    hash is that of datasets.yaml, or of the manifest for a size that has none there. A
    scenario without any recorded hash is only read.

    Args:
        size: the data set.
        root: folder of all data sets.
        scenarios: ids of the scenarios.

    Raises:
        DataError: a scenario is missing, damaged or not the recorded one.
    """
    folder = size.folder(root)
    noted_hash = load_recorded_hashes(folder)
    manifest = None
    if not size.measured:
        manifest = read_or_empty(size, root)

    new_hashes: dict[Path, str] = {}
    for scenario in sorted(scenarios):
        path = size.path(root, scenario)
        subset = size.subset_of(scenario)
        repair = suggest_repair(size, f"--subset {subset}", root=root)
        verify = f"lagbench verify --split {size.split} --size {size.name}"
        hint = f"{repair}; {verify} --root {quote_root(root)} says what is wrong"
        try:
            hashes = noted_hash(path)
            if hashes is None:
                new_hashes[path] = check_scenario(path)
            content = hashes[0] if hashes else new_hashes[path]
        except OSError as error:
            raise DataError(
                f"cannot read a {subset} scenario: {error.strerror}; {hint}",
                where=str(path),
            ) from error
        except DataError as error:
            raise DataError(
                f"{error.text}; {hint}", where=error.where or str(path)
            ) from error
        # what is recorded: all of the hash, its first digits, or nothing
        expected = size.registered_hash(scenario)
        entry = manifest.entry(scenario) if manifest else None
        if entry is not None:
            expected = entry.content_sha256
        if not content.startswith(expected):
            raise DataError(
                f"a {subset} scenario has another content hash: got {content}, "
                f"expected {expected}; {hint}",
                where=str(path),
            )
    record_hashes(folder, new_hashes)
