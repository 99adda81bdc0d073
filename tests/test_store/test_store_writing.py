"""Generation into a store: the same objects, whole, the manifest last; machines that
come and go.
"""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT
from object_stores import files, fill, machine, objects, put

from lagbench.data.layout import url_of
from lagbench.data.local import resolve_root
from lagbench.data.registry import Registry
from lagbench.exchange import download
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult, generate
from lagbench.store.objects import Objects

FOLDER = f"{SPLIT}/{SIZE}/v2"
MANIFEST = f"{FOLDER}/manifest.json"
Fill = Callable[[str], str]
Run = Callable[..., GenerationResult]


@pytest.fixture(params=("file", "s3"))
def url(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> str:
    """An empty store of each kind that can be written to, and a machine of its own."""
    machine(monkeypatch, tmp_path / "cache")
    if request.param == "file":
        return (tmp_path / "store").as_uri()
    return f"{request.getfixturevalue('s3')}/{uuid.uuid4().hex}"


@pytest.fixture
def full(url: str, generated: GenerationResult) -> str:
    """A store that holds the tiny data set."""
    fill(url, generated.root)
    return url


@pytest.fixture
def run(unmeasured: Registry) -> Run:
    """Generate into a store."""
    return lambda url, **options: generate(
        SPLIT, SIZE, root=url, registry=unmeasured, workers=1, **options
    )


@pytest.fixture
def simulated_here(generated: GenerationResult) -> Fill:
    """Fill the working copy of a store as a simulation would, so that tests need not
    simulate.
    """

    def fill(url: str) -> str:
        shutil.copytree(generated.root, resolve_root(url), dirs_exist_ok=True)
        return url

    return fill


def fail_after(
    monkeypatch: pytest.MonkeyPatch, count: int, error: BaseException
) -> None:
    """Let a machine end when it has put so many scenarios."""
    put = Objects.put
    left = iter(range(count))

    def failing(store: Objects, name: str, source: Path) -> None:
        if name.endswith(".nc") and next(left, None) is None:
            raise error
        put(store, name, source)

    monkeypatch.setattr(Objects, "put", failing)


def named(data: bytes) -> list[str]:
    """Return the paths that a manifest names."""
    return [entry["path"] for entry in json.loads(data)["files"]]


@pytest.mark.slow
def test_another_machine_ends_what_one_began(
    url: str,
    run: Run,
    simulated_here: Fill,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It simulates only what is missing, and the objects are those of a plain
    generation, all of them.
    """
    simulated_here(url)
    with monkeypatch.context() as patch:
        fail_after(patch, 4, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run(url)
    begun = objects(url)
    assert sorted(begun) == sorted(
        [MANIFEST, *(f"{FOLDER}/{path}" for path in named(begun[MANIFEST]))]
    )
    assert len(begun) == 5
    machine(monkeypatch, tmp_path / "second")
    result = run(url)
    assert len(result.simulated) == 1
    assert len(result.kept) == 4
    assert result.complete
    assert objects(url) == files(generated.root)
    assert url_of(result.root) == url


def test_what_is_there_is_neither_simulated_nor_fetched(
    full: str, run: Run, generated: GenerationResult
) -> None:
    """A second machine adds nothing, and has nothing but the manifest afterwards."""
    before = objects(full)
    result = run(full)
    assert result.simulated == ()
    assert result.kept == (0, 1, 2, 3, 4)
    assert result.missing == ()
    assert result.dataset_sha256 == generated.dataset_sha256
    assert objects(full) == before
    assert [*files(result.root)] == [MANIFEST]


@pytest.mark.slow
def test_a_damaged_object_is_replaced(
    full: str, run: Run, generated: GenerationResult, simulated_here: Fill
) -> None:
    """Objects that no manifest names are put again, with a manifest."""
    put(full, f"{FOLDER}/train/0001.nc", b"half")
    run(simulated_here(full))
    assert objects(full) == files(generated.root)
    put(full, MANIFEST, b"{}")
    run(full)
    assert objects(full) == files(generated.root)


@pytest.mark.slow
def test_two_writers_do_no_harm(
    url: str,
    run: Run,
    simulated_here: Fill,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two machines write different scenarios at once: the last manifest names what both
    have put.
    """
    simulated_here(url)
    put_first = Objects.put

    def meanwhile(store: Objects, name: str, source: Path) -> None:
        monkeypatch.setattr(Objects, "put", put_first)
        machine(monkeypatch, tmp_path / "second")
        simulated_here(url)
        leave_only(resolve_root(url), "test", "valid")
        run(url, subset="valid,test")
        machine(monkeypatch, tmp_path / "cache")
        store.put(name, source)

    leave_only(resolve_root(url), "train")
    monkeypatch.setattr(Objects, "put", meanwhile)
    run(url, subset="train")
    result = run(url)
    assert result.simulated == ()
    assert result.complete
    found = objects(url)
    for name, data in files(generated.root).items():
        if name.endswith(".nc"):
            assert found[name] == data


def leave_only(root: Path, *subsets: str) -> None:
    """Leave a working copy some subsets, and a manifest of them."""
    manifest = json.loads((root / MANIFEST).read_bytes())
    for entry in manifest["files"]:
        if entry["subset"] not in subsets:
            (root / FOLDER / entry["path"]).unlink()
    manifest["files"] = [
        entry for entry in manifest["files"] if entry["subset"] in subsets
    ]
    (root / MANIFEST).write_text(json.dumps(manifest))


def test_a_download_goes_into_a_store(original: LocalSplit, url: str) -> None:
    """What a mirror has arrives there with its manifest; a second call fetches
    nothing.
    """
    (resolve_root(url) / "own").mkdir(parents=True)
    shutil.copy(original.folder / "split.yaml", resolve_root(url) / "own")
    result = download("own", root=url, mirror=original.folder.parent.as_uri())
    assert result.downloaded == (0, 1, 2, 3)
    assert result.complete
    there = {
        name.removeprefix("own/full/v1/"): data for name, data in objects(url).items()
    }
    manifest = there.pop("manifest.json")
    assert named(manifest) == [
        "train/0000.nc",
        "train/0001.nc",
        "valid/0002.nc",
        "test/0003.nc",
    ]
    assert there == {
        name: (original.folder / "full/v1" / name).read_bytes()
        for name in named(manifest)
    }
    again = download("own", root=url, mirror="file:///nowhere")
    assert again.downloaded == ()
    assert again.kept == (0, 1, 2, 3)
