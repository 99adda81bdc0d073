"""Generation into a store: the same objects, whole, the manifest last; machines that come and go."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from conftest import SIZE, SPLIT
from exchange_readers import straight_runs
from object_stores import files, machine, objects, put, remove, s3_server, stored

from lagbench.atomic import write_atomically
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import resolve_root, url_of
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry
from lagbench.errors import DataError, WorkFailedError
from lagbench.exchange import adopt, download
from lagbench.make.generate import GenerationResult, generate
from lagbench.store import lease as leases
from lagbench.store import publication
from lagbench.store.remote import Remote

FOLDER = f"{SPLIT}/{SIZE}/v2"
MANIFEST = f"{FOLDER}/manifest.json"
Fill = Callable[[str], str]
Run = Callable[..., GenerationResult]
Wrote = list[tuple[str, dict[str, bytes]]]


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """An S3 server."""
    with s3_server() as url:
        yield url


@pytest.fixture
def url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An empty store in memory, and a machine of its own."""
    machine(monkeypatch, tmp_path / "cache")
    return f"memory://{uuid.uuid4().hex}/data"


@pytest.fixture
def run(unmeasured: Registry) -> Run:
    """Generate into a store."""
    return lambda url, **options: generate(SPLIT, SIZE, root=url, registry=unmeasured, workers=1, **options)


@pytest.fixture
def simulated_here(generated: GenerationResult) -> Fill:
    """Fill the working copy of a store as a simulation would, so that tests need not simulate."""

    def fill(url: str) -> str:
        shutil.copytree(generated.root, resolve_root(url), dirs_exist_ok=True)
        return url

    return fill


@pytest.fixture
def wrote(monkeypatch: pytest.MonkeyPatch) -> Wrote:
    """Every object that is put, in order, with all that is in the store then."""
    seen: Wrote = []
    first_put, first_write = Remote.put, Remote.write

    def after(remote: Remote, name: str) -> None:
        if not name.startswith(".lock"):
            seen.append((name, objects(remote.url)))

    def put(remote: Remote, name: str, source: Path) -> None:
        first_put(remote, name, source)
        after(remote, name)

    def write(remote: Remote, name: str, data: bytes) -> None:
        first_write(remote, name, data)
        after(remote, name)

    monkeypatch.setattr(Remote, "put", put)
    monkeypatch.setattr(Remote, "write", write)
    return seen


def fail_after(monkeypatch: pytest.MonkeyPatch, count: int, error: BaseException) -> None:
    """Let a machine end when it has put so many scenarios."""
    put, left = Remote.put, iter(range(count))

    def failing(remote: Remote, name: str, source: Path) -> None:
        if name.endswith(".nc") and next(left, None) is None:
            raise error
        put(remote, name, source)

    monkeypatch.setattr(Remote, "put", failing)


def named(data: bytes) -> list[str]:
    """Return the paths that a manifest names."""
    return [entry["path"] for entry in json.loads(data)["files"]]


def test_another_machine_ends_what_one_began(
    s3: str,
    run: Run,
    simulated_here: Fill,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It simulates only what is missing, and the objects are those of a plain generation, all of them."""
    machine(monkeypatch, tmp_path / "first")
    simulated_here(s3)
    with monkeypatch.context() as patch:
        fail_after(patch, 4, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run(s3)
    begun = objects(s3)
    assert sorted(begun) == sorted([MANIFEST, *(f"{FOLDER}/{path}" for path in named(begun[MANIFEST]))])
    assert len(begun) == 5
    machine(monkeypatch, tmp_path / "second")
    result = run(s3)
    assert (len(result.simulated), len(result.kept), result.complete) == (1, 4, True)
    assert objects(s3) == files(generated.root)
    assert url_of(result.root) == s3


def test_what_is_there_is_neither_simulated_nor_fetched(
    url: str, run: Run, generated: GenerationResult, wrote: Wrote
) -> None:
    """A second machine adds nothing, and has nothing but the manifest afterwards."""
    full = stored(generated.root)
    before = objects(full)
    result = run(full)
    assert (result.simulated, result.kept, result.missing) == ((), (0, 1, 2, 3, 4), ())
    assert result.dataset_sha256 == generated.dataset_sha256
    assert objects(full) == before
    assert wrote == []
    assert [*files(result.root)] == [MANIFEST]


def test_the_manifest_comes_last(
    url: str,
    run: Run,
    simulated_here: Fill,
    wrote: Wrote,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At no time does it name an object that is not there; after the cards it is put once more."""
    monkeypatch.setattr(publication, "EVERY", 0.0)
    run(simulated_here(url))
    names = [name for name, _ in wrote]
    assert names[:5] == ["train/0000.nc", "train/0001.nc", "valid/0002.nc", "test/0003.nc", "test/0004.nc"]
    assert names[-3:] == ["croissant.json", "README.md", "manifest.json"]
    for _, there in wrote:
        assert {*named(there.get("manifest.json", b'{"files": []}'))} <= there.keys()


def test_a_fault_in_the_middle_leaves_whole_objects(
    url: str,
    run: Run,
    simulated_here: Fill,
    generated: GenerationResult,
    wrote: Wrote,
) -> None:
    """The manifest names what had been put; the next call puts the rest and nothing twice."""
    simulated_here(url)
    with pytest.MonkeyPatch.context() as patch:
        fail_after(patch, 2, WorkFailedError("the store does not answer or fails"))
        with pytest.raises(WorkFailedError, match="does not answer"):
            run(url)
    assert named(objects(url)[MANIFEST]) == ["train/0000.nc", "train/0001.nc"]
    wrote.clear()
    run(url)
    assert [name for name, _ in wrote][:3] == ["valid/0002.nc", "test/0003.nc", "test/0004.nc"]
    assert objects(url) == files(generated.root)


def test_a_damaged_object_is_replaced_and_not_named_meanwhile(
    url: str,
    run: Run,
    generated: GenerationResult,
    simulated_here: Fill,
    wrote: Wrote,
) -> None:
    """The manifest lets go of it, then it is put, then it is named again."""
    full = stored(generated.root)
    put(full, f"{FOLDER}/train/0001.nc", b"half")
    run(simulated_here(full))
    assert objects(full) == files(generated.root)
    names = [name for name, _ in wrote]
    assert names[:2] == ["manifest.json", "train/0001.nc"]
    assert "train/0001.nc" not in named(wrote[0][1]["manifest.json"])
    assert names[-1] == "manifest.json"


def test_what_is_no_manifest_is_written_anew(
    url: str, run: Run, generated: GenerationResult, simulated_here: Fill
) -> None:
    """Objects that no manifest names are put again, with a manifest."""
    full = stored(generated.root)
    put(full, MANIFEST, b"{}")
    run(simulated_here(full))
    assert objects(full) == files(generated.root)


def test_a_second_generation_waits_for_the_first(
    url: str, run: Run, simulated_here: Fill, generated: GenerationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says who writes, begins when that one has ended, and finds what it left."""
    monkeypatch.setattr(leases, "POLL", 0.01)
    told: list[str] = []
    with ExitStack() as first:
        first.enter_context(leases.lease(Remote(url, FOLDER)))

        def end(holder: str) -> None:
            told.append(holder)
            for name, data in files(generated.root).items():
                put(url, name, data)
            first.close()

        result = run(url, on_wait=end)
    assert (len(told), result.simulated, result.kept) == (1, (), (0, 1, 2, 3, 4))
    assert f"process {os.getpid()} on " in told[0]


def test_a_dry_run_only_looks(url: str, run: Run, generated: GenerationResult) -> None:
    """It counts what the store holds and puts nothing there, no lock either."""
    full = stored(generated.root)
    remove(full, f"{FOLDER}/valid/0002.nc")
    before = objects(full)
    result = run(full, dry_run=True)
    assert (result.simulated, result.kept) == ((2,), (0, 1, 3, 4))
    assert objects(full) == before
    assert Remote(full, FOLDER).beside().count(".lock.000001") == 0
    assert files(result.root) == {}


def test_a_file_that_changed_is_not_put(url: str, run: Run, simulated_here: Fill) -> None:
    """What the manifest says of a file holds for the object, or there is none."""
    simulated_here(url)
    path = resolve_root(url) / FOLDER / "train/0000.nc"
    data = path.read_bytes()
    write_atomically(path, data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])
    with pytest.raises(DataError, match="another than its manifest says"):
        run(url, scenarios="3")
    assert f"{FOLDER}/train/0000.nc" not in objects(url)


def test_a_folder_by_its_url_is_a_store_too(
    tmp_path: Path,
    run: Run,
    simulated_here: Fill,
    generated: GenerationResult,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """``file://`` goes the same way, by temporary names of which none is left."""
    machine(monkeypatch, tmp_path / "cache")
    url = (tmp_path / "store").as_uri()
    run(simulated_here(url))
    assert objects(url) == files(generated.root)


def test_a_download_goes_into_a_store(tmp_path: Path, url: str) -> None:
    """What a mirror has arrives there with its manifest; a second call fetches nothing."""
    np.save(tmp_path / "runs.npy", np.stack(straight_runs(4, frames=12)))
    own = adopt(tmp_path / "runs.npy", output=tmp_path / "own", radius=0.1, frame_interval=0.1)
    (resolve_root(url) / "own").mkdir(parents=True)
    shutil.copy(own.folder / "split.yaml", resolve_root(url) / "own")
    result = download("own", root=url, mirror=tmp_path.as_uri())
    assert (result.downloaded, result.complete) == ((0, 1, 2, 3), True)
    there = {name.removeprefix("own/"): data for name, data in objects(url).items()}
    scenarios = {name: data for name, data in files(own.folder).items() if name.endswith(".nc")}
    assert there == {**scenarios, "full/v1/manifest.json": there["full/v1/manifest.json"]}
    assert named(there["full/v1/manifest.json"]) == [
        f"{subset}/{i:04d}.nc" for i, subset in enumerate(["train", "train", "valid", "test"])
    ]
    again = download("own", root=url, mirror="file:///nowhere")
    assert (again.downloaded, again.kept) == ((), (0, 1, 2, 3))


def test_what_was_made_anew_is_not_fetched_back(
    url: str, unmeasured: Registry, generated: GenerationResult, simulated_here: Fill
) -> None:
    """A file of other bytes replaces the object, and no old one comes over it."""
    full = simulated_here(stored(generated.root))
    size, root = unmeasured.size(SPLIT, SIZE), resolve_root(full)
    path = root / FOLDER / "train/0000.nc"
    path.write_bytes(path.read_bytes() + b"\0")
    with publication.publication(size, root) as store:
        assert store is not None
        manifest = read_manifest(root, SPLIT, SIZE, 2)
        assert manifest is not None
        first = manifest.files[0]
        new = first.model_copy(update={"bytes": first.bytes + 1, "file_sha256": file_sha256(path)})
        store.follow(manifest.model_copy(update={"files": (new, *manifest.files[1:])}), at_once=True)
        store.bring(size.scenarios)
    assert objects(full)[f"{FOLDER}/train/0000.nc"] == path.read_bytes()
    assert path.stat().st_size == new.bytes
    assert named(objects(full)[MANIFEST])[0] == "train/0000.nc"
