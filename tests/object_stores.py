"""Stores for tests: S3 and HTTP servers in this process, folders by URL, machines of
their own.
"""

from __future__ import annotations

import logging
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fsspec
import pytest
from faulty_server import Mirror, serving
from moto.server import ThreadedMotoServer

from lagbench.data.layout import NOTES_NAME

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
    "AWS_MAX_ATTEMPTS": "1",
}


@contextmanager
def s3_server() -> Iterator[str]:
    """Serve S3 on a free port of this machine, with a bucket; yield a URL in it."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    # all servers of a process share what they hold
    bucket = f"data-{uuid.uuid4().hex[:8]}"
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            **CREDENTIALS,
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        }.items():
            patch.setenv(name, value)
        # instances remember the address of an earlier server
        fsspec.get_filesystem_class("s3").clear_instance_cache()
        fsspec.filesystem("s3").mkdir(bucket)
        try:
            yield f"s3://{bucket}/data"
        finally:
            server.stop()


def machine(patch: pytest.MonkeyPatch, folder: Path) -> Path:
    """Work as another machine: with a cache of its own; return it."""
    patch.setenv("LAGBENCH_CACHE", str(folder))
    return folder


def _opened(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, which remembers nothing of what it holds, and
    the path in it.
    """
    options = (
        {"endpoint_url": os.environ["AWS_ENDPOINT_URL"]} if url.startswith("s3") else {}
    )
    system, path = fsspec.core.url_to_fs(url, use_listings_cache=False, **options)
    return system, path


def objects(url: str) -> dict[str, bytes]:
    """Return name and content of all objects below a URL."""
    system, path = _opened(url)
    prefix = path.rstrip("/") + "/"
    return {
        name.removeprefix(prefix): system.cat_file(name) for name in system.find(path)
    }


def files(root: Path) -> dict[str, bytes]:
    """Return name and content of all files below a folder but locks, notes and the
    mark.
    """
    found = {
        path.relative_to(root).as_posix(): path
        for path in root.rglob("*")
        if path.is_file()
    }
    return {
        name: path.read_bytes()
        for name, path in found.items()
        if ".lock" not in name and path.name not in ("store.json", NOTES_NAME)
    }


@dataclass(frozen=True)
class Store:
    """A store that a test reads from, and changes behind the reader's back."""

    url: str
    door: str  # URL by which its objects are changed
    server: Mirror | None = None  # what serves it over HTTP

    def put(self, name: str, data: bytes) -> None:
        """Put one object."""
        put(self.door, name, data)

    def remove(self, name: str) -> None:
        """Remove one object."""
        remove(self.door, name)

    def read(self, name: str) -> bytes:
        """Return one object."""
        return objects(self.door)[name]


def put(url: str, name: str, data: bytes) -> None:
    """Put one object."""
    system, path = _opened(url)
    system.makedirs(f"{path}/{name}".rpartition("/")[0], exist_ok=True)
    system.pipe_file(f"{path}/{name}", data)


def remove(url: str, name: str) -> None:
    """Remove one object."""
    system, path = _opened(url)
    system.rm_file(f"{path}/{name}")


def fill(url: str, root: Path) -> None:
    """Put a root folder's files into a store."""
    for name, data in files(root).items():
        put(url, name, data)


@contextmanager
def holding(place: str, folder: Path, root: Path) -> Iterator[Store]:
    """Hold a root folder's files in a store: "http" or "file", below a new folder, or
    at a URL.
    """
    if "://" in place:
        url = f"{place}/{uuid.uuid4().hex}"
        fill(url, root)
        yield Store(url, url)
        return
    served = folder / "served"
    shutil.copytree(root, served)
    if place == "file":
        yield Store(served.as_uri(), served.as_uri())
        return
    with serving(served) as running:
        yield Store(running.url, served.as_uri(), running)
