"""Fixtures that several test modules share."""

from __future__ import annotations

import functools
import gc
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from command_line import CliRunner, Result
from filelock import FileLock
from hypothesis import settings
from registry_text import described_splits
from score_bench import ScoreBench, bench_of
from trajectories import straight_runs
from turns import leave_out_slow_tests

from lagbench.cli.program import app
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import PICTURES
from lagbench.data.registry import Registry, Size, load
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.make import cards
from lagbench.make.generate import GenerationResult, generate
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.metric import Metric
from lagbench.scoring import score as scorer
from lagbench.scoring.score import ScenarioScores
from lagbench.scoring.task import ScoredTask
from lagbench.work.engine import ENGINES
from lagbench.work.run import Meter

if TYPE_CHECKING:
    from model_board import ModelBoard

# Hypothesis draws the same examples every time: a failure appears to whoever caused it,
# not by chance to somebody else.
settings.register_profile("seeded", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("seeded")

Names = tuple[str, ...]

# Each process would compile torch anew, in 7 s, and every run all that the tests
# import, in 15 s.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    sys.pycache_prefix = sys.pycache_prefix or str(
        Path(__file__).parents[1] / "build" / "bytecode"
    )
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    sys.dont_write_bytecode = False

# Tests import studies, validation and benchmarks from the clone, and lagbench as it is
# installed.
sys.path.append(str(Path(__file__).parents[1]))

SPLIT = "curl-noise"
SIZE = "tiny"
"""The quickest data set to generate: five scenarios of 312 substeps."""

# The parts that session fixtures exchange below, as they ship.
SCORE_SCENARIOS = scorer.score_scenarios
PAINT_PICTURES = cards.paint_pictures
SCENARIO_SCORER = "lagbench.scoring.score.score_scenarios"
PICTURE_PAINTER = "lagbench.make.cards.paint_pictures"


def pytest_collectstart() -> None:
    """Search for no garbage while modules are imported.

    The imports make some 700,000 objects, and nearly all of them stay.
    """
    gc.disable()


def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Leave out the slow tests whose turn it is not."""
    leave_out_slow_tests(config, items)


def pytest_collection_finish() -> None:
    """Leave what the imports made out of every later search for garbage."""
    if "taichi" in sys.modules:
        shorten_compilation()
    gc.collect()
    gc.freeze()
    gc.enable()


def shorten_compilation() -> None:
    """Have Taichi compile in three quarters of the time.

    For each expression of a kernel Taichi draws the line of the source with a mark
    under it, for errors. Here the number of the line is enough. The source of a
    function is looked up once, not for each of its calls.
    """
    from taichi.lang import kernel_impl
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

    def name_line(context: Any, node: Any) -> str:
        line = node.lineno + context.lineno_offset
        return f'File "{context.file}", line {line}:\n'

    ASTTransformerContext.get_pos_info = name_line
    kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)
    kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)


def pytest_sessionfinish() -> None:
    """Have the engine keep the kernels that it compiled.

    It keeps them only where no solver is left as the process ends.
    """
    for name in ENGINES:
        engine = sys.modules.get(name)
        if engine is not None:
            # A cache that cannot be written costs the next run a compilation.
            with suppress(Exception):
                engine.reset()
    if sys.pycache_prefix is not None:
        # The bytecode of modules in temporary folders is never read again.
        temporary_modules = sys.pycache_prefix + tempfile.gettempdir()
        shutil.rmtree(temporary_modules, ignore_errors=True)


@pytest.fixture(scope="session", autouse=True)
def no_flushes() -> Iterator[None]:
    """Leave it to the operating system when files go to the disk.

    For speed: each file that appears whole or not at all waits for the disk twice. That
    matters where a machine loses its power, which no test does.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture
def home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A home folder of the user; the working folder is another one.

    Nothing appears in the working folder, least of all a folder named ~.
    """
    folder = tmp_path / "home"
    working_folder = tmp_path / "here"
    folder.mkdir()
    working_folder.mkdir()
    monkeypatch.chdir(working_folder)
    monkeypatch.setenv("HOME", str(folder))
    yield folder
    assert list(working_folder.iterdir()) == []


@pytest.fixture(scope="session", autouse=True)
def own_cache(home: Path) -> Iterator[None]:
    """Keep out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LAGBENCH_CACHE", str(home / "cache"))
        yield


@pytest.fixture(scope="session", autouse=True)
def blank_pictures() -> Iterator[None]:
    """Leave the pictures of cards blank.

    For speed: to paint them takes longer than to generate tiny data.
    tests/test_figures/test_cards.py paints them.
    """

    def write_blank_pictures(root: Path, size: Size, *_: object) -> None:
        for name in PICTURES:
            path = size.folder(root) / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PICTURE_PAINTER, write_blank_pictures)
        yield


@pytest.fixture(scope="session", autouse=True)
def references_once() -> Iterator[None]:
    """Measure the reference predictors of a data set once, unless by workers.

    For speed: they take most of the time of a score.
    """
    reference_tallies: dict[Hashable, dict[int, dict[str, Tally]]] = {}

    def score_once(
        task: ScoredTask,
        *,
        metrics: tuple[Metric, ...],
        predictions: Path,
        references: Names,
        workers: int | None,
        scheduler: str | None,
        meter: Meter,
    ) -> list[ScenarioScores]:
        score_rows = functools.partial(
            SCORE_SCENARIOS,
            task,
            metrics=metrics,
            predictions=predictions,
            workers=workers,
            scheduler=scheduler,
            meter=meter,
        )
        if not references or scheduler is not None or (workers or 1) > 1:
            return score_rows(references=references)

        dataset = task.truth.path(task.scenarios[0]).parents[1]
        hashes = [file_sha256(file) for file in sorted(dataset.rglob("*.nc"))]
        key = (metrics, references, repr((task.size, task.config)), *hashes)
        if key in reference_tallies:
            outcomes = score_rows(references=())
        else:
            outcomes = score_rows(references=references)
            reference_tallies[key] = {}
            for outcome in outcomes:
                tallies = {name: outcome.tallies[name] for name in references}
                reference_tallies[key][outcome.scenario] = tallies

        completed = []
        for outcome in outcomes:
            tallies = {**outcome.tallies, **reference_tallies[key][outcome.scenario]}
            completed.append(replace(outcome, tallies=tallies))
        return completed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SCENARIO_SCORER, score_once)
        yield


@pytest.fixture
def as_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the exchanges above back for one test.

    It gets reference predictors and pictures of its own.
    """
    monkeypatch.setattr(SCENARIO_SCORER, SCORE_SCENARIOS)
    monkeypatch.setattr(PICTURE_PAINTER, PAINT_PICTURES)


@pytest.fixture(scope="session")
def unmeasured_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of datasets.yaml without its measured block.

    Tests that use it hold before and after hashes are recorded.
    """
    path = tmp_path_factory.mktemp("registry") / "datasets.yaml"
    path.write_text(described_splits())
    return path


@pytest.fixture(scope="session")
def unmeasured(unmeasured_path: Path) -> Registry:
    """Our splits without hashes to compare with."""
    return load(unmeasured_path)


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that all processes of a test run share.

    Take a FileLock for files that are made there once.
    """
    process_folder = tmp_path_factory.getbasetemp()
    # Under pytest-xdist each process has a folder of its own in one that all share.
    if "PYTEST_XDIST_WORKER" in os.environ:
        return process_folder.parent
    return process_folder


@pytest.fixture(scope="session")
def tiny_split(home: Path) -> Callable[..., GenerationResult]:
    """A function that generates the tiny data of a split once for all tests.

    Do not change the files.
    """

    def generate_once(
        split: str, name: str = "tiny", **options: Any
    ) -> GenerationResult:
        root = home / f"{name}-{split}"
        stored_result = root.with_suffix(".pickle")
        with FileLock(root.with_suffix(".lock")):
            if not stored_result.exists():
                new_result = generate(split, SIZE, root=root, **options)
                stored_result.write_bytes(pickle.dumps(new_result))
        result: GenerationResult = pickle.loads(stored_result.read_bytes())
        return result

    return generate_once


@pytest.fixture(scope="session")
def generated(
    tiny_split: Callable[..., GenerationResult], unmeasured: Registry
) -> GenerationResult:
    """The tiny curl-noise data, generated once and compared with no hash."""
    return tiny_split(SPLIT, "generated", workers=2, registry=unmeasured)


@pytest.fixture(scope="session")
def model_board(home: Path, generated: GenerationResult) -> ModelBoard:
    """A leaderboard with an entry whose weights lie beside it.

    Do not change the files.
    """
    from model_board import make_bench

    folder = home / "model-board"
    with FileLock(folder.with_suffix(".lock")):
        return make_bench(folder, generated.root)


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

    def run_command(*words: object) -> Result:
        return CliRunner().invoke(app, words)

    return run_command


@pytest.fixture
def package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Path]]:
    """A function that installs a package of another author.

    It takes the group of the entry point, the object and the source of its module. It
    returns the module's file, which is there only where a source is given.
    """
    modules: list[str] = []

    def install_package(
        group: str, value: str, source: str | None = None, *, name: str = "mine"
    ) -> Path:
        metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n"
        entry_points = f"[lagbench.{group}]\n{name} = {value}\n"
        dist_info = tmp_path / f"{name}-1.dist-info"
        dist_info.mkdir()
        (dist_info / "METADATA").write_text(metadata)
        (dist_info / "entry_points.txt").write_text(entry_points)

        module = value.partition(":")[0]
        module_file = tmp_path / f"{module}.py"
        if source is not None:
            module_file.write_text(source)
            modules.append(module)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delenv("LAGBENCH_DEBUG", raising=False)
        return module_file

    yield install_package
    for module in modules:
        sys.modules.pop(module, None)


@pytest.fixture
def copied(generated: GenerationResult, tmp_path: Path) -> Callable[[], Path]:
    """A function that copies the generated data to a root that a test may damage."""
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
    runs = straight_runs(4, frames=12, particles=400)
    np.save(folder / "runs.npy", np.stack(runs))
    return adopt(
        folder / "runs.npy",
        output=folder / "root" / "own",
        radius=0.1,
        frame_interval=0.1,
        axes="trajectory,frame,particle,space",
    )


@pytest.fixture
def here(original: LocalSplit, tmp_path: Path) -> Path:
    """A root folder that knows the data set by its description alone."""
    (tmp_path / "own").mkdir()
    shutil.copy(original.folder / "split.yaml", tmp_path / "own")
    return tmp_path
