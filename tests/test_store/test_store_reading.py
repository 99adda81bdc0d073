"""Reading from a store: only the needed files come, and they are checked."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from conftest import SIZE, SPLIT
from object_stores import Store, files, holding, machine

import lagbench
from lagbench.data.layout import as_url, url_of
from lagbench.data.local import resolve_root
from lagbench.data.registry import Registry
from lagbench.errors import DataError
from lagbench.make.generate import GenerationResult
from lagbench.make.inventory import overview
from lagbench.make.verify import verify
from lagbench.store import copy
from lagbench.submission import template

FOLDER = f"{SPLIT}/{SIZE}/v2"
MANIFEST = f"{FOLDER}/manifest.json"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Be a machine of its own, that asks for the manifest each time."""
    monkeypatch.setattr(copy, "FRESH_SECONDS", 0.0)
    return machine(monkeypatch, tmp_path / "cache")


@pytest.fixture(params=("http", "file", "s3"))
def store(
    request: pytest.FixtureRequest, generated: GenerationResult, tmp_path: Path
) -> Iterator[Store]:
    """A store of each kind that holds the tiny data set."""
    place = request.param
    if place == "s3":
        place = request.getfixturevalue("s3")
    with holding(place, tmp_path, generated.root) as filled:
        yield filled


@pytest.fixture
def folder(generated: GenerationResult, tmp_path: Path) -> Iterator[Store]:
    """A folder as a store, where the kind of the store does not matter."""
    with holding("file", tmp_path, generated.root) as filled:
        yield filled


@pytest.fixture
def url(folder: Store) -> str:
    """The URL of that folder."""
    return folder.url


@pytest.fixture
def tiny(
    unmeasured: Registry,
    monkeypatch: pytest.MonkeyPatch,
    unmeasured_path: Path,
) -> Registry:
    """The splits without hashes, also for functions that take no registry."""
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(unmeasured_path))
    return unmeasured


def list_copy(url: str) -> list[str]:
    """Return the names of the working copy's files."""
    names = files(resolve_root(url))
    return sorted(name.removeprefix(f"{FOLDER}/") for name in names)


def open_and_close(root: str, **options: Any) -> None:
    """Open the data set, by which its files come."""
    lagbench.open_split(SPLIT, size=SIZE, root=root, **options).close()


def assert_verified(root: str, registry: Registry) -> None:
    """Assert that the data set is complete and sound."""
    result = verify(SPLIT, SIZE, root=root, complete=True, registry=registry)
    result.check()


def test_only_the_files_of_a_subset_come(
    store: Store, generated: GenerationResult, tiny: Registry
) -> None:
    """The arrays are those of the folder."""
    with (
        lagbench.open_split(SPLIT, size=SIZE, root=store.url) as data,
        lagbench.open_split(SPLIT, size=SIZE, root=generated.root) as expected,
    ):
        xr.testing.assert_identical(data.compute(), expected.compute())
    names = list_copy(store.url)
    assert names == ["manifest.json", "test/0003.nc", "test/0004.nc"]


def test_a_second_look_fetches_nothing(store: Store, tiny: Registry) -> None:
    open_and_close(store.url)
    store.remove(f"{FOLDER}/test/0003.nc")
    open_and_close(store.url)
    if store.server:
        assert store.server.count("0004.nc") == 1


def test_scenarios_that_the_store_lacks_are_an_error(
    store: Store, tiny: Registry
) -> None:
    root = f"{store.url}/nothing"
    with pytest.raises(DataError):
        lagbench.open_split(SPLIT, size=SIZE, subset="train", root=root)


@pytest.mark.slow
def test_scores_are_those_of_the_folder(
    url: str,
    generated: GenerationResult,
    tiny: Registry,
    tmp_path: Path,
) -> None:
    """They need the test subset alone.

    The reference that reads train is scored only where train is.
    """
    path = tmp_path / "p.nc"
    template(
        SPLIT,
        SIZE,
        output=path,
        root=generated.root,
        registry=tiny,
    )
    result = lagbench.validate(path, root=url, require_truth=True, registry=tiny)
    assert result.valid
    assert not result.skipped
    assert list_copy(url) == ["manifest.json", "test/0003.nc", "test/0004.nc"]

    from_store = lagbench.score(
        path,
        root=url,
        write=False,
        registry=tiny,
    )
    from_folder = lagbench.score(
        path,
        root=generated.root,
        write=False,
        registry=tiny,
    )
    rows = from_store.as_json()["rows"]
    expected = from_folder.as_json()["rows"]
    missing = expected.keys() - rows.keys()
    assert missing == {"analog"}
    for row, scores in rows.items():
        assert expected[row] == scores


def test_a_listing_counts_what_the_store_has(url: str, tiny: Registry) -> None:
    """The manifest counts, not the working copy; nothing is fetched."""
    size = tiny.size(SPLIT, SIZE)
    listing = overview(size, resolve_root(url))
    assert listing.state == "yes"
    assert listing.present == {"train": 2, "valid": 1, "test": 2}
    assert list_copy(url) == []
    nothing = overview(size, resolve_root(f"{url}/nothing"))
    assert nothing.state == "no"


def test_verify_mends_the_copy(store: Store, tiny: Registry) -> None:
    """A damaged file comes again."""
    assert_verified(store.url, tiny)
    path = resolve_root(store.url) / FOLDER / "valid/0002.nc"
    content = path.read_bytes()
    path.write_bytes(content[:-9] + bytes(9))
    assert_verified(store.url, tiny)


def test_a_url_may_come_as_a_path() -> None:
    """A Path takes a slash away and means the same."""
    root = resolve_root("s3://bucket/some/where/")
    assert root == resolve_root(Path("s3://bucket/some/where"))
    assert root.name.startswith("s3-bucket-some-where-")
    assert url_of(root) == "s3://bucket/some/where"
    assert resolve_root(root) == root
    assert as_url(Path("file:///tmp/x")) == "file:///tmp/x"
