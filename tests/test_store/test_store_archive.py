"""Archives of data sets: the same bytes each time, read from a store, and nothing in
them is trusted.
"""

from __future__ import annotations

import io
import os
import shutil
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT
from faulty_server import Mirror, serving

import lagbench
from lagbench.data.manifest import Manifest
from lagbench.errors import DataError, LagbenchError, UsageError
from lagbench.exchange import download
from lagbench.exchange.downloading import DownloadResult
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.store import archive, fetch, objects

DATA = f"{SPLIT}/{SIZE}/v2"

Members = list[tuple[tarfile.TarInfo, bytes]]


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not pause between attempts, and pass over members by range however short."""
    monkeypatch.setattr(fetch, "PAUSE", 0.0)
    monkeypatch.setattr(archive, "BLOCK", 512)


@pytest.fixture(scope="module")
def packed(original: LocalSplit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of a data set."""
    return archive.write_archive(
        str(original.folder), output=tmp_path_factory.mktemp("packed")
    )


@pytest.fixture
def server(packed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mirror]:
    """An HTTP server that has the archive alone, and can be told to lie."""
    folder = tmp_path_factory.mktemp("releases")
    shutil.copy(packed, folder)
    with serving(folder) as running:
        yield running


def fetched(url: str, root: Path, subset: str | None = None) -> DownloadResult:
    """Download and simulate nothing."""
    return download("own", mirror=url, root=root, subset=subset, or_generate=False)


def is_right(root: Path) -> bool:
    """Return whether the data set is complete, and has the recorded hash."""
    return lagbench.verify("own", root=root, complete=True).warnings == ()


def left(root: Path) -> set[str]:
    """Return the paths of all scenario files and temporary files below a folder."""
    files = (
        path for path in root.rglob("*") if path.name.endswith((".nc", ".partial"))
    )
    return {path.relative_to(root).as_posix() for path in files}


def rewritten(path: Path, change: Callable[[Members], Members]) -> None:
    """Write an archive anew with other members."""
    with tarfile.open(path) as tar:
        members: Members = []
        for member in tar:
            stream = tar.extractfile(member)
            assert stream is not None
            members.append((member, stream.read()))
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for member, data in change(members):
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))


def test_the_same_files_give_the_same_bytes(
    generated: GenerationResult, copied: Callable[[], Path], tmp_path: Path
) -> None:
    """Times and modes of files do not matter; the name is that of the content, members
    are sorted.
    """
    root = copied()
    for path in (root / DATA).rglob("*.nc"):
        path.chmod(0o600)
        os.utime(path, (1, 1))
    first = archive.write_archive(SPLIT, SIZE, root=generated.root, output=tmp_path)
    again = archive.write_archive(SPLIT, SIZE, root=root, output=tmp_path / "new")
    assert again.read_bytes() == first.read_bytes()
    assert generated.dataset_sha256 is not None
    assert (
        again.name
        == first.name
        == f"{SPLIT}-{SIZE}-{generated.dataset_sha256[:16]}.tar"
    )
    with tarfile.open(first) as tar:
        names = tar.getnames()
        assert names == ["manifest.json", *sorted(names[1:])]
        assert {(m.uid, m.gid, m.uname, m.mtime, m.mode) for m in tar} == {
            (0, 0, "", 0, 0o644)
        }
        tar.extractall(tmp_path / "out", filter="data")
    out = tmp_path / "out"
    there = generated.root / DATA
    assert all(
        (out / name).read_bytes() == (there / name).read_bytes() for name in names
    )


@pytest.mark.parametrize("harm", ["missing", "flipped"])
def test_only_right_data_are_packed(
    copied: Callable[[], Path], tmp_path: Path, harm: str
) -> None:
    """What is missing or damaged is said; there is no archive."""
    root = copied()
    victim = root / DATA / "train/0001.nc"
    data = victim.read_bytes()
    victim.unlink()
    if harm == "flipped":
        victim.write_bytes(data[:-500] + bytes([data[-500] ^ 1]) + data[-499:])
    with pytest.raises(LagbenchError) as caught:
        archive.write_archive(SPLIT, SIZE, root=root, output=tmp_path / "new")
    assert caught.value.exit_code in (3, 4)
    assert not list(tmp_path.glob("new/*"))


def test_releases_have_one_address(
    generated: GenerationResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command's archive there comes without ``--from``; the data set is that of
    datasets.yaml.
    """
    arguments = [
        "--root",
        str(generated.root),
        "--output",
        str(tmp_path / "out"),
        "--size",
        SIZE,
        "--split",
    ]
    assert archive.main([*arguments, SPLIT]) == 0
    assert archive.main([*arguments, "nowhere"]) == 2
    with serving(tmp_path / "out") as running:
        monkeypatch.setenv(archive.RELEASES_VARIABLE, running.url)
        result = download(SPLIT, SIZE, root=tmp_path / "here", or_generate=False)
    assert result.downloaded == (0, 1, 2, 3, 4)
    assert result.mirror == running.url
    assert result.verdict == "equal to datasets.yaml"
    assert result.complete
    assert running.count(".nc") == 0
    here, there = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*.nc")}
        for root in (tmp_path / "here", generated.root)
    )
    assert here == there


def test_nobody_is_asked(
    server: Mirror, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Local splits are nobody's business; a placeholder is no address, and the error
    says what is missing.
    """
    with monkeypatch.context() as patch:
        patch.setattr(archive, "open_object", None)
        with pytest.raises(UsageError) as caught:
            download(SPLIT, SIZE, root=here, or_generate=False)
    assert caught.value.exit_code == 2
    assert caught.value.where == f"{SPLIT} {SIZE}"
    assert archive.RELEASES in str(caught.value.got)
    monkeypatch.setenv(archive.RELEASES_VARIABLE, server.url)
    with pytest.raises(UsageError):
        download("own", root=here)
    assert server.asked == []


def test_a_manifest_comes_before_an_archive(
    original: LocalSplit, server: Mirror, here: Path
) -> None:
    """A store that has files is not asked for an archive, which is read through fsspec
    as well.
    """
    assert fetched(server.folder.as_uri(), here).complete
    assert is_right(here)
    shutil.rmtree(here / "own/full/v1")
    with serving(original.folder.parent) as running:
        assert fetched(running.url, here).complete
        assert running.count(".tar") == 0


@pytest.mark.parametrize("fault", ["", "no ranges"])
def test_only_what_is_missing_is_asked_for(
    server: Mirror, here: Path, fault: str
) -> None:
    """Members that are here or not wanted are passed over; where there are no ranges,
    read and dropped.
    """
    first = fetched(server.url, here, subset="train")
    if fault:
        server.faults = {".tar": fault}
    last = fetched(server.url, here)
    assert {*first.downloaded, *last.downloaded} == {0, 1, 2, 3}
    assert last.kept == first.downloaded
    assert last.complete
    if not fault:
        assert any(wanted for path, wanted in server.asked if path.endswith(".tar"))


@pytest.mark.parametrize("fault", ["drops", "no ranges", "busy once", "wrong range"])
def test_a_bad_line_costs_time_only(server: Mirror, here: Path, fault: str) -> None:
    """Broken connections are taken up by range, or from the start where the server
    knows no ranges.
    """
    server.faults = {".tar": fault}
    assert fetched(server.url, here).complete
    ranges = [wanted for path, wanted in server.asked if path.endswith(".tar")]
    if fault == "drops":
        third = next(server.folder.glob("*.tar")).stat().st_size // 3
        assert ranges == [None, f"bytes={third}-", f"bytes={2 * third}-"]


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        *(
            (fault, objects.TruncatedError)
            for fault in ("chopped", "ends early", "announces more")
        ),
        ("drops always", LagbenchError),
        *(
            (fault, objects.NotDataError)
            for fault in ("page", "hidden page", "endless")
        ),
        ("busy", objects.StoreUnreachableError),
    ],
)
def test_a_lying_server(
    server: Mirror, here: Path, fault: str, error: type[LagbenchError]
) -> None:
    """The address is named; files that were right stay, and the next command completes
    them.
    """
    server.faults = {".tar": fault}
    with pytest.raises(error) as caught:
        fetched(server.url, here)
    assert (
        caught.value.where == f"{server.url}/{next(server.folder.glob('*.tar')).name}"
    )
    if issubclass(error, DataError):
        assert not [name for name in left(here) if "partial" in name]
    server.faults = {}
    assert fetched(server.url, here).complete
    assert is_right(here)


def foreign(name: str, kind: bytes = tarfile.REGTYPE) -> tuple[tarfile.TarInfo, bytes]:
    """Return a member that should not be there."""
    member = tarfile.TarInfo(name)
    member.type = kind
    member.linkname = "/etc/passwd" if kind == tarfile.SYMTYPE else ""
    return member, b"" if kind == tarfile.SYMTYPE else b"\x89HDF\r\n\x1a\n" * 100


def garbled(members: Members) -> Members:
    """Change a byte of the second scenario."""
    member, data = members[2]
    return [
        *members[:2],
        (member, data[:-500] + bytes([data[-500] ^ 1]) + data[-499:]),
        *members[3:],
    ]


def other(members: Members) -> Members:
    """Give all scenarios another content hash."""
    (head, text), *rest = members
    manifest = Manifest.model_validate_json(text)
    files = [
        entry.model_copy(update={"content_sha256": "0" * 64})
        for entry in manifest.files
    ]
    return [
        (
            head,
            manifest.model_copy(update={"files": tuple(files)})
            .model_dump_json()
            .encode(),
        ),
        *rest,
    ]


LIES: dict[str, tuple[Callable[[Members], Members], type[LagbenchError]]] = {
    "foreign first": (lambda m: [foreign("a.nc"), *m], objects.NotDataError),
    "foreign between": (
        lambda m: [*m[:2], foreign("../evil.nc"), *m[2:]],
        objects.WrongContentError,
    ),
    "foreign last": (
        lambda m: [*m, foreign("train/0099.nc")],
        objects.WrongContentError,
    ),
    "absolute": (
        lambda m: [*m[:2], foreign("/tmp/evil.nc"), *m[2:]],
        objects.WrongContentError,
    ),
    "link": (
        lambda m: [m[0], foreign(m[1][0].name, tarfile.SYMTYPE), *m[1:]],
        objects.WrongContentError,
    ),
    "another order": (lambda m: [m[0], *reversed(m[1:])], objects.WrongContentError),
    "one missing": (lambda m: m[:-1], objects.NotDataError),
    "wrong bytes": (garbled, objects.WrongContentError),
    "longer": (
        lambda m: [m[0], (m[1][0], m[1][1] + bytes(9)), *m[2:]],
        objects.WrongLengthError,
    ),
    "another data set": (other, objects.WrongContentError),
    "no manifest": (lambda m: [(m[0][0], b"{}"), *m[1:]], objects.NotDataError),
    "other hashes": (
        lambda m: [
            (m[0][0], m[0][1].replace(b'"content_sha256": "', b'"content_sha256": "0')),
            *m[1:],
        ],
        objects.NotDataError,
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_archives_that_lie(server: Mirror, packed: Path, here: Path, lie: str) -> None:
    """Each has its error; only right files of the data set are left, and none
    elsewhere.
    """
    change, error = LIES[lie]
    target = server.folder / packed.name
    rewritten(target, change)
    with pytest.raises(error) as caught:
        fetched(server.url, here)
    assert type(caught.value) is error
    assert caught.value.exit_code == 4
    assert str(caught.value.where).startswith(f"{server.url}/{packed.name}")
    with tarfile.open(packed) as tar:
        assert left(here) <= {f"own/full/v1/{name}" for name in tar.getnames()}
    assert not (
        left(here) and lie == "another data set"
    )  # it is refused before any file is taken
    assert not list(here.rglob("evil.nc"))
    shutil.copy(packed, target)
    fetched(server.url, here)
    assert is_right(here)
