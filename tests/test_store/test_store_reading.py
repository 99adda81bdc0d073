"""Reading from a store: only what is needed comes, it is checked, and then all is as in
a folder.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import xarray as xr
from conftest import SIZE, SPLIT
from object_stores import Store, files, holding, machine
from typer.testing import Result

import lagbench
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.data.layout import as_url, url_of
from lagbench.data.local import resolve_root
from lagbench.data.registry import Registry
from lagbench.errors import DataError
from lagbench.exchange import export
from lagbench.make.generate import GenerationResult
from lagbench.make.inventory import overview
from lagbench.make.verify import verify
from lagbench.store import copy
from lagbench.store.objects import NotDataError, WrongContentError, WrongLengthError
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
    place = request.getfixturevalue("s3") if request.param == "s3" else request.param
    with holding(place, tmp_path, generated.root) as held:
        yield held


@pytest.fixture
def folder(generated: GenerationResult, tmp_path: Path) -> Iterator[Store]:
    """A folder by its URL that holds it, for what the kind of a store does not matter
    to.
    """
    with holding("file", tmp_path, generated.root) as held:
        yield held


@pytest.fixture
def url(folder: Store) -> str:
    """The URL of that folder."""
    return folder.url


@pytest.fixture
def tiny(
    unmeasured: Registry, monkeypatch: pytest.MonkeyPatch, unmeasured_path: Path
) -> Registry:
    """Our splits without hashes, for functions too that take no registry."""
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(unmeasured_path))
    return unmeasured


def here(url: str) -> list[str]:
    """Return the names of the working copy's files."""
    return sorted(name.removeprefix(f"{FOLDER}/") for name in files(resolve_root(url)))


def without(text: bytes, key: str, value: object) -> bytes:
    """Return a manifest without the files of a scenario or subset."""
    held = json.loads(text)
    held["files"] = [entry for entry in held["files"] if entry[key] != value]
    return json.dumps(held).encode()


def test_a_subset_comes_and_nothing_else(
    store: Store, generated: GenerationResult, tiny: Registry
) -> None:
    """The arrays are those of the folder; a second look fetches nothing; what the store
    lacks is named.
    """
    with (
        lagbench.open_split(SPLIT, size=SIZE, root=store.url) as far,
        lagbench.open_split(SPLIT, size=SIZE, root=generated.root) as near,
    ):
        xr.testing.assert_identical(far.compute(), near.compute())
    assert here(store.url) == ["manifest.json", "test/0003.nc", "test/0004.nc"]
    store.remove(f"{FOLDER}/test/0003.nc")
    lagbench.open_split(SPLIT, size=SIZE, root=store.url).close()
    assert not store.server or store.server.count("0004.nc") == 1
    with pytest.raises(DataError):
        lagbench.open_split(
            SPLIT, size=SIZE, subset="train", root=f"{store.url}/nothing"
        )


def test_scores_are_those_of_the_folder(
    url: str, generated: GenerationResult, tiny: Registry, tmp_path: Path
) -> None:
    """Template, validation and scores need test alone; a floor that reads train is
    scored where it is.
    """
    written = template(
        SPLIT, SIZE, output=tmp_path / "p.nc", root=generated.root, registry=tiny
    ).path
    result = lagbench.validate(written, root=url, require_truth=True, registry=tiny)
    assert result.valid
    assert dict(result.skipped) == {}
    assert here(url) == ["manifest.json", "test/0003.nc", "test/0004.nc"]
    far, near = (
        lagbench.score(written, root=root, write=False, registry=tiny).as_json()
        for root in (url, generated.root)
    )
    assert near["rows"].keys() - far["rows"].keys() == {"analog"}
    assert all(near["rows"][row] == scores for row, scores in far["rows"].items())


def test_baselines_and_exports_read_from_a_store(
    url: str, generated: GenerationResult, tiny: Registry, tmp_path: Path
) -> None:
    """Dataset info, training files and the bytes of an export are those of the folder.

    An export needs all subsets.
    """
    assert read_dataset_info(SPLIT, SIZE, root=url) == read_dataset_info(
        SPLIT, SIZE, root=generated.root
    )
    assert here(url) == ["manifest.json", "train/0000.nc"]
    found = copy.scenario_files(
        tiny.size(SPLIT, SIZE), resolve_root(url), ("train", "valid")
    )
    names = ("train/0000.nc", "train/0001.nc", "valid/0002.nc")
    there = [(generated.folder / name).read_bytes() for name in names]
    assert [path.read_bytes() for path in found.values()] == there
    far, near = (
        files(
            export(
                SPLIT,
                SIZE,
                format="gns-npz",
                output=tmp_path / name,
                root=root,
                registry=tiny,
            ).folder
        )
        for name, root in (("far", url), ("near", generated.root))
    )
    assert far == near


def test_a_listing_counts_what_the_store_has(url: str, tiny: Registry) -> None:
    """Of a store the manifest counts, not the working copy; nothing is fetched."""
    found = overview(tiny.size(SPLIT, SIZE), resolve_root(url))
    assert found.state == "yes"
    assert found.present == {"train": 2, "valid": 1, "test": 2}
    assert here(url) == []
    assert (
        overview(tiny.size(SPLIT, SIZE), resolve_root(f"{url}/nothing")).state == "no"
    )


def test_verify_mends_the_copy_and_tells_of_the_store(
    store: Store, tiny: Registry
) -> None:
    """A damaged file comes again; an object that is gone is named, but over HTTP, which
    lists nothing.

    Files that are in the working copy alone make no data set of the store whole, be it
    one or all.
    """
    verify(SPLIT, SIZE, root=store.url, complete=True, registry=tiny).check()
    path = resolve_root(store.url) / FOLDER / "valid/0002.nc"
    path.write_bytes(path.read_bytes()[:-9] + bytes(9))
    verify(SPLIT, SIZE, root=store.url, complete=True, registry=tiny).check()
    good = store.read(f"{FOLDER}/valid/0002.nc")
    store.remove(f"{FOLDER}/valid/0002.nc")
    if not store.server:
        with pytest.raises(DataError) as caught:
            verify(SPLIT, SIZE, root=store.url, registry=tiny)
        assert str(caught.value.where).endswith("scenarios 2")
    store.put(f"{FOLDER}/valid/0002.nc", good)
    store.put(MANIFEST, without(store.read(MANIFEST), "scenario", 3))
    lost = verify(SPLIT, SIZE, root=store.url, registry=tiny)
    assert "scenario 3 is in the working copy alone, not in the store" in lost.problems
    store.remove(MANIFEST)
    assert len(verify(SPLIT, SIZE, root=store.url, registry=tiny).problems) == 5


def test_other_content_is_refused(folder: Store, tiny: Registry) -> None:
    """The error names the object, and no file of it is left."""
    name = f"{FOLDER}/test/0003.nc"
    good = folder.read(name)
    changed = bytearray(good)
    changed[-9] ^= 1
    other_scenario = folder.read(f"{FOLDER}/test/0004.nc")
    for wrong in (bytes(changed), good[:-1], other_scenario):
        folder.put(name, wrong)
        with pytest.raises((WrongContentError, WrongLengthError)) as caught:
            lagbench.open_split(SPLIT, size=SIZE, root=folder.url)
        assert caught.value.where == f"{folder.url}/{name}"
        assert {*here(folder.url)} <= {"test/0004.nc"}
        shutil.rmtree(resolve_root(folder.url) / FOLDER)


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        ("content_sha256", "0" * 64, WrongContentError),
        ("bytes", 300_000_000, WrongLengthError),
        ("split", "../../../elsewhere", NotDataError),
        ("size", "mini", NotDataError),
        ("version", "7.0.0", NotDataError),
    ],
)
def test_what_a_manifest_cannot_say_is_refused(
    folder: Store, tmp_path: Path, key: str, value: object, error: type[DataError]
) -> None:
    """Other hashes than those of datasets.yaml, endless files, names that lead
    elsewhere: nothing comes.
    """
    text = json.loads(folder.read(MANIFEST))
    for part in text["files"] if key in ("content_sha256", "bytes") else [text]:
        part[key] = value
    folder.put(MANIFEST, json.dumps(text).encode())
    before = set(tmp_path.rglob("manifest.json"))
    with pytest.raises(error):
        lagbench.open_split(SPLIT, size=SIZE, root=folder.url)
    assert here(folder.url) == []
    assert set(tmp_path.rglob("manifest.json")) == before


def test_who_watches_is_told_how_far_it_is(
    url: str,
    tiny: Registry,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On a terminal a line on stderr counts files and bytes; with --quiet it does
    not.
    """
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    lagbench.open_split(SPLIT, size=SIZE, root=url).close()
    assert f"fetching from {url}: 2 of 2 files" in capsys.readouterr().err
    with copy.silence_fetching():
        lagbench.open_split(SPLIT, size=SIZE, subset="valid", root=url).close()
    assert capsys.readouterr() == ("", "")


def test_what_only_the_copy_has_stays_known(
    folder: Store, tiny: Registry, generated: GenerationResult
) -> None:
    """Reading loses nothing of a generation that could not put its files yet."""
    shutil.copytree(generated.root, resolve_root(folder.url), dirs_exist_ok=True)
    (resolve_root(folder.url) / FOLDER / "test/0003.nc").unlink()
    full = folder.read(MANIFEST)
    folder.put(MANIFEST, without(full, "subset", "train"))
    lagbench.open_split(SPLIT, size=SIZE, root=folder.url).close()
    assert (resolve_root(folder.url) / MANIFEST).read_bytes() == full


def test_urls_and_paths_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Path takes a slash away and means the same; LAGBENCH_ROOT may be a URL; a
    stranger's mark is none.
    """
    copy = resolve_root("s3://bucket/some/where/")
    assert copy == resolve_root(Path("s3://bucket/some/where"))
    assert copy.name.startswith("s3-bucket-some-where-")
    assert url_of(copy) == "s3://bucket/some/where"
    assert resolve_root(copy) == copy
    monkeypatch.setenv("LAGBENCH_ROOT", "memory://x/y")
    assert url_of(resolve_root()) == "memory://x/y"
    shutil.copytree(copy, tmp_path / copy.name)
    assert url_of(tmp_path / copy.name) is None
    assert as_url(Path("file:///tmp/x")) == "file:///tmp/x"
    assert [
        as_url(path) for path in ("data", "/data", "C:/data", "./s3:", tmp_path)
    ] == [None] * 5


def test_the_command_line_takes_a_url(
    url: str, run: Callable[..., Result], tmp_path: Path
) -> None:
    """List, template, verify and info work on a store as on a folder; the list says
    where it is.
    """
    one = (SPLIT, "--size", SIZE)
    more = {
        "list": (),
        "template": (*one, "--output", tmp_path / "p.nc"),
        "verify": one,
        "info": one,
    }
    done = {word: run(word, *words, "--root", url) for word, words in more.items()}
    assert [result.exit_code for result in done.values()] == [0, 0, 0, 0]
    assert url in done["list"].output.replace("\n", "")
    assert "2 scenarios" in done["template"].output
    assert "data set hash:" in done["verify"].output
    assert "Path" not in done["info"].output
