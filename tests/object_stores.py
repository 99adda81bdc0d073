"""Object stores for tests: an S3 server in this process, stores in memory, machines of their own."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import fsspec
import pytest
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
    bucket = f"data-{uuid.uuid4().hex[:8]}"  # all servers of a process share what they hold
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**CREDENTIALS, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
            patch.setenv(name, value)
        fsspec.filesystem("s3", skip_instance_cache=True).mkdir(bucket)
        try:
            yield f"s3://{bucket}/data"
        finally:
            server.stop()


def machine(patch: pytest.MonkeyPatch, folder: Path) -> Path:
    """Work as another machine: with a cache of its own; return it."""
    patch.setenv("LAGBENCH_CACHE", str(folder))
    return folder


def objects(url: str) -> dict[str, bytes]:
    """Return name and content of all objects below a URL but locks."""
    system, path = fsspec.core.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
    prefix = path.rstrip("/") + "/"
    found = {name.removeprefix(prefix): system.cat_file(name) for name in system.find(path)}
    return {name: data for name, data in found.items() if ".lock" not in name}


def files(root: Path) -> dict[str, bytes]:
    """Return name and content of all files below a folder but locks, notes and the mark."""
    found = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    return {
        name: path.read_bytes()
        for name, path in found.items()
        if ".lock" not in name and path.name not in ("store.json", NOTES_NAME)
    }


def put(url: str, name: str, data: bytes) -> None:
    """Put one object."""
    system, path = fsspec.core.url_to_fs(url, skip_instance_cache=True)
    system.pipe_file(f"{path}/{name}", data)


def remove(url: str, name: str) -> None:
    """Remove one object."""
    system, path = fsspec.core.url_to_fs(url, skip_instance_cache=True)
    system.rm_file(f"{path}/{name}")


def stored(root: Path) -> str:
    """Put a root folder's files into a store of its own in memory; return its URL."""
    url = f"memory://{uuid.uuid4().hex}/data"
    for name, data in files(root).items():
        put(url, name, data)
    return url
