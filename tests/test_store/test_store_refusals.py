"""What S3 refuses is said in words, to those who write and to those who read; nothing
is left half done.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from command_line import CliRunner
from conftest import SIZE, SPLIT
from object_stores import CREDENTIALS, files, machine

import lagbench
from lagbench.cli.program import app
from lagbench.data.layout import CACHE_VARIABLE
from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError
from lagbench.exchange import download
from lagbench.make.generate import generate
from lagbench.make.verify import verify
from lagbench.store import copy, objects

Use = Callable[[str], object]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Be a machine of its own, on which nothing arrives."""
    monkeypatch.setattr(copy, "FRESH_SECONDS", 0.0)
    folder = machine(monkeypatch, tmp_path / "cache")
    yield folder
    assert files(folder) == {}


@pytest.fixture(params=["generate", "open_split", "verify", "download"])
def use(request: pytest.FixtureRequest) -> Use:
    """Something that is done with a root."""
    if request.param == "open_split":
        return lambda url: lagbench.open_split(SPLIT, size=SIZE, root=url)
    if request.param == "download":
        return lambda url: download(SPLIT, SIZE, root=url, or_generate=False)
    action = {"generate": generate, "verify": verify}[request.param]
    return lambda url: action(SPLIT, SIZE, root=url)


def lacking_credentials(patch: pytest.MonkeyPatch) -> None:
    """Have none, neither in variables nor in files."""
    for name in ("AWS_SHARED_CREDENTIALS_FILE", "AWS_CONFIG_FILE"):
        patch.setenv(name, "/nowhere/none")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        patch.delenv(name)


def wrong_credentials(patch: pytest.MonkeyPatch) -> None:
    """Have a key that the server does not know."""
    patch.setattr("moto.core.responses.settings.INITIAL_NO_AUTH_ACTION_COUNT", 0)
    patch.setenv("AWS_ACCESS_KEY_ID", "wrong")


REFUSALS: dict[
    str, tuple[Callable[[pytest.MonkeyPatch], None], type[LagbenchError], str]
] = {
    "none": (
        lacking_credentials,
        WorkFailedError,
        r"NoCredentials(.*\n)*.*AWS_ACCESS_KEY_ID",
    ),
    "wrong": (wrong_credentials, WorkFailedError, r"refuses\n(.*\n)*.*PermissionError"),
    "no answer": (
        lambda patch: patch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9"),
        WorkFailedError,
        r"does not answer(.*\n)*.*127\.0\.0\.1:9",
    ),
    "no s3fs": (
        lambda patch: patch.setitem(sys.modules, "s3fs", None),
        UsageError,
        r"s3fs is not installed(.*\n)*.*lagbench\[s3\]",
    ),
}


@pytest.mark.parametrize("why", REFUSALS)
def test_every_refusal_of_a_store_has_its_error(
    s3: str, use: Use, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    """No or wrong credentials, no answer, no library: the error says what is missing,
    and where to put it.
    """
    harm, error, words = REFUSALS[why]
    harm(monkeypatch)
    with pytest.raises(error, match=words):
        use(s3)


def test_no_bucket_and_no_such_kind(s3: str, use: Use) -> None:
    """The bucket is named; a scheme that fsspec does not know is a usage error."""
    with pytest.raises(DataError) as caught:
        use("s3://elsewhere/data")
    assert caught.value.where == "s3://elsewhere/data"
    with pytest.raises(UsageError):
        use("nonsense://data/x")


class _NameNode(BaseHTTPRequestHandler):
    """A host of WebHDFS that has every file, in one length, and stores none."""

    length = 0
    refusal: tuple[int, str] = (404, "FileNotFoundException")

    def do_GET(self) -> None:
        status = {"type": "FILE", "length": self.length, "pathSuffix": ""}
        self._send(200, {"FileStatus": status})

    def do_PUT(self) -> None:
        code, name = self.refusal
        self._send(code, {"RemoteException": {"exception": name, "message": name}})

    def _send(self, code: int, content: object) -> None:
        body = json.dumps(content).encode()
        self.send_response(code)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextmanager
def name_node(**answers: Any) -> Iterator[str]:
    """Yield the address of a host of WebHDFS that answers so."""
    handler = type("NameNode", (_NameNode,), answers)
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"webhdfs://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_each_host_answers_for_itself() -> None:
    """Stores of one kind on two hosts are two stores, also with equal paths."""
    with name_node(length=3) as first, name_node(length=5) as second:
        lengths = []
        for url in (first, second, first):
            answer = objects.open_object(f"{url}/data/manifest.json", 0, hint="none")
            lengths.append(answer.total)
            answer.close()
    assert lengths == [3, 5, 3]


@pytest.mark.parametrize(
    ("refusal", "error"),
    [
        ((404, "FileNotFoundException"), DataError),
        ((403, "AccessControlException"), WorkFailedError),
    ],
)
def test_a_store_other_than_s3_has_no_buckets_and_no_keys(
    refusal: tuple[int, str], error: type[LagbenchError]
) -> None:
    with name_node(refusal=refusal) as url, pytest.raises(error) as caught:
        objects.Objects(url, "data").write("manifest.json", b"{}")
    assert caught.value.where == f"{url}/data"
    assert caught.value.fix
    for word in ("bucket", "AWS"):
        assert word not in str(caught.value)


@pytest.mark.parametrize("root", ["http://host/data", "nonsense://data/x"])
def test_a_store_that_cannot_be_written_gets_no_working_copy(
    root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The address is judged before its working copy is made."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    for dry_run in (True, False):
        with pytest.raises(UsageError):
            generate(SPLIT, SIZE, root=root, dry_run=dry_run)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def silent_store(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A store that accepts connections and never answers, waited for briefly."""
    pytest.importorskip("s3fs")
    monkeypatch.setattr(objects, "S3_TIMEOUT", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        environment = {**CREDENTIALS, "AWS_ENDPOINT_URL": address}
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield "s3://bucket/data"


@pytest.mark.slow
def test_a_silent_store_is_given_up(
    silent_store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time is the product of timeout, attempts and rounds, and pauses."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    start = time.monotonic()
    words = ["verify", SPLIT, "--size", SIZE, "--root", silent_store]
    result = CliRunner().invoke(app, words)
    waited = time.monotonic() - start
    limit = objects.S3_TIMEOUT * objects.S3_ATTEMPTS * objects.S3_ROUNDS
    assert waited < 2 * limit + 5.0
    assert result.exit_code == 5
    assert "s3://bucket/data" in result.stderr


def test_the_command_line_says_it_too(s3: str) -> None:
    """A message and the exit code of its kind, no traceback."""
    for name, code in (("s3://elsewhere/data", 4), ("nonsense://data/x", 2)):
        done = CliRunner().invoke(
            app, ["generate", SPLIT, "--size", SIZE, "--root", name]
        )
        assert done.exit_code == code
        assert "Traceback" not in done.stderr
