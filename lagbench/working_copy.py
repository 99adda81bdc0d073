"""The local folder that stands for a root folder in an object store.

netCDF4 and HDF5 read and write files, so a root given as a URL (``s3://bucket/prefix``) becomes a
folder of the user's cache, named from the URL, that says in ``store.json`` what it is a copy of.
Everything works on that folder; ``lagbench.store`` brings objects there and puts them back.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

from .atomic import write_atomically

__all__ = ["CACHE_VARIABLE", "as_url", "open_copy", "url_of"]

CACHE_VARIABLE = "LAGBENCH_CACHE"
"""Environment variable that names the folder of working copies."""

MARK = "store.json"
"""Name of the file that says what a folder is a working copy of."""

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/(.*)", re.DOTALL)


def as_url(root: str | Path) -> str | None:
    """Return a root as a URL without a slash at its end; None where it is a path.

    A ``Path`` takes the second slash away; it is put back.

    >>> as_url("s3://bucket/data/"), as_url(Path("s3://bucket/data")), as_url("data/cavity")
    ('s3://bucket/data', 's3://bucket/data', None)
    """
    match = _URL.fullmatch(str(root))
    if match is None:
        return None
    scheme, rest = match.groups()
    # What a local file system names by URL is absolute.
    lead = "/" if scheme in {"file", "local"} else ""
    return f"{scheme}://{lead}{rest.strip('/')}"


def open_copy(url: str) -> Path:
    """Return the working copy of a root in a store; make and mark it where it is not there.

    Raises:
        WorkFailedError: the cache cannot be written; ``LAGBENCH_CACHE`` names another place.
    """
    folder = _place(url)
    if url_of(folder) != url:
        text = json.dumps({"url": url}, indent=1) + "\n"
        write_atomically(folder / MARK, text.encode(), option=CACHE_VARIABLE)
    return folder


def url_of(root: Path) -> str | None:
    """Return the URL that a root folder is the working copy of; None for any other folder.

    A mark in any other place than the cache means nothing: a stranger may have put it there.
    """
    try:
        url = json.loads((root / MARK).read_text(encoding="utf-8"))["url"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return url if isinstance(url, str) and as_url(url) == url and root == _place(url) else None


def _place(url: str) -> Path:
    return _cache() / _name(url)


def _name(url: str) -> str:
    """Return a file name that says the URL readably, and tells it from all others.

    >>> _name("s3://bucket/data")
    's3-bucket-data-397b84d8'
    """
    words = re.sub(r"[^A-Za-z0-9._]+", "-", url).strip("-.")[:60]
    return f"{words}-{hashlib.sha256(url.encode()).hexdigest()[:8]}"


def _cache() -> Path:
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given).expanduser().absolute()
    import platformdirs

    return platformdirs.user_cache_path("lagbench", appauthor=False) / "stores"
