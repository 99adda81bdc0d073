"""Downloads from stores that work, break, and lie: right files, or an error by name and
nothing else.
"""

from __future__ import annotations

import gc
import shutil
import socket
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import CliRunner
from conftest import SIZE, SPLIT
from faulty_server import Mirror, serving
from numpy.testing import assert_array_equal
from object_stores import Store, holding
from trajectories import straight_runs

import lagbench
from lagbench.cli.program import app
from lagbench.errors import LagbenchError, UsageError, WorkFailedError
from lagbench.exchange import adopt, download
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.store import fetch, objects
from lagbench.work.run import Progress

FIRST = "train/0000.nc"
LIST = "manifest.json"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not pause between attempts."""
    monkeypatch.setattr(fetch, "PAUSE", 0.0)


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


def test_the_manifest_keeps_files_that_are_packed_anew(
    server: Mirror, here: Path
) -> None:
    """Another length does not make a file wrong; its values count."""
    before = download("own", root=here, mirror=server.url)
    path = here / "own/full/v1/test/0003.nc"
    # HDF5 ignores what follows the file that its header describes.
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content + bytes(8))
    result = download("own", root=here, mirror=server.url, subset="train")
    assert result.complete
    assert result.dataset_sha256 == before.dataset_sha256
    entry = lagbench.load_manifest("own", root=here).entry(3)
    assert entry is not None
    assert entry.bytes == len(content) + 8


def test_the_card_forgets_files_that_are_gone(
    generated: GenerationResult, copied: Callable[[], Path]
) -> None:
    """It states the content hash of each scenario that the manifest names."""
    root = copied()
    manifest = lagbench.load_manifest(SPLIT, SIZE, root=root)
    entry = manifest.entry(3)
    assert entry is not None
    folder = generated.folder.relative_to(generated.root)
    card = root / folder / "README.md"
    assert entry.content_sha256 in card.read_text()
    (root / folder / entry.path).unlink()
    with serving(generated.root) as running:
        result = download(SPLIT, SIZE, root=root, mirror=running.url, subset="train")
    assert result.downloaded == ()
    assert entry.content_sha256 not in card.read_text()


def test_the_manifest_forgets_all_files_where_all_are_gone(
    server: Mirror, here: Path
) -> None:
    """A store that has nothing cannot bring them back."""
    assert download("own", root=here, mirror=server.url).complete
    for path in here.rglob("*.nc"):
        path.unlink()
    server.faults = {".nc": "gone", ".json": "gone"}
    with pytest.raises(objects.NotInStoreError):
        download("own", root=here, mirror=server.url, or_generate=False)
    manifest = lagbench.load_manifest("own", root=here)
    assert not manifest.complete
    assert manifest.files == ()


def test_half_a_file_is_completed(
    store: Store, here: Path, original: LocalSplit
) -> None:
    """The part that an interrupted call left under its temporary name is not requested
    again.
    """
    whole = (original.folder / "full/v1" / FIRST).read_bytes()
    half = fetch.partial_name(here / "own/full/v1" / FIRST)
    half.parent.mkdir(parents=True)
    third = len(whole) // 3
    half.write_bytes(whole[:third])
    result = download("own", root=here, mirror=store.url, scenarios="0")
    assert result.bytes == len(whole) - third
    if store.server:
        assert (
            f"/own/full/v1/{FIRST}",
            f"bytes={len(whole) // 3}-",
        ) in store.server.asked
    assert (here / "own/full/v1" / FIRST).read_bytes() == whole


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_part_of_other_content_is_fetched_anew(
    store: Store, here: Path, original: LocalSplit, share: float
) -> None:
    """The store may have replaced the object, or the machine may have crashed."""
    whole = (original.folder / "full/v1" / FIRST).read_bytes()
    part = fetch.partial_name(here / "own/full/v1" / FIRST)
    part.parent.mkdir(parents=True)
    part.write_bytes(whole[:8] + bytes(round(share * len(whole)) - 8))
    result = download("own", root=here, mirror=store.url, scenarios="0")
    assert result.downloaded == (0,)
    assert (here / "own/full/v1" / FIRST).read_bytes() == whole


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ("flipped", objects.WrongContentError),
        ("shorter", objects.WrongLengthError),
        ("longer", objects.WrongLengthError),
        ("a page", objects.NotDataError),
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
    assert type(caught.value) is error
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
        (b'{"format": 1}', objects.NotDataError),
    ):
        store.put("own/full/v1/manifest.json", text)
        with pytest.raises(error) as caught:
            download("own", root=here, mirror=store.url)
        assert str(caught.value.where).startswith(
            f"{store.url}/own/full/v1/manifest.json"
        )
        assert left(here / "own") == set()


@pytest.mark.parametrize(
    "fault",
    [
        "drops",
        "no ranges",
        "busy once",
        "wrong range",
        "announces a number without end",
    ],
)
def test_a_bad_line_costs_time_only(server: Mirror, here: Path, fault: str) -> None:
    """Broken connections are taken up by range, or from the start where the server
    knows no ranges.
    """
    server.faults = {FIRST: fault}
    assert download("own", root=here, mirror=server.url).complete
    ranges = [wanted for path, wanted in server.asked if path.endswith(FIRST)]
    if fault == "drops":
        third = (here / "own/full/v1" / FIRST).stat().st_size // 3
        assert ranges == [None, f"bytes={third}-", f"bytes={2 * third}-"]


@pytest.mark.parametrize("fault", ["drops", "no ranges", "busy once"])
def test_bytes_that_are_thrown_away_are_no_progress(
    server: Mirror, here: Path, fault: str
) -> None:
    """A server without ranges starts over, and sends the first part again."""
    server.faults = {FIRST: fault}
    states: list[Progress] = []
    result = download("own", root=here, mirror=server.url, progress=states.append)
    length = sum(path.stat().st_size for path in here.rglob("*.nc"))
    assert result.bytes == length
    assert states[-1].done == states[-1].total == length
    assert all(0 <= state.done <= length for state in states)


@pytest.mark.parametrize("has_manifest", [True, False])
def test_progress_in_three_dimensions_has_the_true_total_or_none(
    tmp_path: Path, has_manifest: bool
) -> None:
    """A store without a manifest states no lengths before it sends a file."""
    rng = np.random.default_rng(0)
    runs = 0.4 + 0.2 * rng.random((3, 40, 500, 3))
    np.save(tmp_path / "runs.npy", runs.astype(np.float32))
    own = adopt(
        tmp_path / "runs.npy",
        output=tmp_path / "source" / "own",
        radius=0.1,
        spacing=0.05,
        frame_interval=0.1,
        axes="trajectory,frame,particle,space",
    )
    root = tmp_path / "root"
    (root / "own").mkdir(parents=True)
    shutil.copy(own.folder / "split.yaml", root / "own")
    states: list[Progress] = []
    with serving(tmp_path / "source") as running:
        if not has_manifest:
            running.faults = {LIST: "gone"}
        result = download("own", root=root, mirror=running.url, progress=states.append)
    last = states[-1]
    assert last.scenarios_done == last.scenarios == 3
    assert last.done == result.bytes
    assert last.total == (result.bytes if has_manifest else 0)


def test_a_part_that_is_fetched_anew_is_counted_once(
    server: Mirror, here: Path, original: LocalSplit
) -> None:
    """Its rest had arrived before the whole was found to be wrong."""
    whole = (original.folder / "full/v1" / FIRST).read_bytes()
    part = fetch.partial_name(here / "own/full/v1" / FIRST)
    part.parent.mkdir(parents=True)
    half = len(whole) // 2
    part.write_bytes(whole[:8] + bytes(half - 8))
    states: list[Progress] = []
    result = download(
        "own",
        root=here,
        mirror=server.url,
        scenarios="0",
        progress=states.append,
    )
    assert max(state.done for state in states) == len(whole)
    assert result.bytes == states[-1].done == len(whole)


@pytest.mark.parametrize(
    ("faults", "error"),
    [
        *(
            ({FIRST: fault}, objects.NotDataError)
            for fault in ("page", "hidden page", "nowhere", "other kind")
        ),
        *(
            ({FIRST: fault}, objects.WrongLengthError)
            for fault in ("announces more", "announces less")
        ),
        *(
            ({FIRST: fault}, objects.WrongLengthError)
            for fault in ("chopped", "endless")
        ),
        ({FIRST: "ends early"}, objects.TruncatedError),
        ({FIRST: "flipped"}, objects.WrongContentError),
        # where the store has no manifest lengths are not known, but content is
        ({FIRST: "announces more", LIST: "gone"}, objects.TruncatedError),
        ({FIRST: "announces less", LIST: "gone"}, objects.WrongContentError),
        ({FIRST: "chopped", LIST: "gone"}, objects.WrongContentError),
        ({FIRST: "endless", LIST: "gone"}, objects.WrongLengthError),
        # a login page in place of the manifest is told before any file is asked for
        *(({LIST: fault}, objects.NotDataError) for fault in ("page", "hidden page")),
    ],
)
def test_each_lie_has_its_error_and_leaves_nothing(
    server: Mirror,
    here: Path,
    faults: dict[str, str],
    error: type[LagbenchError],
) -> None:
    """No file of that name, no temporary one; the message names the address; other
    files stay right.
    """
    server.faults = faults
    with pytest.raises(error) as caught:
        download("own", root=here, mirror=server.url, connections=1)
    assert type(caught.value) is error
    assert caught.value.exit_code == 4
    assert caught.value.where == f"{server.url}/own/full/v1/{next(iter(faults))}"
    assert not [name for name in left(here) if name == "0000.nc" or "partial" in name]
    assert FIRST in faults or server.count(".nc") == 0
    server.faults = {}
    assert download("own", root=here, mirror=server.url).complete


@pytest.mark.parametrize("fault", ["nowhere", "other kind"])
def test_a_refused_redirection_leaves_no_connection(
    server: Mirror, here: Path, fault: str
) -> None:
    """Python warns of a connection that nobody closed."""
    server.faults = {FIRST: fault}
    gc.collect()  # what other tests left
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pytest.raises(objects.NotDataError):
            download("own", root=here, mirror=server.url, connections=1)
        gc.collect()
    leaks = [item for item in caught if item.category is ResourceWarning]
    assert leaks == []


@pytest.mark.parametrize(
    ("fault", "useful"), [("drops always", 0), ("drops and starts over", 1)]
)
def test_a_line_that_stays_broken(
    server: Mirror,
    here: Path,
    fault: str,
    useful: int,
) -> None:
    """A connection that brings it no further five times is given up, with an error that
    names the address.
    """
    server.faults = {FIRST: fault}
    with pytest.raises((objects.ConnectionLostError, objects.TruncatedError)) as caught:
        download("own", root=here, mirror=server.url, scenarios="0")
    assert caught.value.where == f"{server.url}/own/full/v1/{FIRST}"
    assert server.count(FIRST) == fetch.ATTEMPTS + useful


@pytest.mark.parametrize(
    ("name", "fault"), [(LIST, "slow"), (FIRST, "slow"), (FIRST, "drops")]
)
def test_an_interrupted_download_goes_on(
    server: Mirror,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    fault: str,
) -> None:
    """The next command does not request the bytes again that came before the connection
    ended. A hundred bytes a second are below the least rate.
    """
    monkeypatch.setattr(fetch, "RATE_SECONDS", 0.3)
    monkeypatch.setattr(fetch, "MOST_ATTEMPTS", 1)
    server.faults = {name: fault}
    with pytest.raises(
        objects.TooSlowError if fault == "slow" else objects.ConnectionLostError
    ) as caught:
        download("own", root=here, mirror=server.url, scenarios="0", or_generate=False)
    assert caught.value.exit_code == 5
    assert caught.value.where == f"{server.url}/own/full/v1/{name}"
    assert not (here / "own/full/v1" / FIRST).exists()
    server.faults = {}
    result = download("own", root=here, mirror=server.url, scenarios="0")
    whole = (here / "own/full/v1" / FIRST).stat().st_size
    assert result.downloaded == (0,)
    assert result.bytes == whole if name == LIST else 0 < result.bytes < whole
    if fault == "drops":
        assert server.asked[-1] == (f"/own/full/v1/{FIRST}", f"bytes={whole // 3}-")


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("gone", objects.NotInStoreError),
        # a redirection elsewhere leads to no file of this machine
        *(
            (fault, objects.StoreUnreachableError)
            for fault in ("busy", "forbidden", "elsewhere")
        ),
    ],
)
def test_no_generate_stops_where_the_store_does(
    server: Mirror,
    here: Path,
    fault: str,
    error: type[LagbenchError],
) -> None:
    """What the store has not, or does not give, is an error when nothing may be
    simulated.
    """
    server.faults = {FIRST: fault}
    with pytest.raises(error):
        download("own", root=here, mirror=server.url, or_generate=False)
    assert "0000.nc" not in left(here)


def test_a_folder_in_the_place_of_a_file_is_named(store: Store, here: Path) -> None:
    place = here / "own/full/v1" / FIRST
    place.mkdir(parents=True)
    with pytest.raises(WorkFailedError) as caught:
        download("own", root=here, mirror=store.url, or_generate=False)
    assert str(place.parent) in str(caught.value.where)


def test_no_store_at_all(here: Path) -> None:
    """There is nothing to download, and nothing to simulate; a port that nobody listens
    on is unreachable.
    """
    for or_generate in (False, True):
        with pytest.raises(UsageError):
            download("own", root=here, or_generate=or_generate)
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{reserved.getsockname()[1]}"
        with pytest.raises(objects.StoreUnreachableError) as caught:
            download("own", root=here, mirror=address, or_generate=False)
    assert str(caught.value.where).startswith(address)


@pytest.mark.parametrize(
    "address",
    [
        "http://[::1",
        "http://host:abc/data",
        "http://exa mple/data",
        "http:///data",
        "http://0x7f.1/data",
        "http://2130706433/data",
        "http://127.1/data",
        "http://a..b/",
        "http://127.0.0.1:abc/x",
        "http://127.0.0.1:99999/x",
        "s3://",
        "s3:///prefix",
        "file://",
    ],
)
def test_what_is_no_address(here: Path, address: str) -> None:
    """The error comes at once, is a usage error, and shows the typed text."""
    with pytest.raises(UsageError) as caught:
        download("own", root=here, mirror=address, or_generate=False)
    assert str(caught.value.where).startswith(address)


@pytest.mark.parametrize(
    "address",
    [
        "nowhere",
        "",
        "htp://host/data",
        "http:///data",
        "http://127.0.0.1:99999/x",
        "s3://",
        "file://",
    ],
)
def test_an_invalid_address_is_refused_even_where_no_file_is_missing(
    address: str, generated: GenerationResult, tmp_path: Path
) -> None:
    """Neither data that are there nor a simulation hide the mistake."""
    for root in (generated.root, tmp_path):
        with pytest.raises(UsageError):
            download(SPLIT, SIZE, root=root, mirror=address)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["store", "my store", "100%", "a#b", "caf\u00e9"])
def test_the_message_shows_the_address_of_a_folder(
    name: str, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The address is that of a store: its objects are those of the folder."""
    monkeypatch.chdir(tmp_path)
    data = tmp_path / name / "data"
    data.mkdir(parents=True)
    (data / "manifest.json").write_bytes(b"{}")
    with pytest.raises(UsageError) as caught:
        download("own", root=here, mirror=name)
    address = f"file://{tmp_path / name}"
    assert address in str(caught.value.fix)
    assert objects.Objects(address, "data").sizes() == {"manifest.json": 2}


def test_addresses_are_percent_encoded(server: Mirror, here: Path) -> None:
    """A folder may have any name; an encoded address is requested as it is."""
    for typed, asked in (("\u20ac x", "%E2%82%AC%20x"), ("%E2%82%AC", "%E2%82%AC")):
        with pytest.raises(objects.NotInStoreError):
            download(
                "own",
                root=here,
                mirror=f"{server.url}/{typed}",
                or_generate=False,
            )
        assert server.asked.pop()[0].startswith(f"/{asked}/own/full/v1/")


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


def test_the_download_command_counts_files_by_origin(
    server: Mirror, here: Path
) -> None:
    """`lagbench download` says what came from where; a lie is exit code 4."""
    arguments = ["download", "--split", str(here / "own"), "--from", server.url]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "4 downloaded, 0 simulated, 0 kept" in done.stdout
    again = CliRunner().invoke(app, arguments)
    assert "0 downloaded, 0 simulated, 4 kept" in again.stdout
    server.faults = {"0003.nc": "page"}
    (here / "own/full/v1/test/0003.nc").unlink()
    assert CliRunner().invoke(app, arguments).exit_code == 4
