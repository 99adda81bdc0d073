"""Where a split is described and where its data live: by its name, or by the path of
its folder.

The *root folder* holds all data sets; one in an object store is a working copy on this
machine.

A *local split* is a folder ``<root>/<name>/`` with its own description, ``split.yaml``
(laid out as datasets.yaml), and its data in the same places as those of any other
split. So ``--split path/to/own`` means the split ``own`` with the root folder
``path/to``; once the root is named (``--root path/to``), its name is enough. Files from
strangers carry names only: a path is understood where the user gives one, in
:func:`locate` and :func:`home`, and nowhere else.

What makes a data set whole again, in words for the user.
"""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from lagbench.atomic import write_atomically
from lagbench.errors import UnreadableFileError, UsageError, check_regular, nearest

from .layout import (
    CACHE_VARIABLE,
    MARK,
    as_url,
    dataset_folder,
    expanded,
    place_of,
    spelled,
    url_of,
)
from .registry import NO_GENERATOR, Measured, Registry, Size, Split, load

ROOT_VARIABLE = "LAGBENCH_ROOT"
"""Environment variable that names the root folder."""

_ROOT = f"--root or {ROOT_VARIABLE}"

_NO_REST = re.compile(r"[a-z][a-z0-9+.-]+:/*")

DESCRIPTION = "split.yaml"
"""Name of the file that describes a local split; it stands in the split's folder."""

_NAME = re.compile(r"[a-z][a-z0-9_-]{0,63}")


def resolve_root(root: str | Path | None = None) -> Path:
    """Return the folder that holds all data sets.

    Args:
        root: what the user gave; else ``LAGBENCH_ROOT``; else the platform's user data
            folder. A URL (``s3://bucket/prefix``) stands for its working copy, see
            :mod:`.layout`.

    Raises:
        UsageError: no file system can have a folder of that name.
        WorkFailedError: the working copy of a URL cannot be made.
    """
    given = _given(root)
    if given is None:
        import platformdirs

        return platformdirs.user_data_path("lagbench", appauthor=False)
    if (url := as_url(given)) is not None:
        copy = place_of(url)
        if url_of(copy) != url:
            text = json.dumps({"url": url}, indent=1) + "\n"
            write_atomically(copy / MARK, text.encode(), option=CACHE_VARIABLE)
        return copy
    folder = expanded(given, _ROOT)
    try:
        folder.lstat()
    except (OSError, ValueError) as error:
        too_long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
        if too_long or isinstance(error, ValueError):
            raise UsageError(
                "no folder can have that name",
                where=_ROOT,
                expected="a path",
                got=f"{str(folder)[:60]!a}..., {len(str(folder))} characters",
            ) from error
    return folder


def root_url(root: str | Path | None) -> str | None:
    """Return the URL that the root of :func:`resolve_root` is; None for a folder. No
    copy is made.
    """
    given = _given(root)
    if given is None:
        return None
    return as_url(given)


def _given(root: str | Path | None) -> str | Path | None:
    """Return the root that is given; refuse one that names nothing."""
    given = os.environ.get(ROOT_VARIABLE) or None if root is None else root
    if given is not None and (not str(given).strip() or _NO_REST.fullmatch(str(given))):
        raise UsageError(
            "that names no root",
            where=_ROOT,
            expected="a folder, or s3://bucket/prefix",
            got=ascii(str(given)),
        )
    return given


class Home(NamedTuple):
    """A split by name, the root folder of its data, and the registry that describes
    it.
    """

    name: str
    root: Path
    registry: Registry


class Located(NamedTuple):
    """One size of a split, the root folder of its data, and the registry that describes
    it.
    """

    size: Size
    root: Path
    registry: Registry


class RootedRegistry(Registry):
    """A registry that also knows the local splits of one root folder.

    A local split never replaces one of the same name, and its description is read when
    it is first asked for.
    """

    def __init__(self, base: Registry, root: Path) -> None:
        super().__init__(base.splits, base.measured, base.files)
        self.base = base
        self.root = root

    def split(self, name: str) -> Split:
        """Return a split by name."""
        if name not in self.splits and name in self.local_names():
            self._add(name)
        if name not in self.splits:
            known = (*self.splits, *self.local_names())
            raise UsageError(
                f"no split {name!r}", where="--split", fix=nearest(name, known)
            )
        return self.splits[name]

    def local_names(self) -> tuple[str, ...]:
        """Return the names of the root's local splits, sorted; those that others have
        left out.
        """
        try:
            found = [path.parent.name for path in self.root.glob(f"*/{DESCRIPTION}")]
        except OSError:
            return ()
        return tuple(
            sorted(
                name for name in found if is_name(name) and name not in self.base.splits
            )
        )

    def _add(self, name: str) -> None:
        path = self.root / name / DESCRIPTION
        split, measured = _described(path, name)
        self.splits[name] = split
        self.files[name] = path
        self.measured = {**self.measured, name: measured}


def is_name(text: str) -> bool:
    """Tell whether a text can name a split: a path cannot.

    >>> is_name("dam-break"), is_name("../dam-break")
    (True, False)
    """
    return _NAME.fullmatch(text) is not None


def rooted(root: Path, registry: Registry | None = None) -> RootedRegistry:
    """Return a registry that also knows the local splits of a root folder, by name.

    Args:
        root: folder of all data sets.
        registry: the other splits; ours when None.
    """
    base = registry or load()
    return RootedRegistry(base.base if isinstance(base, RootedRegistry) else base, root)


def home(
    split: str | Path,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Home:
    """Return what a user means by ``--split``: a name, or the path of a local split's
    folder.

    What has a separator (``path/to/own``, ``./own``, ``own/``) is a path; so is a name
    that no split has while the current folder holds a local split of that name, and any
    ``Path``.

    Args:
        split: name or path.
        root: folder of all data sets; not needed with a path, whose parent it is.
        registry: the other splits; ours when None.

    Raises:
        UsageError: unknown split, no local split at the path, or a path and another
            root.
        UnreadableFileError: the description of the local split is not right.
    """
    named = isinstance(split, str)
    split = os.fspath(split)
    path = Path(os.path.abspath(expanded(split, "--split")))
    if not named or "/" in split or os.sep in split or split in {".", "..", "~"}:
        return _at(path, root, registry)
    folder = resolve_root(root)
    known = rooted(folder, registry)
    try:
        known.split(split)
    except UsageError:
        if root is None and (path / DESCRIPTION).is_file():
            return _at(path, root, registry)
        raise
    return Home(split, folder, known)


def locate(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Located:
    """Return one size of the split that a user means, and where its data live; see
    :func:`home`.

    Args:
        split: name or path.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets.
        registry: the other splits; ours when None.

    Raises:
        UsageError: see :func:`home`; the split has no such size, or of several or no
            sizes that are there none is named.
        UnreadableFileError: the description of the local split is not right.
    """
    name, folder, known = home(split, root=root, registry=registry)
    return Located(
        known.size(name, size or _only_size(name, folder, known)), folder, known
    )


SIZE_TO_MAKE = "mini"
"""The size that is generated or downloaded where none is named: minutes and some
hundred MB.
"""


def locate_new(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Located:
    """Return what :func:`locate` does for what is yet to be made: mini, or the only
    size, when None.
    """
    name, folder, known = home(split, root=root, registry=registry)
    sizes = known.split(name).sizes
    if SIZE_TO_MAKE in sizes:
        default = SIZE_TO_MAKE
    else:
        default = next(iter(sizes))
    return Located(known.size(name, size or default), folder, known)


def _only_size(split: str, root: Path, known: Registry) -> str:
    """Return the size that a split has, or of which there are data."""
    sizes = [known.size(split, name) for name in known.split(split).sizes]
    here = [
        s
        for s in sizes
        if any(dataset_folder(root, split, s.name, s.major).glob("*/*.nc"))
    ]
    found = here or (sizes if len(sizes) == 1 else [])
    if len(found) == 1:
        return found[0].name
    names = ", ".join(size.name for size in here) or f"no data of {split}"
    if here:
        option = f"--size {here[0].name}"
    else:
        option = remedy(sizes[-1], root=root)
    if here:
        wrong = "several sizes are there: name one"
    else:
        wrong = "no size is named, and none is there"
    if (
        url_of(root) is not None and not here
    ):  # the store may hold it: only what was fetched is known
        wrong = "no size is named, and none was fetched from the store"
        option = "name it with --size"
    raise UsageError(
        wrong,
        where="--size",
        expected=", ".join(size.name for size in sizes),
        got=f"{names} in {url_of(root) or root}",
        fix=option,
    )


def _at(folder: Path, root: str | Path | None, registry: Registry | None) -> Home:
    """Return the local split of a folder."""
    name = folder.name
    parent = folder.parent
    if root is not None and resolve_root(root).resolve() != parent.resolve():
        raise UsageError(
            "a path and another root name the split",
            where="--split and --root",
            expected=f"the root {parent}",
            got=root,
            fix="give the path alone, or the root and the split's name",
        )
    if not (folder / DESCRIPTION).is_file() or not is_name(name):
        raise UsageError(
            "no local split there",
            where="--split",
            expected=f"the name of a split, or a folder that holds {DESCRIPTION}, "
            f"named like its split",
            got=folder,
            fix="lagbench list names the splits; lagbench import and lagbench adopt "
            "make local ones",
        )
    known = rooted(parent, registry)
    if name not in known.local_names():
        raise UsageError(
            f"the name {name!r} is taken by another split",
            where=str(folder),
            fix="import or adopt the data again under another name",
        )
    known.split(name)
    return Home(name, parent, known)


def _described(path: Path, name: str) -> tuple[Split, Mapping[str, Measured]]:
    """Return what a local split's description says of it."""
    check_regular(path)  # a device never ends
    file = load(path)
    if list(file.splits) != [name]:
        raise UnreadableFileError(
            "the folder is not named like its split",
            where=str(path),
            expected=f"one split, {name!r}",
            got=", ".join(file.splits) or "none",
            fix="rename the folder back: the name is part of every hash",
        )
    split = file.splits[name]
    # A dotted path would be imported: a description must not choose code to run.
    if split.generator != NO_GENERATOR:
        raise UnreadableFileError(
            "a local split cannot name a generator",
            where=f"{path}, key splits.{name}.generator",
            expected=NO_GENERATOR,
            got=split.generator,
            fix="an installed package adds splits that are simulated: see examples/",
        )
    return split, file.measured.get(name, {})


def remedy(size: Size, *options: str, root: Path | None = None) -> str:
    """Return what makes a data set whole again.

    >>> from lagbench.data.registry import load
    >>> remedy(load().size("cavity", "tiny"), "--subset test")
    'lagbench generate --split cavity --size tiny --subset test'
    """
    if size.simulated:
        if root is not None and (url_of(root) or "").startswith(
            ("http://", "https://")
        ):
            return "nothing can be written over HTTP: tell whoever serves the address, or name another --root"
        if root is None:
            place = []
        else:
            place = [f"--root {spelled(root)}"]
        return " ".join(
            (
                f"lagbench generate --split {size.split} --size {size.name}",
                *options,
                *place,
            )
        )
    return "remove the folder and make the local split again: lagbench adopt, or lagbench import"
