"""What S3 refuses is said in words, to those who write and to those who read; nothing is left half done."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT
from object_stores import files, machine, s3_server
from typer.testing import CliRunner

import lagbench
from lagbench.cli.app import app
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.make.generate import generate
from lagbench.make.verify import verify
from lagbench.store import copy

Use = Callable[[str], object]


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """An S3 server."""
    with s3_server() as url:
        yield url


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Be a machine of its own, on which nothing arrives."""
    monkeypatch.setattr(copy, "FRESH", 0.0)
    folder = machine(monkeypatch, tmp_path / "cache")
    yield folder
    assert files(folder) == {}


@pytest.fixture(params=["generate", "open_split", "verify"])
def use(request: pytest.FixtureRequest) -> Use:
    """Something that is done with a root."""
    if request.param == "open_split":
        return lambda url: lagbench.open_split(SPLIT, size=SIZE, root=url)
    action = {"generate": generate, "verify": verify}[request.param]
    return lambda url: action(SPLIT, SIZE, root=url)


def test_no_bucket(s3: str, use: Use) -> None:
    """The bucket is named."""
    with pytest.raises(DataError, match=r"no such bucket(.*\n)*.*got: elsewhere\n  fix: create"):
        use("s3://elsewhere/data")


def test_no_credentials(s3: str, use: Use, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The variables that name them are said."""
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    with pytest.raises(WorkFailedError, match=r"NoCredentials(.*\n)*.*AWS_ACCESS_KEY_ID"):
        use(s3)


def test_wrong_credentials(s3: str, use: Use, monkeypatch: pytest.MonkeyPatch) -> None:
    """A refusal is one, and not tried again."""
    monkeypatch.setattr("moto.core.responses.settings.INITIAL_NO_AUTH_ACTION_COUNT", 0)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "wrong")
    with pytest.raises(WorkFailedError, match=r"refuses\n(.*\n)*.*PermissionError"):
        use(s3)


def test_no_answer(s3: str, use: Use, monkeypatch: pytest.MonkeyPatch) -> None:
    """The address is named."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(WorkFailedError, match=r"does not answer(.*\n)*.*127\.0\.0\.1:9"):
        use(s3)


def test_no_s3fs(s3: str, use: Use, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command that installs it is said."""
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(UsageError, match=r"s3fs is not installed(.*\n)*.*lagbench\[s3\]"):
        use(s3)


def test_no_such_kind(use: Use) -> None:
    """A scheme that fsspec does not know is a usage error."""
    with pytest.raises(UsageError, match="no such kind of address"):
        use("nonsense://data/x")


def test_the_command_line_says_it_too(s3: str) -> None:
    """A message and the exit code of its kind, no traceback."""
    for name, code in (("s3://elsewhere/data", 4), ("nonsense://data/x", 2)):
        done = CliRunner().invoke(app, ["generate", SPLIT, "--size", SIZE, "--root", name])
        assert (done.exit_code, type(done.exception)) == (code, SystemExit)
        assert "fix: " in done.stderr or "expected: " in done.stderr
