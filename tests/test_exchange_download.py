"""Downloads from a mirror that works, breaks, and lies: right files, or an error by name and nothing else."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from exchange_readers import straight_runs
from lying_server import Mirror, serving
from typer.testing import CliRunner

import lagbench
from lagbench.cli.app import app
from lagbench.errors import LagbenchError, UsageError
from lagbench.exchange import adopt, download
from lagbench.exchange.local_split import LocalSplit
from lagbench.make.generate import GenerationResult
from lagbench.store import mirror, mirror_errors

FIRST = "train/0000.nc"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not pause between attempts."""
    monkeypatch.setattr(mirror, "PAUSE", 0.0)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A data set of four files of about 40 kB."""
    folder = tmp_path_factory.mktemp("original")
    np.save(folder / "runs.npy", np.stack(straight_runs(4, frames=12, particles=400)))
    return adopt(folder / "runs.npy", output=folder / "own", radius=0.1, frame_interval=0.1)


@pytest.fixture
def server(original: LocalSplit) -> Iterator[Mirror]:
    """A mirror of it."""
    with serving(original.folder.parent) as running:
        yield running


@pytest.fixture
def here(original: LocalSplit, tmp_path: Path) -> Path:
    """A root folder that knows the data set by its description alone."""
    (tmp_path / "own").mkdir()
    shutil.copy(original.folder / "split.yaml", tmp_path / "own")
    return tmp_path


def left(root: Path) -> set[str]:
    """Return the names of all files below a root folder but description and locks."""
    found = {path.name for path in root.rglob("*") if path.is_file()}
    return {name for name in found if name != "split.yaml" and not name.startswith(".lock")}


def test_all_files_come_and_are_right(server: Mirror, here: Path, original: LocalSplit) -> None:
    """The data set is complete, has its hash, and equals the original; nothing temporary is left."""
    result = download("own", root=here, mirror=server.url + "/")
    assert (result.downloaded, result.kept, result.generated) == ((0, 1, 2, 3), (), ())
    assert result.complete
    assert result.dataset_sha256 == original.dataset_sha256
    assert left(here) == {"0000.nc", "0001.nc", "0002.nc", "0003.nc", "manifest.json"}
    assert lagbench.verify("own", root=here, complete=True).warnings == ()
    with lagbench.open_split("own", root=here) as one, lagbench.open_split(str(original.folder)) as two:
        np.testing.assert_array_equal(one["position"].values, two["position"].values)


def test_what_is_there_is_kept(server: Mirror, here: Path) -> None:
    """A second download asks for what is missing or damaged, and for nothing else."""
    download("own", root=here, mirror=server.url, subset="train")
    server.asked.clear()
    train = here / "own/full/v1/train"
    (train / "0000.nc").write_bytes((train / "0001.nc").read_bytes())
    result = download("own", root=here, mirror=server.url, subset="train,valid")
    assert (result.downloaded, result.kept) == ((0, 2), (1,))
    assert server.count("0001.nc") == 0
    assert not result.complete


@pytest.mark.parametrize("fault", ["drops", "no ranges", "busy once", "wrong range"])
def test_a_bad_line_costs_time_only(server: Mirror, here: Path, fault: str) -> None:
    """Broken connections are taken up by range, or from the start where the mirror knows no ranges."""
    server.faults = {FIRST: fault}
    result = download("own", root=here, mirror=server.url)
    assert result.complete
    ranges = [wanted for path, wanted in server.asked if path.endswith(FIRST)]
    if fault == "drops":
        assert len(ranges) == 3
        assert ranges[0] is None
        whole = (here / "own/full/v1" / FIRST).stat().st_size
        assert ranges[1:] == [f"bytes={whole // 3}-", f"bytes={2 * (whole // 3)}-"]


def test_an_interrupted_download_goes_on(server: Mirror, here: Path) -> None:
    """What came before the connection was lost is not asked for again by the next command."""
    server.faults = {FIRST: "drops"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mirror, "MOST_ATTEMPTS", 1)
        with pytest.raises(mirror_errors.ConnectionLostError):
            download("own", root=here, mirror=server.url, scenarios="0", or_generate=False)
    server.faults, server.asked = {}, []
    assert not (here / "own/full/v1" / FIRST).exists()
    result = download("own", root=here, mirror=server.url, scenarios="0")
    assert result.downloaded == (0,)
    third = (here / "own/full/v1" / FIRST).stat().st_size // 3
    assert server.asked[-1] == (f"/own/full/v1/{FIRST}", f"bytes={third}-")


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("page", mirror_errors.NotDataError),
        ("hidden page", mirror_errors.NotDataError),
        ("announces more", mirror_errors.WrongLengthError),
        ("announces less", mirror_errors.WrongLengthError),
        ("chopped", mirror_errors.WrongLengthError),
        ("ends early", mirror_errors.TruncatedError),
        ("endless", mirror_errors.WrongLengthError),
        ("flipped", mirror_errors.WrongContentError),
    ],
)
def test_each_lie_has_its_error_and_leaves_nothing(
    server: Mirror, here: Path, fault: str, error: type[LagbenchError]
) -> None:
    """No file of that name, no temporary one; the message names the address; other files stay right."""
    server.faults = {FIRST: fault}
    with pytest.raises(error) as caught:
        download("own", root=here, mirror=server.url, connections=1)
    assert type(caught.value) is error
    assert caught.value.where == f"{server.url}/own/full/v1/{FIRST}"
    assert caught.value.exit_code == 4
    assert not left(here) & {"0000.nc"}
    assert not [name for name in left(here) if "partial" in name]
    server.faults = {}
    assert download("own", root=here, mirror=server.url).complete


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("announces more", mirror_errors.TruncatedError),
        ("announces less", mirror_errors.WrongContentError),
        ("chopped", mirror_errors.WrongContentError),
        ("endless", mirror_errors.WrongLengthError),
    ],
)
def test_lies_are_found_without_a_manifest(
    server: Mirror, here: Path, fault: str, error: type[LagbenchError]
) -> None:
    """Where the mirror has no manifest, lengths are not known, but content is."""
    server.faults = {FIRST: fault, "manifest.json": "gone"}
    with pytest.raises(error):
        download("own", root=here, mirror=server.url, scenarios="0")
    assert left(here) == set()


@pytest.mark.parametrize("fault", ["page", "hidden page"])
def test_a_page_as_manifest(server: Mirror, here: Path, fault: str) -> None:
    """A login page in place of the manifest is told before any file is asked for."""
    server.faults = {"manifest.json": fault}
    with pytest.raises(mirror_errors.NotDataError, match=r"manifest\.json"):
        download("own", root=here, mirror=server.url)
    assert server.count(".nc") == 0


def test_another_data_set_is_told_at_once(server: Mirror, here: Path, original: LocalSplit) -> None:
    """A mirror whose manifest has other content hashes is refused before any file is asked for."""
    np.save(here / "runs.npy", np.stack(straight_runs(4, frames=12, particles=400, seed=9)))
    other = adopt(here / "runs.npy", output=here / "other" / "own", radius=0.1, frame_interval=0.1)
    with (
        serving(other.folder.parent) as wrong,
        pytest.raises(mirror_errors.WrongContentError, match="another"),
    ):
        download("own", root=here, mirror=wrong.url)
    assert left(here / "own") == set()


def test_a_line_that_stays_broken(server: Mirror, here: Path) -> None:
    """A connection that brings nothing five times is given up, with an error of the work, not of the data."""
    server.faults = {FIRST: "drops always"}
    with pytest.raises(LagbenchError) as caught:
        download("own", root=here, mirror=server.url, scenarios="0")
    assert isinstance(caught.value, mirror_errors.ConnectionLostError | mirror_errors.TruncatedError)
    assert server.count(FIRST) == mirror.ATTEMPTS


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("gone", mirror_errors.NotOnMirrorError),
        ("busy", mirror_errors.MirrorUnreachableError),
        ("forbidden", mirror_errors.MirrorUnreachableError),
    ],
)
def test_no_generate_stops_where_the_mirror_does(
    server: Mirror, here: Path, fault: str, error: type[LagbenchError]
) -> None:
    """What the mirror has not, or does not give, is an error when nothing may be simulated."""
    server.faults = {FIRST: fault}
    with pytest.raises(error):
        download("own", root=here, mirror=server.url, or_generate=False)
    assert "0000.nc" not in left(here)


def test_no_mirror_at_all(here: Path) -> None:
    """Without a mirror there is nothing to download; a local split cannot be simulated either."""
    with pytest.raises(UsageError, match="no mirror is known"):
        download("own", root=here, or_generate=False)
    with pytest.raises(UsageError, match="cannot be simulated"):
        download("own", root=here)


def test_nobody_answers(here: Path) -> None:
    """A port that nobody listens on is an unreachable mirror."""
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{reserved.getsockname()[1]}"
        with pytest.raises(mirror_errors.MirrorUnreachableError, match="does not answer"):
            download("own", root=here, mirror=address, or_generate=False)


def test_simulated_splits_come_from_a_mirror_or_are_simulated(
    generated: GenerationResult, tmp_path: Path
) -> None:
    """Files that a mirror has not are simulated: the data set is that of datasets.yaml all the same."""
    told: list[str] = []
    with serving(generated.root) as running:
        running.faults = {"0003.nc": "gone"}
        result = download(
            "curl-noise", "tiny", mirror=running.url, root=tmp_path, workers=1, announce=told.append
        )
    assert result.downloaded == (0, 1, 2, 4)
    assert result.generated == (3,)
    assert result.verdict == "equal to datasets.yaml"
    assert result.dataset_sha256 == generated.dataset_sha256
    assert len(told) == 1
    assert told[0].startswith("the mirror does not have the file")
    assert told[0].endswith("simulating scenarios 3")
    assert lagbench.verify("curl-noise", "tiny", root=tmp_path).warnings == ()


def test_other_addresses(original: LocalSplit, here: Path) -> None:
    """A folder of this machine serves as a mirror too, by its file address."""
    result = download("own", root=here, mirror=original.folder.parent.as_uri())
    assert result.dataset_sha256 == original.dataset_sha256
    shutil.rmtree(here / "own" / "full")
    with pytest.raises(UsageError, match="kind of address"):
        download("own", root=here, mirror="carrier-pigeon://roof")


def test_a_redirection_stays_on_the_web(server: Mirror, here: Path) -> None:
    """A mirror cannot send us to a file of this machine."""
    server.faults = {FIRST: "elsewhere"}
    with pytest.raises(mirror_errors.MirrorUnreachableError, match="not allowed"):
        download("own", root=here, mirror=server.url, or_generate=False)


def test_command(server: Mirror, here: Path) -> None:
    """`lagbench download` says what came from where; a lie is exit code 4."""
    arguments = ["download", "--split", str(here / "own"), "--from", server.url]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "4 downloaded, 0 simulated, 0 kept" in done.stdout
    again = CliRunner().invoke(app, arguments)
    assert "0 downloaded, 0 simulated, 4 kept" in again.stdout
    server.faults = {"0003.nc": "page"}
    (here / "own/full/v1/test/0003.nc").unlink()
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 4
    assert "something else than data" in refused.output
