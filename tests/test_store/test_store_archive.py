"""Archives of data sets: their bytes, reading from a store, archives that lie."""

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
from lagbench.errors import LagbenchError
from lagbench.exchange import download
from lagbench.exchange.downloading import DownloadResult
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.store import archive, objects

DATA = f"{SPLIT}/{SIZE}/v2"

Member = tuple[tarfile.TarInfo, bytes]
Members = list[Member]


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not pause between attempts."""
    monkeypatch.setattr(objects, "PAUSE", 0.0)


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


def test_a_manifest_comes_before_an_archive(original: LocalSplit, here: Path) -> None:
    """From a store that has files, no archive is requested."""
    with serving(original.folder.parent) as running:
        assert fetch_own(running.url, here).complete
        assert running.count(".tar") == 0


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


@pytest.mark.parametrize(
    "change",
    [
        drop_last,
        flip_second_scenario,
        lengthen_first_scenario,
        change_all_hashes,
        empty_manifest,
    ],
)
def test_archives_that_lie_are_refused(
    server: Mirror,
    packed: Path,
    here: Path,
    change: Change,
) -> None:
    """Only right files of the data set stay, and no file lies elsewhere."""
    served = server.folder / packed.name
    rewrite_archive(served, change)
    with pytest.raises(objects.WrongContentError) as caught:
        fetch_own(server.url, here)
    assert caught.value.exit_code == 4
    assert str(caught.value.where).startswith(f"{server.url}/{packed.name}")
    with tarfile.open(packed) as tar:
        right_names = {f"own/full/v1/{name}" for name in tar.getnames()}
    names = list_data_files(here)
    assert names <= right_names
    if change is change_all_hashes:
        # Another data set is refused before any file is taken.
        assert not names

    shutil.copy(packed, served)
    fetch_own(server.url, here)
    assert is_right(here)
