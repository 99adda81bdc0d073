"""Archives of data sets: their bytes, reading from a store, archives that lie."""

from __future__ import annotations

import gzip
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
from lagbench import addresses
from lagbench.data.manifest import Manifest
from lagbench.errors import DataError, LagbenchError, UsageError
from lagbench.exchange import download
from lagbench.exchange.downloading import DownloadResult
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.store import archive, fetch, objects
from lagbench.work.run import Progress

DATA = f"{SPLIT}/{SIZE}/v2"

Member = tuple[tarfile.TarInfo, bytes]
Members = list[Member]


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not pause between attempts, and pass over members by range however short."""
    monkeypatch.setattr(fetch, "PAUSE", 0.0)
    monkeypatch.setattr(archive, "BLOCK", 512)


@pytest.fixture(scope="module")
def packed(original: LocalSplit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of a data set."""
    folder = tmp_path_factory.mktemp("packed")
    return archive.write_archive(str(original.folder), output=folder)


@pytest.fixture
def server(packed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mirror]:
    """An HTTP server that has the archive alone, and can be told to lie."""
    folder = tmp_path_factory.mktemp("releases")
    shutil.copy(packed, folder)
    with serving(folder) as running:
        yield running


def fetch_own(url: str, root: Path, subset: str | None = None) -> DownloadResult:
    """Download and simulate nothing."""
    return download(
        "own",
        mirror=url,
        root=root,
        subset=subset,
        or_generate=False,
    )


def is_right(root: Path) -> bool:
    """Return whether the data set is complete, and has the recorded hash."""
    result = lagbench.verify("own", root=root, complete=True)
    return result.warnings == ()


def list_data_files(root: Path) -> set[str]:
    """Return the paths of all scenario files and temporary files below a folder."""
    names = set()
    for path in root.rglob("*"):
        if path.name.endswith((".nc", ".partial")):
            relative = path.relative_to(root)
            names.add(relative.as_posix())
    return names


def read_scenarios(root: Path) -> dict[Path, bytes]:
    """Return the content of all scenario files below a folder."""
    content = {}
    for path in root.rglob("*.nc"):
        relative = path.relative_to(root)
        content[relative] = path.read_bytes()
    return content


def flip_bit(data: bytes) -> bytes:
    """Change a bit near the end."""
    changed = bytearray(data)
    changed[-500] ^= 1
    return bytes(changed)


Change = Callable[[Members], Members]


def rewrite_archive(path: Path, change: Change) -> None:
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
    generated: GenerationResult,
    copied: Callable[[], Path],
    tmp_path: Path,
) -> None:
    """Times and modes of files do not matter; the name is that of the content."""
    root = copied()
    for path in (root / DATA).rglob("*.nc"):
        path.chmod(0o600)
        os.utime(path, (1, 1))
    output = tmp_path / "new"
    first = archive.write_archive(SPLIT, SIZE, root=generated.root, output=tmp_path)
    second = archive.write_archive(SPLIT, SIZE, root=root, output=output)
    assert second.read_bytes() == first.read_bytes()
    assert generated.dataset_sha256 is not None
    name = f"{SPLIT}-{SIZE}-{generated.dataset_sha256[:16]}.tar"
    assert first.name == name
    assert second.name == name


def test_an_archive_has_the_files_in_order(
    generated: GenerationResult, tmp_path: Path
) -> None:
    """The manifest comes first; owner, time and mode are those of nobody."""
    path = archive.write_archive(SPLIT, SIZE, root=generated.root, output=tmp_path)
    unpacked = tmp_path / "unpacked"
    with tarfile.open(path) as tar:
        names = tar.getnames()
        for member in tar:
            assert member.uid == 0
            assert member.gid == 0
            assert member.uname == ""
            assert member.mtime == 0
            assert member.mode == 0o644
        tar.extractall(unpacked, filter="data")
    manifest, *scenarios = names
    assert manifest == "manifest.json"
    assert scenarios == sorted(scenarios)
    folder = generated.root / DATA
    for name in names:
        expected = (folder / name).read_bytes()
        assert (unpacked / name).read_bytes() == expected


@pytest.mark.parametrize("damage", ["missing", "flipped"])
def test_only_right_data_are_packed(
    copied: Callable[[], Path], tmp_path: Path, damage: str
) -> None:
    """Otherwise there is an error and no archive."""
    root = copied()
    path = root / DATA / "train/0001.nc"
    data = path.read_bytes()
    path.unlink()
    if damage == "flipped":
        path.write_bytes(flip_bit(data))
    output = tmp_path / "new"
    with pytest.raises(LagbenchError) as caught:
        archive.write_archive(SPLIT, SIZE, root=root, output=output)
    assert caught.value.exit_code in (3, 4)
    assert not list(output.glob("*"))


def without_last(manifest: Manifest) -> Manifest:
    """Return a manifest that lacks the last file."""
    return manifest.model_copy(update={"files": manifest.files[:-1]})


def with_first_twice(manifest: Manifest) -> Manifest:
    """Return a manifest that names the first file twice."""
    files = (manifest.files[0], *manifest.files)
    return manifest.model_copy(update={"files": files})


def with_other_hash(manifest: Manifest) -> Manifest:
    """Return a manifest of a data set with another hash."""
    return manifest.model_copy(update={"dataset_sha256": "0" * 64})


@pytest.mark.parametrize(
    ("change", "got"),
    [
        (without_last, "missing: 4"),
        (with_first_twice, "6 scenarios"),
        (with_other_hash, "0000"),
    ],
)
def test_a_manifest_of_other_files_is_not_packed(
    copied: Callable[[], Path],
    tmp_path: Path,
    change: Callable[[Manifest], Manifest],
    got: str,
) -> None:
    """Scenarios that are missing or named twice, and another hash of the data set."""
    root = copied()
    path = root / DATA / "manifest.json"
    manifest = Manifest.model_validate_json(path.read_bytes())
    path.write_text(change(manifest).model_dump_json())
    with pytest.raises(DataError) as caught:
        archive.write_archive(SPLIT, SIZE, root=root, output=tmp_path / "new")
    assert got in str(caught.value.got)


def test_an_incomplete_data_set_is_made_whole_in_its_own_root(tmp_path: Path) -> None:
    with pytest.raises(LagbenchError) as caught:
        archive.write_archive(SPLIT, SIZE, root=tmp_path, output=tmp_path / "new")
    assert str(tmp_path) in str(caught.value.fix)


def test_releases_have_one_address(
    generated: GenerationResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An archive there comes without ``--from``."""
    releases = tmp_path / "releases"
    root = tmp_path / "root"
    arguments = [
        *("--root", str(generated.root)),
        *("--output", str(releases)),
        *("--size", SIZE),
        "--split",
    ]
    assert archive.main([*arguments, SPLIT]) == 0
    assert archive.main([*arguments, "nowhere"]) == 2
    with serving(releases) as running:
        monkeypatch.setenv(archive.RELEASES_VARIABLE, running.url)
        result = download(SPLIT, SIZE, root=root, or_generate=False)
    assert result.downloaded == (0, 1, 2, 3, 4)
    assert result.mirror == running.url
    assert result.verdict == "equal to datasets.yaml"
    assert result.complete
    assert running.count(".nc") == 0
    assert read_scenarios(root) == read_scenarios(generated.root)


def test_without_a_release_no_server_is_asked(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No address is set, and the error says so."""
    monkeypatch.setattr(archive, "open_object", None)
    with pytest.raises(UsageError) as caught:
        download(SPLIT, SIZE, root=here, or_generate=False)
    assert caught.value.exit_code == 2
    assert caught.value.where == f"{SPLIT} {SIZE}"
    assert addresses.SETTINGS in str(caught.value.got)
    assert archive.RELEASES_VARIABLE in str(caught.value.fix)


@pytest.mark.parametrize(
    "releases",
    [
        " ",
        "nonsense",
        "/etc",
        "http://",
        "http://0x7f.1/",
        "http://user:secret@localhost/",
        "javascript:alert(1)",
        "data:,hello",
        "zip::http://localhost/a.zip",
        "simplecache::file:///etc",
        "x" * 5000,
    ],
)
def test_an_invalid_address_of_releases_is_refused(
    releases: str, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message has all parts, no password, and no megabyte of what was set."""
    monkeypatch.setenv(archive.RELEASES_VARIABLE, releases)
    with pytest.raises(UsageError) as caught:
        download(SPLIT, SIZE, root=here, or_generate=False)
    error = caught.value
    assert None not in (error.where, error.expected, error.got, error.fix)
    assert "secret" not in str(error)
    assert len(str(error)) < 1000
    assert not list(here.rglob("*.nc"))


@pytest.mark.parametrize(
    "address",
    ["ftp://ann:secret@localhost:1/data", "memory://ann:secret@x/data"],
)
def test_an_address_with_a_password_is_refused_without_it(
    address: str, here: Path
) -> None:
    with pytest.raises(UsageError) as caught:
        download(SPLIT, SIZE, root=here, mirror=address, or_generate=False)
    assert "secret" not in str(caught.value)


def test_an_at_sign_in_a_path_is_no_password() -> None:
    objects.check_address("http://localhost:8000/data@v2")
    objects.check_address("http://nas:8000/data@v2")
    objects.check_address("http://host/data@v2")
    objects.check_address("file:///my folder/data@v2")


def test_a_compressed_archive_is_not_unpacked(
    server: Mirror, packed: Path, here: Path
) -> None:
    """A bomb of zeros has no header where the first member must stand."""
    bomb = gzip.compress(bytes(100_000_000))
    (server.folder / packed.name).write_bytes(bomb)
    with pytest.raises(objects.NotDataError):
        fetch_own(server.url, here)
    assert not list(here.rglob("*.nc"))


def test_no_server_is_asked_for_a_local_split(
    server: Mirror, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(archive.RELEASES_VARIABLE, server.url)
    with pytest.raises(UsageError):
        download("own", root=here)
    assert server.asked == []


def test_an_archive_is_read_through_fsspec(server: Mirror, here: Path) -> None:
    url = server.folder.as_uri()
    assert fetch_own(url, here).complete
    assert is_right(here)


def test_a_manifest_comes_before_an_archive(original: LocalSplit, here: Path) -> None:
    """From a store that has files, no archive is requested."""
    with serving(original.folder.parent) as running:
        assert fetch_own(running.url, here).complete
        assert running.count(".tar") == 0


@pytest.mark.parametrize("fault", ["", "no ranges", "drops"])
@pytest.mark.parametrize("subset", ["test", "train", None])
def test_progress_ends_at_the_bytes_of_the_requested_files(
    server: Mirror, here: Path, subset: str | None, fault: str
) -> None:
    """Bytes of other members, and of the archive's manifest, are no progress."""
    server.faults = {".tar": fault}
    states: list[Progress] = []
    download("own", mirror=server.url, root=here, subset=subset, progress=states.append)
    length = 0
    for content in read_scenarios(here).values():
        length += len(content)
    last = states[-1]
    assert last.done == last.total == length
    for state in states:
        assert state.done <= state.total


def requested_ranges(server: Mirror) -> list[str | None]:
    """Return the ranges of the archive that were asked for."""
    ranges_of_archive = []
    for path, ranges in server.asked:
        if path.endswith(".tar"):
            ranges_of_archive.append(ranges)
    return ranges_of_archive


@pytest.mark.parametrize("fault", ["", "no ranges"])
def test_only_missing_members_are_requested(
    server: Mirror, here: Path, fault: str
) -> None:
    """The others are passed over, or read and dropped where there are no ranges."""
    first = fetch_own(server.url, here, subset="train")
    if fault:
        server.faults = {".tar": fault}
    last = fetch_own(server.url, here)
    downloaded = {*first.downloaded, *last.downloaded}
    assert downloaded == {0, 1, 2, 3}
    assert last.kept == first.downloaded
    assert last.complete
    if not fault:
        assert any(requested_ranges(server))


@pytest.mark.parametrize(
    "fault",
    [
        "drops",
        "no ranges",
        "busy once",
        "wrong range",
    ],
)
def test_a_bad_line_costs_time_only(server: Mirror, here: Path, fault: str) -> None:
    """Broken connections go on by range, or from the start without ranges.

    Bytes that are passed over, because they had come before, do not count again.
    """
    server.faults = {".tar": fault}
    result = fetch_own(server.url, here)
    assert result.complete
    (path,) = server.folder.glob("*.tar")
    length = path.stat().st_size
    assert result.bytes == length
    if fault == "drops":
        third = length // 3
        expected = [None, f"bytes={third}-", f"bytes={2 * third}-"]
        assert requested_ranges(server) == expected


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("chopped", objects.TruncatedError),
        ("ends early", objects.TruncatedError),
        ("announces more", objects.TruncatedError),
        ("drops always", LagbenchError),
        ("page", objects.NotDataError),
        ("hidden page", objects.NotDataError),
        ("endless", objects.NotDataError),
        ("busy", objects.StoreUnreachableError),
    ],
)
def test_a_lying_server_is_named(
    server: Mirror,
    packed: Path,
    here: Path,
    fault: str,
    error: type[LagbenchError],
) -> None:
    """Files that were right stay, and the next command completes them."""
    server.faults = {".tar": fault}
    with pytest.raises(error) as caught:
        fetch_own(server.url, here)
    assert caught.value.where == f"{server.url}/{packed.name}"
    if issubclass(error, DataError):
        for name in list_data_files(here):
            assert "partial" not in name
    server.faults = {}
    assert fetch_own(server.url, here).complete
    assert is_right(here)


def foreign_file(name: str) -> Member:
    """Return a file that does not belong to the archive."""
    return tarfile.TarInfo(name), b"\x89HDF\r\n\x1a\n" * 100


def foreign_link(name: str) -> Member:
    """Return a link to a file of the system."""
    member = tarfile.TarInfo(name)
    member.type = tarfile.SYMTYPE
    member.linkname = "/etc/passwd"
    return member, b""


def insert(index: int, member: Member) -> Change:
    """Return a change that puts a member at a place."""

    def change(members: Members) -> Members:
        before = members[:index]
        after = members[index:]
        return [*before, member, *after]

    return change


def append_foreign_file(members: Members) -> Members:
    """Add a member after the last."""
    return [*members, foreign_file("train/0099.nc")]


def insert_link(members: Members) -> Members:
    """Put a link under the name of the first scenario before it."""
    manifest, first, *others = members
    name = first[0].name
    return [manifest, foreign_link(name), first, *others]


def reverse_order(members: Members) -> Members:
    """Give the scenarios another order."""
    manifest, *scenarios = members
    return [manifest, *reversed(scenarios)]


def drop_last(members: Members) -> Members:
    """Leave out the last member."""
    return members[:-1]


def flip_second_scenario(members: Members) -> Members:
    """Change a bit of the second scenario."""
    manifest, first, (member, data), *others = members
    changed = (member, flip_bit(data))
    return [manifest, first, changed, *others]


def lengthen_first_scenario(members: Members) -> Members:
    """Add bytes to the first scenario."""
    manifest, (member, data), *others = members
    longer = (member, data + bytes(9))
    return [manifest, longer, *others]


def change_all_hashes(members: Members) -> Members:
    """Give all scenarios another content hash."""
    (member, text), *others = members
    manifest = Manifest.model_validate_json(text)
    other_hash = {"content_sha256": "0" * 64}
    entries = []
    for entry in manifest.files:
        entries.append(entry.model_copy(update=other_hash))
    changed = manifest.model_copy(update={"files": tuple(entries)})
    changed_text = changed.model_dump_json()
    return [(member, changed_text.encode()), *others]


def empty_manifest(members: Members) -> Members:
    """Make the manifest an empty object."""
    (member, _), *others = members
    return [(member, b"{}"), *others]


def lengthen_hashes(members: Members) -> Members:
    """Give all hashes a digit too much."""
    (member, text), *others = members
    changed = text.replace(b'"content_sha256": "', b'"content_sha256": "0')
    return [(member, changed), *others]


@pytest.mark.parametrize(
    ("change", "error"),
    [
        pytest.param(
            insert(0, foreign_file("a.nc")),
            objects.NotDataError,
            id="foreign first",
        ),
        pytest.param(
            insert(2, foreign_file("../evil.nc")),
            objects.WrongContentError,
            id="foreign between",
        ),
        pytest.param(
            insert(2, foreign_file("/tmp/evil.nc")),
            objects.WrongContentError,
            id="absolute",
        ),
        pytest.param(append_foreign_file, objects.WrongContentError, id="foreign last"),
        pytest.param(insert_link, objects.WrongContentError, id="link"),
        pytest.param(reverse_order, objects.WrongContentError, id="another order"),
        pytest.param(drop_last, objects.NotDataError, id="one missing"),
        pytest.param(flip_second_scenario, objects.WrongContentError, id="wrong bytes"),
        pytest.param(lengthen_first_scenario, objects.WrongLengthError, id="longer"),
        pytest.param(change_all_hashes, objects.WrongContentError, id="other data set"),
        pytest.param(empty_manifest, objects.NotDataError, id="no manifest"),
        pytest.param(lengthen_hashes, objects.NotDataError, id="other hashes"),
    ],
)
def test_archives_that_lie_are_refused(
    server: Mirror,
    packed: Path,
    here: Path,
    change: Change,
    error: type[LagbenchError],
) -> None:
    """Only right files of the data set stay, and no file lies elsewhere."""
    served = server.folder / packed.name
    rewrite_archive(served, change)
    with pytest.raises(error) as caught:
        fetch_own(server.url, here)
    assert type(caught.value) is error
    assert caught.value.exit_code == 4
    assert str(caught.value.where).startswith(f"{server.url}/{packed.name}")
    with tarfile.open(packed) as tar:
        right_names = {f"own/full/v1/{name}" for name in tar.getnames()}
    names = list_data_files(here)
    assert names <= right_names
    if change is change_all_hashes:
        # Another data set is refused before any file is taken.
        assert not names
    assert not list(here.rglob("evil.nc"))

    shutil.copy(packed, served)
    fetch_own(server.url, here)
    assert is_right(here)
