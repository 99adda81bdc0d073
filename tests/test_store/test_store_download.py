"""Downloads from stores that work, break, and lie: right files, or an error by name and
nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from faulty_server import Mirror, serving
from numpy.testing import assert_array_equal
from object_stores import Store, holding
from trajectories import straight_runs

import lagbench
from lagbench.errors import DataError, LagbenchError
from lagbench.exchange import adopt, download
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.store import objects

FIRST = "train/0000.nc"
LIST = "manifest.json"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not pause between attempts."""
    monkeypatch.setattr(objects, "PAUSE", 0.0)


@pytest.fixture(params=("http", "file", "s3"))
def store(
    request: pytest.FixtureRequest,
    original: LocalSplit,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Store]:
    """A store of each kind that holds it."""
    place = request.getfixturevalue("s3") if request.param == "s3" else request.param
    with holding(
        place, tmp_path_factory.mktemp("store"), original.folder.parent
    ) as held:
        yield held


@pytest.fixture
def server(original: LocalSplit) -> Iterator[Mirror]:
    """An HTTP server that can be told to lie."""
    with serving(original.folder.parent) as running:
        yield running


def left(root: Path) -> set[str]:
    """Return the names of all files below a root folder but description and locks."""
    names = set()
    for path in root.rglob("*"):
        is_other = path.name == "split.yaml" or path.name.startswith(".lock")
        if path.is_file() and not is_other:
            names.add(path.name)
    return names


def test_all_files_come_and_are_right(
    store: Store,
    here: Path,
    original: LocalSplit,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The data set is complete and equals the original; nothing temporary is left.

    A second download reads bytes, not values.
    """
    result = download("own", root=here, mirror=store.url + "/")
    assert result.downloaded == (0, 1, 2, 3)
    assert result.kept == ()
    assert result.generated == ()
    assert result.complete
    assert result.dataset_sha256 == original.dataset_sha256
    paths = sorted(here.rglob("*.nc"))
    assert result.bytes == sum(path.stat().st_size for path in paths)
    scenario_files = {"0000.nc", "0001.nc", "0002.nc", "0003.nc"}
    assert left(here) == scenario_files | {LIST, ".verified.json"}
    assert lagbench.verify("own", root=here, complete=True).warnings == ()
    with lagbench.open_split("own", root=here) as scenarios:
        position = scenarios["position"].values
    with lagbench.open_split(str(original.folder)) as scenarios:
        assert_array_equal(position, scenarios["position"].values)
    monkeypatch.setattr("lagbench.make.inventory.check_scenario", None)
    assert download("own", root=here, mirror=store.url).kept == (0, 1, 2, 3)


def test_existing_files_are_not_fetched_again(store: Store, here: Path) -> None:
    """A second download asks for what is missing or damaged, and for nothing else."""
    download("own", root=here, mirror=store.url, subset="train")
    train = here / "own/full/v1/train"
    other_content = (train / "0001.nc").read_bytes()
    (train / "0000.nc").write_bytes(other_content)
    result = download("own", root=here, mirror=store.url, subset="train,valid")
    assert result.downloaded == (0, 2)
    assert result.kept == (1,)
    assert not result.complete
    if store.server:
        assert store.server.count("0001.nc") == 1


@pytest.mark.parametrize("fault", ["gone", "cut"])
def test_the_manifest_forgets_files_that_are_gone_or_cut(
    server: Mirror, here: Path, fault: str
) -> None:
    """Also if only other scenarios are selected."""
    assert download("own", root=here, mirror=server.url).complete
    path = here / "own/full/v1/test/0003.nc"
    content = path.read_bytes()
    path.unlink()
    if fault == "cut":
        path.write_bytes(content[:-100])
    result = download("own", root=here, mirror=server.url, subset="train")
    assert result.kept == (0, 1)
    assert not result.complete
    assert result.dataset_sha256 is None
    manifest = lagbench.load_manifest("own", root=here)
    assert not manifest.complete
    assert [entry.scenario for entry in manifest.files] == [0, 1, 2]


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ("flipped", objects.WrongContentError),
        ("shorter", objects.WrongContentError),
        ("longer", DataError),
        ("a page", objects.WrongContentError),
        ("gone", objects.NotInStoreError),
    ],
)
def test_wrong_objects_are_refused(
    store: Store,
    here: Path,
    original: LocalSplit,
    change: str,
    error: type[LagbenchError],
) -> None:
    """The error is a DataError that names the address; no file of it is left, other
    files come.
    """
    name = f"own/full/v1/{FIRST}"
    good = store.read(name)
    changed = {
        "flipped": good[:-500] + bytes([good[-500] ^ 1]) + good[-499:],
        "shorter": good[:-1],
        "longer": good + b"\0",
        "a page": b"<html>log in</html>".ljust(len(good)),
    }
    if change == "gone":
        store.remove(name)
    else:
        store.put(name, changed[change])
    with pytest.raises(error) as caught:
        download("own", root=here, mirror=store.url, connections=1, or_generate=False)
    assert caught.value.exit_code == 4
    assert caught.value.where == f"{store.url}/{name}"
    assert not [name for name in left(here) if name == "0000.nc" or "partial" in name]
    store.put(name, good)
    assert download("own", root=here, mirror=store.url).complete


def test_another_data_set_is_refused_before_files_are_fetched(
    store: Store, here: Path
) -> None:
    """So it is with a store whose manifest has other content hashes, or is no
    manifest.
    """
    np.save(
        here / "runs.npy", np.stack(straight_runs(4, frames=12, particles=400, seed=9))
    )
    other = adopt(
        here / "runs.npy",
        output=here / "other" / "own",
        radius=0.1,
        frame_interval=0.1,
        axes="trajectory,frame,particle,space",
    )
    of_another = (other.folder / "full/v1/manifest.json").read_bytes()
    for text, error in (
        (of_another, objects.WrongContentError),
        (b'{"format": 1}', objects.WrongContentError),
    ):
        store.put("own/full/v1/manifest.json", text)
        with pytest.raises(error) as caught:
            download("own", root=here, mirror=store.url)
        assert str(caught.value.where).startswith(
            f"{store.url}/own/full/v1/manifest.json"
        )
        assert left(here / "own") == set()


def test_a_busy_server_is_asked_again(server: Mirror, here: Path) -> None:
    server.faults = {FIRST: "busy once"}
    assert download("own", root=here, mirror=server.url).complete


def test_a_line_that_stays_broken_is_given_up(server: Mirror, here: Path) -> None:
    server.faults = {FIRST: "drops always"}
    with pytest.raises(objects.StoreUnreachableError) as caught:
        download("own", root=here, mirror=server.url, scenarios="0", or_generate=False)
    assert caught.value.where == f"{server.url}/own/full/v1/{FIRST}"
    assert server.count(FIRST) == objects.ATTEMPTS


@pytest.mark.slow
def test_simulated_splits_come_from_a_store_or_are_simulated(
    generated: GenerationResult, tmp_path: Path
) -> None:
    """Files that a store has not are simulated: the data set is that of datasets.yaml
    all the same.
    """
    told: list[str] = []
    where = {"root": tmp_path, "workers": 1, "announce": told.append}
    with serving(generated.root) as running:
        running.faults = {"0003.nc": "gone"}
        result = download("curl-noise", "tiny", mirror=running.url, **where)
    assert result.downloaded == (0, 1, 2, 4)
    assert result.generated == (3,)
    assert result.verdict == "equal to datasets.yaml"
    assert result.dataset_sha256 == generated.dataset_sha256
    (one,) = told
    assert f"{running.url}/curl-noise/tiny/v2/test/0003.nc" in one
    assert lagbench.verify("curl-noise", "tiny", root=tmp_path).warnings == ()
