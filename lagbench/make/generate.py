"""Generate a data set: simulate what is missing, crash-safe, resumable, on all cores.

A scenario's file appears whole or not at all, and the manifest is brought up to date
after each, so that an interrupted generation goes on where it stopped and ends with the
same bytes as an uninterrupted one.

The parent process plans, hands scenarios to workers and keeps the manifest; it never
draws or simulates, so that Ctrl-C reaches it at once and a crash of the solver cannot
take it along.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

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
from lagbench.errors import (
    UsageError,
    WorkFailedError,
    suggest_name,
)
from lagbench.generators.batch import (
    SimulationJob,
    perturbed_substep_count,
    substep_count,
)
from lagbench.generators.simulate import measure_predictability, simulate
from lagbench.generators.split import Device
from lagbench.store.copy import Publication, publish
from lagbench.store.copy import gather as gather_files
from lagbench.store.objects import Objects
from lagbench.work.engine import find_engine
from lagbench.work.executor import (
    ONE_THREAD,
    Finished,
    Report,
    WorkItem,
    run_items,
)
from lagbench.work.machine import promises_bits, worker_count
from lagbench.work.run import Meter, Progress, read_many

from .cards import write_cards
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

FILE_SECONDS = 30.0
"""How long a file of another machine may take to appear [s]."""


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
    kept: tuple[int, ...]  # ids whose files were there and right
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
        gather: other root folders, from which finished scenarios are taken first; not
            in a dry run.
        dry_run: only say what it would take.
        progress: called as the work advances.
        on_wait: called with the holder in words when another process holds the lock.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset, scenario or device, fewer than one
            worker, or no engine is installed; or nothing can be gathered from a
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
        Objects(address, "")  # refuses an address where nothing can be written
    tier, data_root, rooted_registry = locate_new(
        split, size, root=root, registry=registry
    )
    wanted_ids = select(tier, subset=subset, scenarios=scenarios)
    devices = list(map(str, Device))
    if device not in devices:
        raise UsageError(
            f"no device {device!r}; {suggest_name(device, devices)}", where="--device"
        )
    target = Device(device)
    cores = worker_count(workers, default=None if target is Device.CPU else 1)
    bytes_free = free_bytes(tier.folder(data_root))
    url = url_of(data_root)
    campaign = _Campaign(
        size=tier,
        split=rooted_registry.split(tier.split),
        root=data_root,
        device=target,
        workers=cores,
        scheduler=scheduler,
        meter=Meter(progress),
        store=None,
    )
    if dry_run:
        if url is not None:
            campaign.store = Publication(tier, data_root, url)
        scan = _scan_folder(campaign, wanted_ids)
        manifest = scan.manifest
        verdict = ""
    else:
        if scheduler is None:
            find_engine()
        with (
            dataset_lock(data_root, tier.split, tier.name, tier.major, on_wait=on_wait),
            nullcontext() if url is None else publish(tier, data_root, url) as store,
        ):
            campaign.store = store
            campaign.manifest = read_or_empty(tier, data_root)
            if store is not None:
                campaign.manifest = store.join(campaign.manifest)
            remove_leftovers(campaign.folder)
            for source in gather:
                folder = expand_path(source, "--gather")
                campaign.keep(gather_files(tier, data_root, folder, campaign.manifest))
            scan = _scan_folder(campaign, wanted_ids)
            record_entry_hashes(campaign.folder, scan.hashed)
            check_disk(data_root, scan.to_do.bytes)
            campaign.keep(scan.manifest)
            try:
                _simulate(campaign, scan)
            finally:
                # The workers are gone by now; what they had not finished goes too.
                remove_leftovers(campaign.folder)
            _complete_statistics(campaign)
            manifest = campaign.manifest
            verdict = compare_hashes(tier, manifest, promised=campaign.promised)
            # Scenarios of a blind test have no card: it would say how to make the
            # public ones.
            has_all = (
                store is not None and not scan.to_do.scenarios and store.has_card()
            )
            if tier.draw_seed is None and not has_all:
                campaign.meter.begin("cards", total=1, scenarios=len(manifest.files))
                campaign.fetch(tier.scenarios)
                cards = write_cards(data_root, tier, campaign.split, manifest)
                if store is not None:
                    store.put_files(manifest, cards)

    missing_ids = []
    for scenario in tier.scenarios:
        if not manifest.entry(scenario) and scenario not in scan.kept:
            missing_ids.append(scenario)
    return GenerationResult(
        split=tier.split,
        size=tier.name,
        version=tier.version,
        root=data_root,
        folder=campaign.folder,
        device=target.value,
        workers=cores,
        simulated=scan.to_do.scenarios,
        kept=scan.kept,
        missing=tuple(missing_ids),
        bytes_needed=scan.to_do.bytes,
        bytes_free=bytes_free,
        seconds_expected=scan.to_do.core_seconds / cores,
        seconds=time.monotonic() - started,
        complete=manifest.complete,
        dataset_sha256=manifest.dataset_sha256,
        verdict=verdict,
        dry_run=dry_run,
    )


@dataclass(kw_only=True)
class _Campaign:
    """What a generation makes, where, and with what; it keeps the manifest."""

    size: Size  # tier to generate
    split: Split  # split that it belongs to
    root: Path  # folder of all data sets
    device: Device  # where the solver runs
    workers: int  # worker processes
    scheduler: str | None  # Dask scheduler whose workers simulate; None: here
    meter: Meter  # counts the work
    # the store that the root folder is a working copy of; None if plain
    store: Publication | None
    # ids that were simulated on machines that promise equal bits
    promised: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Read the manifest."""
        self.folder = self.size.folder(self.root)  # of the data set
        self.manifest = read_or_empty(self.size, self.root)

    def path(self, scenario: int) -> Path:
        """Return the file of a scenario."""
        return self.size.path(self.root, scenario)

    def keep(self, manifest: Manifest) -> None:
        """Write a manifest, but no empty one where there is none yet."""
        self.manifest = manifest
        if manifest.files or (self.folder / MANIFEST_NAME).exists():
            write_manifest(self.root, manifest)
            if self.store:
                self.store.put_files(manifest)

    def fetch(self, scenarios: Iterable[int]) -> None:
        """Have files of scenarios here that only the store holds."""
        if self.store:
            self.store.fetch(scenarios)

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


def _scan_folder(campaign: _Campaign, wanted_ids: Sequence[int]) -> _Scan:
    """Find the files that are right, and which wanted ids must be simulated.

    Nothing is written.
    """
    size = campaign.size
    old = campaign.manifest
    stored = campaign.store.stored_entries if campaign.store else {}
    # All wanted ids that no store holds, and every file that has appeared, has vanished
    # or has changed its length since the manifest was written.
    lengths = {entry.scenario: entry.bytes for entry in old.files}
    inspected_ids = []
    for scenario in size.scenarios:
        path = campaign.path(scenario)
        length = path.stat().st_size if path.exists() else None
        has_changed = length != lengths.get(scenario)
        if scenario not in stored and (scenario in wanted_ids or has_changed):
            inspected_ids.append(scenario)
    inspected_count = len(inspected_ids)
    campaign.meter.begin("checking", total=inspected_count, scenarios=inspected_count)
    inspections = {}
    for scenario in inspected_ids:
        inspections[f"scenario {scenario}"] = partial(
            inspect_scenario,
            campaign.root,
            size,
            scenario,
            manifest=old.only(scenario),
            quick=True,
        )
    paths = map(campaign.path, inspected_ids)
    results = campaign.read_files(run_inspection, inspections, paths)

    hashed = []
    bad_ids = set(inspected_ids)  # until an inspection proves a file right
    for result in results:
        if result.entry:
            hashed.append(result.entry)
            bad_ids.discard(result.scenario)
    good_entries = [entry for entry in old.files if entry.scenario not in bad_ids]
    base = old.model_copy(update={"files": tuple(good_entries)})

    missing_ids = [scenario for scenario in wanted_ids if scenario in bad_ids]
    return _Scan(
        manifest=merge_entries(size, base, [*hashed, *stored.values()]),
        hashed=tuple(hashed),
        kept=tuple(scenario for scenario in wanted_ids if scenario not in bad_ids),
        to_do=estimate(size, missing_ids),
    )


def _simulate(campaign: _Campaign, scan: _Scan) -> None:
    """Run everything that is to do in workers, and perturbed runs of test scenarios."""
    size = campaign.size
    test_ids = size.subsets.get("test", ())
    # files that are right and have no predictability limit yet
    unlimited_ids = []
    for entry in campaign.manifest.files:
        is_kept_test = entry.scenario in test_ids and entry.scenario in scan.kept
        if is_kept_test and not entry.twin_floor:
            unlimited_ids.append(entry.scenario)
    campaign.fetch(unlimited_ids)

    # The longest first; a parallel device advances several together.
    substeps = dict(zip(scan.to_do.scenarios, scan.to_do.substeps, strict=True))
    ids = sorted(substeps, key=lambda scenario: (-substeps[scenario], scenario))
    width = 1
    if campaign.device is not Device.CPU:
        width = max(1, BATCH_PARTICLES // size.particles)
    items = []
    for start in range(0, len(ids), width):
        batch = ids[start : start + width]
        items.append(_work_item(campaign, tuple(batch), _simulate_and_perturb))
    for scenario in unlimited_ids:
        items.append(_work_item(campaign, (scenario,), _perturb))
    if not items:
        return

    campaign.meter.begin(
        "simulating", total=round(sum(item.cost for item in items)), scenarios=len(ids)
    )
    finished_items = run_items(
        items,
        workers=campaign.workers,
        scheduler=campaign.scheduler,
        environment=ONE_THREAD if campaign.device is Device.CPU else {},
    )
    with closing(finished_items):
        for finished in finished_items:
            campaign.meter.count(finished.units)
            _add_simulated(campaign, finished)


def _work_item(
    campaign: _Campaign,
    scenarios: tuple[int, ...],
    function: Callable[[SimulationJob, Report], _Simulated],
) -> WorkItem:
    size = campaign.size
    cost = 0
    for scenario in scenarios:
        if function is _simulate_and_perturb:
            cost += substep_count(size, scenario)
        if size.subset_of(scenario) == "test":
            cost += perturbed_substep_count(size, scenario)
    job = SimulationJob(
        size=size, scenarios=scenarios, root=campaign.root, device=campaign.device
    )
    return WorkItem(
        name=f"{size.split} {size.name}, scenario {format_ids(scenarios)}",
        function=function,
        argument=job,
        cost=cost,
    )


class _Simulated(NamedTuple):
    """What a worker has made."""

    scenarios: tuple[int, ...]  # ids whose files it has written
    limits: Mapping[int, Sequence[float]]  # predictability limits by id


def _simulate_and_perturb(job: SimulationJob, report: Report) -> _Simulated:
    """Simulate scenarios, and perturbed runs of those of test."""
    simulate(job, report)
    limits: dict[int, Sequence[float]] = {}
    for scenario in job.scenarios:
        if job.size.subset_of(scenario) == "test":
            single = replace(job, scenarios=(scenario,))
            limits |= measure_predictability(single, report)
    return _Simulated(job.scenarios, limits)


def _perturb(job: SimulationJob, report: Report) -> _Simulated:
    return _Simulated((), measure_predictability(job, report))


def _add_simulated(campaign: _Campaign, finished: Finished) -> None:
    """Put what a worker has made into the manifest."""
    made: _Simulated = finished.value
    entries = {}
    for scenario in made.scenarios:
        path = campaign.path(scenario)
        end = time.monotonic() + FILE_SECONDS
        while not path.is_file():
            os.listdir(path.parents[1])  # makes a network file system look again
            if time.monotonic() > end:
                raise WorkFailedError(
                    "a worker's file does not appear; name a folder on storage that "
                    "all machines share, then run the same command again",
                    where=str(path),
                )
            time.sleep(0.1)
        entries[scenario] = describe_file(campaign.root, campaign.size.key(scenario))
    record_entry_hashes(campaign.folder, entries.values())

    for scenario, limit in made.limits.items():
        entry = entries.get(scenario) or campaign.manifest.entry(scenario)
        if entry is not None:
            rounded = tuple(map(round_digits, limit))
            entries[scenario] = entry.model_copy(update={"twin_floor": rounded})
    environment = None
    if made.scenarios:
        environment = {**finished.machine, "device": campaign.device.value}
        if promises_bits(environment):
            campaign.promised += made.scenarios
    campaign.keep(
        merge_entries(campaign.size, campaign.manifest, entries.values(), environment)
    )
    campaign.meter.count(scenarios=len(made.scenarios))


def _complete_statistics(campaign: _Campaign) -> None:
    """Put the statistics of train into the manifest, once train is complete."""
    manifest = campaign.manifest
    measured = campaign.size.measured
    # Statistics of other bits differ from datasets.yaml by right.
    is_doubted = (
        measured is not None
        and manifest.identity == "bitwise"
        and manifest.statistics != measured.statistics
    )
    is_needed = is_doubted or not has_all_statistics(manifest, campaign.size)
    if "train" in manifest.subset_sha256 and is_needed:
        train_ids = campaign.size.subsets["train"]
        campaign.fetch(train_ids)
        campaign.meter.begin(
            "statistics", total=len(train_ids), scenarios=len(train_ids)
        )
        paths = {}
        for i in train_ids:
            paths[f"scenario {i}"] = campaign.path(i)
        read_moments = partial(file_moments, box=campaign.size.box)
        moments = campaign.read_files(read_moments, paths, paths.values())
        manifest = manifest.model_copy(update={"statistics": statistics(moments)})
    campaign.keep(manifest)
