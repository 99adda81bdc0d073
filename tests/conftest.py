"""Fixtures that several test modules share."""

from __future__ import annotations

import functools
import gc
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, browser
from exchange_readers import straight_runs
from filelock import FileLock
from hypothesis import settings
from score_bench import ScoreBench, bench_of
from typer.main import get_command
from typer.testing import CliRunner, Result

from lagbench.__main__ import app
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import dataset_folder
from lagbench.data.registry import Registry, Size, default_path, load
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.make import painting
from lagbench.make.card_files import PICTURES
from lagbench.make.generate import GenerationResult, generate
from lagbench.metrics.aggregate import Tally
from lagbench.scoring import score as scored
from lagbench.scoring.scenario import ScenarioScores
from lagbench.scoring.score_file import SubmissionStatistics, read_statistics
from lagbench.scoring.score_file_checks import (
    MAX_SCORE_BYTES,
    ScoreFile,
    read_score_file,
)
from lagbench.scoring.task import ScoredTask
from lagbench.submission import ValidationResult
from lagbench.submission.format import FileInfo
from lagbench.submission.validation import validate
from lagbench.work.pool import Pool
from lagbench.work.progress import Meter
from lagbench.work.run import ONE_THREAD

# The same code gives the same verdict: what Hypothesis finds by chance is to be found
# by whoever caused it. Seeded examples are the same ones every time, and the later ones
# are variations of the first.
settings.register_profile("seeded", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("seeded")

# Each process would compile torch anew, in 7 s, and every run all that the tests
# import, in 15 s.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    sys.pycache_prefix = sys.pycache_prefix or str(
        Path(__file__).parents[1] / "build" / "bytecode"
    )
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    sys.dont_write_bytecode = False

SCORE_SCENARIOS = scored.score_scenarios
PAINT = painting.paint_pictures
Names = tuple[str, ...]
READERS = (
    "build",
    "folder_checks",
    "identity",
    "publish",
    "ranking",
    "rescoring",
    "seeds",
)

SPLIT = "curl-noise"
SIZE = "tiny"
"""The quickest data set to generate: five scenarios of 312 substeps."""


def pytest_collection_finish() -> None:
    """Leave what the imports made out of every search for garbage: some 700,000
    objects.
    """
    gc.collect()
    gc.freeze()


def pytest_sessionfinish() -> None:
    """Have Taichi keep what it compiled, which it does only where no solver is left as
    the process ends.
    """
    if (taichi := sys.modules.get("taichi")) is not None:
        with suppress(
            Exception
        ):  # a cache that cannot be written costs the next run a compilation
            taichi.reset()
    if (
        sys.pycache_prefix is not None
    ):  # of modules that lay in temporary folders, each time another
        shutil.rmtree(sys.pycache_prefix + tempfile.gettempdir(), ignore_errors=True)


@pytest.fixture(scope="session", autouse=True)
def lasting_workers() -> Iterator[None]:
    """Simulate in one worker that outlives a generation, unless it is left at work:
    Taichi starts in seconds.

    Generations that are killed or counted are started by their tests as processes of
    their own.
    """
    held: dict[object, Pool] = {}

    @contextmanager
    def lasting(_: int, __: Mapping[str, str] | None = None) -> Iterator[Pool]:
        # A simulation is told all else that it reads, its folder and registry too.
        inherited = sorted(
            (k, v) for k, v in os.environ.items() if k.startswith(("PYTHON", "TI_"))
        )
        key = tuple(sys.path), tuple(inherited)
        if key not in held:
            held[key] = stack.enter_context(Pool(1, ONE_THREAD))
        pool = held[key]
        try:
            yield pool
        finally:
            if pool._queue or any(worker.attempt for worker in pool._workers):
                held.pop(key).close()

    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        for module in ("generate", "verify"):
            patch.setattr(f"lagbench.make.{module}.Pool", lasting)
        yield


@pytest.fixture(scope="session")
def running() -> Iterator[Browser]:
    """One browser for all tests."""
    with browser() as started:
        yield started


@pytest.fixture(scope="session", autouse=True)
def quick(home: Path) -> Iterator[None]:
    """Keep out of the user's cache, and do without what takes long and has tests of its
    own.
    """

    def validated(
        path: str | Path, *, isolated: bool = True, **options: Any
    ) -> ValidationResult:
        """Validate without the child that looks at predictions first."""
        assert isolated
        return validate(path, isolated=False, **options)

    def draw(root: Path, size: Size, *_: object) -> None:
        """Leave the pictures of cards blank: to draw them takes longer than to generate
        tiny data.
        """
        for name in PICTURES:
            path = dataset_folder(root, size.split, size.name, size.major) / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"")

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LAGBENCH_CACHE", str(home / "cache"))
        for module in ("scoring.score", "board.submit"):
            patch.setattr(f"lagbench.{module}.validate", validated)
        patch.setattr(painting, "paint_pictures", draw)
        # Commands are built from their signatures once, not at every call, which may
        # take less.
        patch.setattr("typer.testing._get_command", functools.cache(get_command))
        yield


@pytest.fixture(scope="session", autouse=True)
def references_once() -> Iterator[None]:
    """Measure the floors of a data set once, unless by workers: they are most of what a
    score costs.
    """
    known: dict[Hashable, dict[int, dict[str, Tally]]] = {}

    def score_once(
        task: ScoredTask,
        path: Path,
        info: FileInfo,
        *,
        metrics: Names,
        references: Names,
        workers: int | None,
        scheduler: str | None,
        meter: Meter,
    ) -> list[ScenarioScores]:
        score_rows = functools.partial(
            SCORE_SCENARIOS,
            task,
            path,
            info,
            metrics=metrics,
            workers=workers,
            scheduler=scheduler,
            meter=meter,
        )
        if not references or scheduler is not None or (workers or 1) > 1:
            return score_rows(references=references)

        files = sorted(task.truth.path(task.scenarios[0]).parents[1].rglob("*.nc"))
        hashes = [file_sha256(file) for file in files]
        key = (metrics, references, repr((task.size, task.config)), *hashes)
        if key in known:
            outcomes = score_rows(references=())
        else:
            outcomes = score_rows(references=references)
            known[key] = {
                outcome.scenario: {name: outcome.tallies[name] for name in references}
                for outcome in outcomes
            }

        completed = []
        for outcome in outcomes:
            tallies = {**outcome.tallies, **known[key][outcome.scenario]}
            completed.append(replace(outcome, tallies=tallies))
        return completed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lagbench.scoring.score.score_scenarios", score_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def stored_once() -> Iterator[None]:
    """Read score files of equal bytes once: commands read all of a board's, several
    times.
    """
    known: dict[Hashable, ScoreFile] = {}

    @functools.cache
    def statistics(_: str, path: Path) -> SubmissionStatistics:
        stored = read_statistics(path)
        # no test of tables adds metrics
        object.__setattr__(stored, "scores", functools.cache(stored.scores))
        return stored

    def read(path: Path, size: Size | None = None) -> ScoreFile:
        if (
            path.is_symlink()
            or not path.is_file()
            or path.stat().st_size > MAX_SCORE_BYTES
        ):
            return read_score_file(path, size)
        key = file_sha256(path), size and repr(size)
        if key not in known:
            known[key] = read_score_file(path, size)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in READERS:
            patch.setattr(f"lagbench.board.{module}.read_score_file", read)
        reader = "studies.thesis.split_results.read_statistics"
        patch.setattr(reader, lambda path: statistics(file_sha256(path), path))
        yield


@pytest.fixture
def as_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take what is above back for one test: workers of its own, the child, floors,
    files, pictures.
    """
    for module in ("make.generate", "make.verify"):
        monkeypatch.setattr(f"lagbench.{module}.Pool", Pool)
    for module in ("scoring.score", "board.submit"):
        monkeypatch.setattr(f"lagbench.{module}.validate", validate)
    for module in READERS:
        monkeypatch.setattr(f"lagbench.board.{module}.read_score_file", read_score_file)
    monkeypatch.setattr("lagbench.scoring.score.score_scenarios", SCORE_SCENARIOS)
    monkeypatch.setattr(painting, "paint_pictures", PAINT)


@pytest.fixture(scope="session")
def unmeasured_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of datasets.yaml without its measured block, so that tests hold before and
    after a record.
    """
    path = tmp_path_factory.mktemp("registry") / "datasets.yaml"
    path.write_text(default_path().read_text().split("\nmeasured:")[0] + "\n")
    return path


@pytest.fixture(scope="session")
def unmeasured(unmeasured_path: Path) -> Registry:
    """Our splits without hashes to compare with."""
    return load(unmeasured_path)


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that all processes of a test run share; take a FileLock for what is
    made there once.
    """
    own = tmp_path_factory.getbasetemp()
    # Under pytest-xdist each process has a folder of its own in one that all share.
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def tiny_split(home: Path) -> Callable[..., GenerationResult]:
    """A function that generates the tiny data of a split once for all tests; do not
    change the files.
    """

    def made(split: str, name: str = "tiny", **options: Any) -> GenerationResult:
        root = home / f"{name}-{split}"
        told = root.with_suffix(".pickle")
        with FileLock(root.with_suffix(".lock")):
            if not told.exists():
                told.write_bytes(
                    pickle.dumps(generate(split, SIZE, root=root, **options))
                )
        found: GenerationResult = pickle.loads(told.read_bytes())
        return found

    return made


@pytest.fixture(scope="session")
def generated(
    tiny_split: Callable[..., GenerationResult], unmeasured: Registry
) -> GenerationResult:
    """The tiny curl-noise data, generated once and compared with no hash."""
    return tiny_split(SPLIT, "generated", workers=2, registry=unmeasured)


@pytest.fixture(scope="session")
def bench(generated: GenerationResult, unmeasured: Registry) -> ScoreBench:
    """The same data for the scorer: two test scenarios of 20 predicted frames."""
    return bench_of(generated, unmeasured)


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, unmeasured_path: Path
) -> Callable[..., Result]:
    """A function that runs lagbench with our splits and no recorded hashes."""
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(unmeasured_path))
    monkeypatch.delenv("LAGBENCH_DEBUG", raising=False)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Path]]:
    """A function that installs a package of another author: group of its entry point,
    the object, its source.

    It returns the module's file, which is there only where a source is given.
    """
    modules: list[str] = []

    def call(
        group: str, value: str, source: str | None = None, *, name: str = "mine"
    ) -> Path:
        module = value.partition(":")[0]
        about = tmp_path / f"{name}-1.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n"
        )
        (about / "entry_points.txt").write_text(
            f"[lagbench.{group}]\n{name} = {value}\n"
        )
        if source is not None:
            (tmp_path / f"{module}.py").write_text(source)
            modules.append(module)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delenv("LAGBENCH_DEBUG", raising=False)
        return tmp_path / f"{module}.py"

    yield call
    for module in modules:
        sys.modules.pop(module, None)


@pytest.fixture
def copied(generated: GenerationResult, tmp_path: Path) -> Callable[[], Path]:
    """A function that copies the generated data set to a root folder that a test may
    damage.
    """
    return lambda: shutil.copytree(generated.root, tmp_path / "root")


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The URL of a bucket of an S3 server in this process."""
    from object_stores import s3_server  # its libraries take a second to load

    with s3_server() as url:
        yield url


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """A data set of four files of about 40 kB."""
    folder = tmp_path_factory.mktemp("original")
    np.save(folder / "runs.npy", np.stack(straight_runs(4, frames=12, particles=400)))
    return adopt(
        folder / "runs.npy",
        output=folder / "root" / "own",
        radius=0.1,
        frame_interval=0.1,
    )


@pytest.fixture
def here(original: LocalSplit, tmp_path: Path) -> Path:
    """A root folder that knows the data set by its description alone."""
    (tmp_path / "own").mkdir()
    shutil.copy(original.folder / "split.yaml", tmp_path / "own")
    return tmp_path
