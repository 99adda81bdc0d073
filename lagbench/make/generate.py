"""Generate a data set: simulate what is missing, crash-safe, resumable, on all cores.

A scenario's file appears whole or not at all, and the manifest is brought up to date
after each, so that an interrupted generation goes on where it stopped and ends with the
same bytes as an uninterrupted one.

The parent process plans, hands scenarios to workers and keeps the manifest; it never
draws or simulates, so that Ctrl-C reaches it at once and a crash of the solver cannot
take it along.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from lagbench.atomic import remove_leftovers
from lagbench.data.checksums import round_digits
from lagbench.data.layout import MANIFEST_NAME, expand_path, format_ids, url_of
from lagbench.data.local import locate_new, root_url
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    describe_file,
    merge_entries,
    read_or_empty,
    record_entry_hashes,
    write_manifest,
)
from lagbench.data.registry import Registry, Size, Split
from lagbench.data.statistics import file_moments, statistics
from lagbench.errors import UsageError, check_installed, suggest_name
from lagbench.generators.batch import (
    SimulationJob,
    perturbed_substep_count,
)
from lagbench.generators.simulate import (
    SimulatedScenario,
    measure_predictability,
    simulate,
)
from lagbench.generators.split import Device
from lagbench.store.copy import gather as gather_files
from lagbench.store.copy import list_scenarios_to_gather
from lagbench.store.publication import Publication, check_address, publish
from lagbench.work.cluster import Cluster, await_file
from lagbench.work.machine import describe_machine, promises_bits, worker_count
from lagbench.work.pool import Event, Pool, Report, WorkItem
from lagbench.work.run import ONE_THREAD, Meter, Progress, read_many

from .cards import card_texts, write_cards
from .inventory import (
    compare_hashes,
    has_all_statistics,
    inspect_scenario,
    run_inspection,
)
from .plan import (
    Estimate,
    Scenarios,
    Selection,
    check_disk,
    estimate,
    free_bytes,
    select,
)

Job = TypeVar("Job")
Result = TypeVar("Result")

# particles that a parallel device advances together at the most
BATCH_PARTICLES = 1 << 19


@dataclass(frozen=True, kw_only=True)
class GenerationResult:
    """What a generation did, or would do."""

    split: str  # name of the split
    size: str  # name of the size
    version: str  # semantic version
    root: Path  # folder of all data sets
    folder: Path  # folder of this one
    device: str  # where the solver ran
    workers: int  # worker processes
    simulated: tuple[int, ...]  # ids that were (dry run: would be) simulated
    # ids whose files were there and right (dry run: or would be gathered)
    kept: tuple[int, ...]
    missing: tuple[int, ...]  # ids of the size that are still not there
    bytes_needed: int  # disk space of 'simulated' before compression [bytes]
    bytes_free: int  # free disk space before the start [bytes]
    seconds_expected: float  # expected time [s], for orientation
    seconds: float = 0.0  # time that it took [s]
    complete: bool = False  # whether train, valid and test are all there
    dataset_sha256: str | None = None  # data set hash, once complete
    verdict: str = ""  # how the hashes compare with datasets.yaml, in words
    dry_run: bool = False  # whether nothing was done


def generate(
    split: str | Path,
    size: str | None = None,
    *,
    subset: Selection = None,
    scenarios: Scenarios = None,
    root: str | Path | None = None,
    workers: int | None = None,
    device: str = "cpu",
    scheduler: str | None = None,
    gather: Sequence[str | Path] = (),
    force: bool = False,
    dry_run: bool = False,
    progress: Callable[[Progress], None] | None = None,
    on_wait: Callable[[str], None] | None = None,
    registry: Registry | None = None,
) -> GenerationResult:
    """Simulate the scenarios of a split that are not on disk yet, and check their
    hashes.

    Args:
        split: name of the split.
        size: name of the size; mini when None, or the only one that the split has.
        subset: some subsets only.
        scenarios: some ids only, as numbers or as text such as "0,3-5".
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder. With a URL (``s3://bucket/prefix``) files are written to its working
            copy and put into the store, see docs/scaling.md.
        workers: worker processes; one per core, or one for the parallel devices.
        device: "cpu", "parallel" or "cuda". "cpu" and "parallel" give the same bits,
            "cuda" gives others.
        scheduler: address of a Dask scheduler whose workers simulate instead; they must
            see the root folder under the same path.
        gather: other root folders, from which finished scenarios are taken first.
        force: simulate scenarios again even if their files are there and correct.
        dry_run: only say what it would take.
        progress: called as the work advances.
        on_wait: called with the holder in words when another process holds the lock.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset, scenario or device, fewer than one
            worker, or Taichi is not installed; or nothing can be gathered from a
            folder.
        WorkFailedError: disk full or not writable, a scenario cannot be drawn or blew
            up, workers keep dying, the cluster is lost or does not see the root folder;
            or the store refuses or does not answer.
        DataError: the result has other hashes than datasets.yaml, or there is no such
            bucket.
    """
    started = time.monotonic()
    address = root_url(root)
    if address is not None:
        check_address(address)
    tier, data_root, rooted_registry = locate_new(
        split, size, root=root, registry=registry
    )
    wanted_ids = select(tier, subset=subset, scenarios=scenarios)
    target = _find_device(device)
    cores = worker_count(workers, default=None if target is Device.CPU else 1)
    bytes_free = free_bytes(tier.folder(data_root))
    setup = _Setup(
        size=tier,
        split=rooted_registry.split(tier.split),
        root=data_root,
        device=target,
        workers=cores,
        scheduler=scheduler,
        meter=Meter(progress),
    )
    sources = [expand_path(source, "--gather") for source in gather]

    if dry_run:
        scan = _plan_only(setup, wanted_ids, sources, force=force)
        manifest = scan.manifest
        verdict = ""
    else:
        if scheduler is None:
            check_installed("taichi", extra="generate")
        with (
            dataset_lock(data_root, tier.split, tier.name, tier.major, on_wait=on_wait),
            _open_store(setup) as store,
        ):
            keeper = _ManifestKeeper(setup, store)
            scan = _simulate_missing(setup, keeper, wanted_ids, sources, force=force)
            _complete_statistics(setup, keeper)
            manifest = keeper.manifest
            verdict = compare_hashes(tier, manifest, promised=keeper.promised)
            _describe(setup, store, manifest)

    missing_ids = []
    for scenario in tier.scenarios:
        if not manifest.entry(scenario) and scenario not in scan.kept:
            missing_ids.append(scenario)
    return GenerationResult(
        split=tier.split,
        size=tier.name,
        version=tier.version,
        root=data_root,
        folder=setup.folder,
        device=target.value,
        workers=cores,
        simulated=scan.to_do.scenarios,
        kept=scan.kept,
        missing=tuple(missing_ids),
        bytes_needed=scan.to_do.bytes,
        bytes_free=bytes_free,
        seconds_expected=scan.to_do.seconds(cores),
        seconds=time.monotonic() - started,
        complete=manifest.complete,
        dataset_sha256=manifest.dataset_sha256,
        verdict=verdict,
        dry_run=dry_run,
    )


def _find_device(name: str) -> Device:
    names = list(map(str, Device))
    if name not in names:
        raise UsageError(
            f"no device {name!r}: expected {', '.join(names)}; "
            f"{suggest_name(name, names)}",
            where="--device",
        )
    return Device(name)


@dataclass(frozen=True, kw_only=True)
class _Setup:
    """What a generation makes, where, and with what."""

    size: Size  # tier to generate
    split: Split  # split that it belongs to
    root: Path  # folder of all data sets
    device: Device  # where the solver runs
    workers: int  # worker processes
    scheduler: str | None  # Dask scheduler whose workers simulate; None: here
    meter: Meter  # counts the work

    @property
    def folder(self) -> Path:
        """Folder of the data set."""
        return self.size.folder(self.root)

    def path(self, scenario: int) -> Path:
        """Return the file of a scenario."""
        return self.size.path(self.root, scenario)

    def read_files(
        self,
        function: Callable[[Job, Report], Result],
        jobs: Mapping[str, Job],
        files: Iterable[Path],
    ) -> list[Result]:
        """Run a function that reads files, here or by the workers; the meter counts
        files.
        """

        def count(done: int) -> None:
            self.meter.count(done, scenarios=done)

        return read_many(
            function, jobs, files, count, workers=self.workers, scheduler=self.scheduler
        )


@dataclass(frozen=True, kw_only=True)
class _Scan:
    """What a data set folder holds, and what is left to do."""

    manifest: Manifest  # of the files that are there and right
    hashed: tuple[FileEntry, ...]  # files that were inspected and are right
    kept: tuple[int, ...]  # chosen ids whose files are there and right
    to_do: Estimate  # chosen ids to simulate, and what that takes


class _ManifestKeeper:
    """Writes the manifest of a folder whenever it changes; the store follows."""

    def __init__(self, setup: _Setup, store: Publication | None) -> None:
        self._setup = setup
        # the store that the root folder is a working copy of; None if plain
        self.store = store
        self.manifest = read_or_empty(setup.size, setup.root)
        # ids that were simulated on machines that promise equal bits
        self.promised: list[int] = []

    def keep(self, manifest: Manifest) -> None:
        """Write a manifest, but no empty one where there is none yet."""
        self.manifest = manifest
        if manifest.files or (self._setup.folder / MANIFEST_NAME).exists():
            write_manifest(self._setup.root, manifest)
            if self.store:
                self.store.put_files(manifest)

    def add(
        self,
        entries: Iterable[FileEntry],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Put entries in, and the machine that wrote their files."""
        self.keep(merge_entries(self._setup.size, self.manifest, entries, environment))

    def fetch(self, scenarios: Iterable[int]) -> None:
        """Have files of scenarios here that only the store holds."""
        if self.store:
            self.store.fetch(scenarios)


def _open_store(setup: _Setup) -> AbstractContextManager[Publication | None]:
    """Return the store that the root folder is a working copy of; None if plain."""
    url = url_of(setup.root)
    if url is None:
        return nullcontext()
    return publish(setup.size, setup.root, url)


def _plan_only(
    setup: _Setup, wanted_ids: Sequence[int], sources: Sequence[Path], *, force: bool
) -> _Scan:
    """Scan a folder as if the sources were gathered; change nothing."""
    gathered: set[int] = set()
    for source in sources:
        gathered.update(list_scenarios_to_gather(setup.size, setup.root, source))
    store = None
    url = url_of(setup.root)
    if url is not None:
        store = Publication(setup.size, setup.root, url)
    return _scan_folder(setup, store, wanted_ids, force=force, gathered=gathered)


def _simulate_missing(
    setup: _Setup,
    keeper: _ManifestKeeper,
    wanted_ids: Sequence[int],
    sources: Sequence[Path],
    *,
    force: bool,
) -> _Scan:
    """Gather, scan, and simulate what is missing or wrong; return the scan before."""
    remove_leftovers(setup.folder)
    for source in sources:
        old = read_or_empty(setup.size, setup.root)
        keeper.keep(gather_files(setup.size, setup.root, source, old))

    scan = _scan_folder(setup, keeper.store, wanted_ids, force=force)
    record_entry_hashes(setup.folder, scan.hashed)
    check_disk(setup.root, scan.to_do.bytes)
    keeper.keep(scan.manifest)
    try:
        _simulate(setup, keeper, scan)
    finally:
        # The workers are gone by now; what they had not finished goes too.
        remove_leftovers(setup.folder)
    return scan


def _scan_folder(
    setup: _Setup,
    store: Publication | None,
    wanted_ids: Sequence[int],
    *,
    force: bool,
    gathered: Collection[int] | None = None,
) -> _Scan:
    """Find the files that are right, and which wanted ids must be simulated.

    Nothing is written. ``gathered`` is given in a dry run: the ids that gathering would
    bring. They count as right, and hashes of the manifest are trusted.
    """
    size = setup.size
    old = read_or_empty(size, setup.root)
    stored: Mapping[int, FileEntry] = {}
    if store:
        stored = store.stored_entries
    # All wanted ids that no store holds, and every file that the manifest belies.
    inspected_ids = _ids_to_inspect(setup, old, stored, wanted_ids)
    inspected_count = len(inspected_ids)
    setup.meter.begin("checking", total=inspected_count, scenarios=inspected_count)
    inspections = {}
    for scenario in inspected_ids:
        inspections[f"scenario {scenario}"] = partial(
            inspect_scenario,
            setup.root,
            size,
            scenario,
            manifest=old.only(scenario),
            quick=True,
            trusting=gathered is not None,
        )
    paths = map(setup.path, inspected_ids)
    results = setup.read_files(run_inspection, inspections, paths)

    hashed = []
    bad_ids = set(inspected_ids)  # until an inspection proves a file right
    for result in results:
        if result.entry:
            hashed.append(result.entry)
            bad_ids.discard(result.scenario)
    old_entries = []
    for entry in old.files:
        if entry.scenario not in bad_ids:
            old_entries.append(entry)
    base = old.model_copy(update={"files": tuple(old_entries)})

    kept_ids = []
    missing_ids = []
    for scenario in wanted_ids:
        is_there = scenario not in bad_ids or scenario in (gathered or ())
        if is_there and not force:
            kept_ids.append(scenario)
        else:
            missing_ids.append(scenario)
    return _Scan(
        manifest=merge_entries(size, base, [*hashed, *stored.values()]),
        hashed=tuple(hashed),
        kept=tuple(kept_ids),
        to_do=estimate(size, missing_ids),
    )


def _ids_to_inspect(
    setup: _Setup,
    old: Manifest,
    stored: Collection[int],
    wanted_ids: Sequence[int],
) -> list[int]:
    """Return the ids whose files must be read before anything is simulated.

    These are the wanted ids, and the ids whose file has appeared, has vanished, or has
    changed its length since the manifest was written. Files in the store are right, so
    their ids are left out.
    """
    stated_lengths = {}
    for entry in old.files:
        stated_lengths[entry.scenario] = entry.bytes
    ids = []
    for scenario in setup.size.scenarios:
        if scenario in stored:
            continue
        length = None
        path = setup.path(scenario)
        if path.exists():
            length = path.stat().st_size
        has_changed = length != stated_lengths.get(scenario)
        if scenario in wanted_ids or has_changed:
            ids.append(scenario)
    return ids


def _simulate(setup: _Setup, keeper: _ManifestKeeper, scan: _Scan) -> None:
    """Run everything that is to do in workers, and perturbed runs of test scenarios."""
    size = setup.size
    test_ids = size.subsets.get("test", ())
    # files that are right and have no predictability limit yet
    unlimited_ids = []
    for entry in keeper.manifest.files:
        is_kept_test = entry.scenario in test_ids and entry.scenario in scan.kept
        if is_kept_test and not entry.twin_floor:
            unlimited_ids.append(entry.scenario)
    keeper.fetch(unlimited_ids)

    tasks = _simulation_tasks(setup, scan.to_do)
    for scenario in unlimited_ids:
        tasks.append(_perturbation_task(setup, scenario))
    if not tasks:
        return

    total = 0
    for task in tasks:
        total += round(task.cost)
    for scenario in scan.to_do.scenarios:
        if scenario in test_ids:
            total += perturbed_substep_count(size, scenario)
    scenario_count = len(scan.to_do.scenarios)
    setup.meter.begin("simulating", total=total, scenarios=scenario_count)

    with _open_team(setup, len(tasks)) as team:
        for task in tasks:
            team.submit(task)
        for event in team.events():
            if event.kind == "progress":
                setup.meter.count(event.value)
            elif event.kind == "lost":
                setup.meter.count(-event.value)
            elif event.item.function is measure_predictability:
                _add_limits(keeper, event.value)
            else:
                _add_simulated(setup, keeper, event)
                for simulated in event.value:
                    if simulated.scenario in test_ids:
                        task = _perturbation_task(setup, simulated.scenario)
                        team.submit(task)


def _open_team(setup: _Setup, task_count: int) -> Pool | Cluster:
    """Return the workers, here or of a Dask scheduler, to be used with ``with``."""
    if setup.scheduler is not None:
        return Cluster(setup.scheduler, folder=setup.folder)
    environment: Mapping[str, str] = {}
    if setup.device is Device.CPU:
        environment = ONE_THREAD
    return Pool(min(setup.workers, task_count), environment)


def _simulation_tasks(setup: _Setup, to_do: Estimate) -> list[WorkItem]:
    """Return a task per batch; scenarios of similar length share a batch."""
    costs = dict(zip(to_do.scenarios, to_do.substeps, strict=True))
    longest_first = sorted(costs, key=lambda scenario: (-costs[scenario], scenario))
    width = 1
    if setup.device is not Device.CPU:
        width = max(1, BATCH_PARTICLES // setup.size.particles)

    tasks = []
    for start in range(0, len(longest_first), width):
        ids = tuple(longest_first[start : start + width])
        cost = sum(costs[scenario] for scenario in ids)
        name = f"scenario {format_ids(ids)}"
        tasks.append(_task(setup, name, function=simulate, ids=ids, cost=cost))
    return tasks


def _perturbation_task(setup: _Setup, scenario: int) -> WorkItem:
    return _task(
        setup,
        f"perturbed run of scenario {scenario}",
        function=measure_predictability,
        ids=(scenario,),
        cost=perturbed_substep_count(setup.size, scenario),
    )


def _task(
    setup: _Setup,
    name: str,
    *,
    function: Callable[..., Any],
    ids: tuple[int, ...],
    cost: float,
) -> WorkItem:
    size = setup.size
    job = SimulationJob(size=size, scenarios=ids, root=setup.root, device=setup.device)
    full_name = f"{size.split} {size.name}, {name}"
    return WorkItem(name=full_name, function=function, arguments=(job,), cost=cost)


def _add_simulated(setup: _Setup, keeper: _ManifestKeeper, event: Event) -> None:
    """Put scenarios that a worker has simulated into the manifest."""
    simulated: Sequence[SimulatedScenario] = event.value
    machine = event.machine or describe_machine(setup.device)
    environment = {**machine, "device": setup.device.value}
    is_promised = promises_bits(environment)
    for result in simulated:
        if is_promised:
            keeper.promised.append(result.scenario)
        if setup.scheduler is not None:
            await_file(setup.path(result.scenario))
    entries = []
    for result in simulated:
        entries.append(describe_file(setup.root, setup.size.key(result.scenario)))
    record_entry_hashes(setup.folder, entries)
    keeper.add(entries, environment)
    setup.meter.count(scenarios=len(entries))


def _add_limits(keeper: _ManifestKeeper, limits: Mapping[int, Sequence[float]]) -> None:
    """Put predictability limits into the entries of their scenarios."""
    entries = []
    for entry in keeper.manifest.files:
        if entry.scenario in limits:
            rounded = tuple(map(round_digits, limits[entry.scenario]))
            entries.append(entry.model_copy(update={"twin_floor": rounded}))
    keeper.add(entries)


def _complete_statistics(setup: _Setup, keeper: _ManifestKeeper) -> None:
    """Put the statistics of train into the manifest, once train is complete."""
    manifest = keeper.manifest
    measured = setup.size.measured
    # Statistics of other bits differ from datasets.yaml by right.
    is_doubted = (
        measured is not None
        and manifest.identity == "bitwise"
        and manifest.statistics != measured.statistics
    )
    is_needed = is_doubted or not has_all_statistics(manifest, setup.size)
    if "train" in manifest.subset_sha256 and is_needed:
        train_ids = setup.size.subsets["train"]
        keeper.fetch(train_ids)
        setup.meter.begin("statistics", total=len(train_ids), scenarios=len(train_ids))
        paths = {}
        for i in train_ids:
            paths[f"scenario {i}"] = setup.path(i)
        read_moments = partial(file_moments, box=setup.size.box)
        moments = setup.read_files(read_moments, paths, paths.values())
        manifest = manifest.model_copy(update={"statistics": statistics(moments)})
    keeper.keep(manifest)


def _describe(setup: _Setup, store: Publication | None, manifest: Manifest) -> None:
    """Write the cards, and bring the store to the state of the folder.

    Scenarios of a blind test have no card: it would say how to make the public ones.
    """
    size = setup.size
    if size.draw_seed is not None:
        return
    setup.meter.begin("cards", total=1, scenarios=len(manifest.files))
    if store is None:
        write_cards(setup.root, size, setup.split, manifest)
        return

    if store.is_settled(manifest, card_texts(size, setup.split, manifest)):
        return
    store.fetch(size.scenarios)
    cards = write_cards(setup.root, size, setup.split, manifest)
    store.finish(manifest, cards)
