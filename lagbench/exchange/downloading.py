"""Download a data set from the first store that has it, and simulate what none has."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.layout import (
    MANIFEST_NAME,
    format_ids,
    scenario_path,
    url_of,
)
from lagbench.data.local import locate_new, suggest_repair
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    MANIFEST_LIMIT,
    FileEntry,
    Manifest,
    describe_file,
    merge_entries,
    read_manifest,
    read_or_empty,
    record_entry_hashes,
    write_manifest,
)
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.make.cards import write_cards
from lagbench.make.generate import generate
from lagbench.make.inventory import (
    DataSetState,
    compare_hashes,
    inspect_scenario,
)
from lagbench.make.plan import Scenarios, Selection, check_disk, select
from lagbench.store.archive import (
    RELEASES_VARIABLE,
    fetch_archive,
    list_releases,
)
from lagbench.store.copy import (
    object_address,
    parse_manifest,
    publish,
    refuse_foreign_hashes,
)
from lagbench.store.fetch import CONNECTIONS, FetchRequest, fetch_scenarios
from lagbench.store.objects import (
    NotInStoreError,
    StoreUnreachableError,
    check_address,
    read_object,
)
from lagbench.work.run import Meter, Progress

Reason = DataError | WorkFailedError | UsageError
"""Why something could not be downloaded."""


@dataclass(frozen=True, kw_only=True)
class DownloadResult:
    """What a download did."""

    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the data set
    # store that files came from; None where none was needed or reached
    mirror: str | None
    downloaded: tuple[int, ...]  # ids that were downloaded
    kept: tuple[int, ...]  # ids whose files were there and right
    generated: tuple[int, ...]  # ids that were simulated instead
    bytes: int  # bytes that came from stores
    seconds: float  # time that it took [s]
    complete: bool  # whether train, valid and test are all there
    dataset_sha256: str | None  # data set hash, once complete
    verdict: str  # how the hashes compare with datasets.yaml, in words


def download(
    split: str | Path,
    size: str | None = None,
    *,
    mirror: str | None = None,
    subset: Selection = None,
    scenarios: Scenarios = None,
    root: str | Path | None = None,
    connections: int = CONNECTIONS,
    or_generate: bool = True,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    announce: Callable[[str], None] | None = None,
    on_wait: Callable[[str], None] | None = None,
    registry: Registry | None = None,
) -> DownloadResult:
    """Fetch the scenarios of a split that are not on disk yet.

    What no store has is simulated. Every file has a temporary name until its content
    hash is that of datasets.yaml. What was fetched before an interruption is not
    fetched again.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; mini when None, or the only one that the split has.
        mirror: URL of a copy of a root folder, or of a folder of archives, see
            :mod:`lagbench.store.archive`; else the mirrors of datasets.yaml in order,
            then releases.
        subset: some subsets only.
        scenarios: some ids only.
        root: folder of all data sets, see :func:`lagbench.data.local.resolve_root`.
        connections: files that are fetched side by side.
        or_generate: whether to simulate what no store has, or when none answers.
        workers: worker processes of the simulation.
        progress: called as the work advances.
        announce: told in a sentence when the simulation takes over, and why.
        on_wait: called with the holder in words when another process holds the lock.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset or scenario; the named store has no
            address of a store; or no store is known and nothing may be simulated.
        DataError: the store sent what is no data or has another length or content, see
            :mod:`lagbench.store.objects`; the file is gone, all that were right stay.
        WorkFailedError: the connection kept breaking, the disk is full, no store
            answers or is fast enough and nothing may be simulated.
    """
    started = time.monotonic()
    if connections < 1:
        raise UsageError("a download needs a connection", where="--connections")
    tier, data_root, rooted_registry = locate_new(
        split, size, root=root, registry=registry
    )
    selected = select(tier, subset=subset, scenarios=scenarios)
    description = rooted_registry.split(tier.split)
    if mirror is not None:
        # else data would be simulated without it, or need no store
        check_address(mirror)
        urls = [mirror]
    else:
        urls = [*description.mirrors, *list_releases(tier)]
    with ExitStack() as stack:
        stack.enter_context(
            dataset_lock(data_root, tier.split, tier.name, tier.major, on_wait=on_wait)
        )
        store = None
        own_url = url_of(data_root)
        if own_url is not None:
            store = stack.enter_context(publish(tier, data_root, own_url))
        stored = set(store.stored_entries) if store else set()
        published = stored.intersection(selected)
        job = _Job(
            tier,
            data_root,
            [scenario for scenario in selected if scenario not in published],
            stored=stored,
            meter=Meter(progress),
            connections=connections,
        )
        try:
            reason = job.run(urls)
        finally:
            manifest = job.write_manifest()
            if store:
                store.put_files(manifest)
        if not job.missing:
            verdict = compare_hashes(tier, manifest)
            if tier.simulated and job.has_changed:
                if store:
                    # cards are made from files, some of which only the store has
                    store.fetch(tier.scenarios)
                cards = write_cards(data_root, tier, description, manifest)
                if store:
                    store.put_files(manifest, cards)

    if job.missing:
        if not or_generate:
            raise reason
        if announce is not None:
            announce(f"{reason}: simulating scenarios {format_ids(job.missing)}")
        generated = generate(
            tier.split,
            tier.name,
            scenarios=job.missing,
            root=data_root,
            workers=workers,
            progress=progress,
            registry=rooted_registry,
        )
        verdict = generated.verdict
        new_manifest = read_manifest(data_root, tier.split, tier.name, tier.major)
        manifest = new_manifest or manifest
    return DownloadResult(
        split=tier.split,
        size=tier.name,
        folder=tier.folder(data_root),
        mirror=job.url,
        downloaded=tuple(sorted(job.downloaded)),
        kept=tuple(sorted((*published, *job.present))),
        generated=tuple(job.missing),
        bytes=job.byte_count,
        seconds=time.monotonic() - started,
        complete=manifest.complete,
        dataset_sha256=manifest.dataset_sha256,
        verdict=verdict,
    )


class _Job:
    """Find out what is missing, fetch it, and record what is there."""

    def __init__(
        self,
        size: Size,
        root: Path,
        selected: Sequence[int],
        *,
        stored: Collection[int],
        meter: Meter,
        connections: int,
    ) -> None:
        self.size = size
        self.root = root
        self._meter = meter
        self._connections = connections
        self.url: str | None = None  # store that files came from
        self.downloaded: list[int] = []
        self.byte_count = 0
        self.has_changed = False  # whether other files are there than the manifest had
        self._recorded_hashes: dict[int, str] = {}
        if size.measured:
            self._recorded_hashes = dict(size.measured.scenario_sha256)

        self._entries: list[FileEntry] = []
        self.present: list[int] = []
        self.missing: list[int] = []  # still to fetch
        old = read_or_empty(size, root)
        meter.begin("checking", total=len(selected), scenarios=len(selected))
        for scenario in selected:
            inspected = inspect_scenario(root, size, scenario, manifest=old, quick=True)
            if inspected.entry:
                self._entries.append(inspected.entry)
            if inspected.state is DataSetState.GOOD:
                self.present.append(scenario)
            else:
                self.missing.append(scenario)
        # other files that are as the manifest states; those in the store are right
        kept = []
        for entry in old.files:
            path = size.folder(root) / entry.path
            is_there = path.is_file() and path.stat().st_size == entry.bytes
            if entry.scenario in stored or (
                entry.scenario not in self.missing and is_there
            ):
                kept.append(entry)
            else:
                self.has_changed = True
        self._old_manifest = old.model_copy(update={"files": tuple(kept)})

    def run(self, urls: Iterable[str]) -> Reason:
        """Fetch what is missing from stores in turn, unless one lies.

        Returns why something still is missing.
        """
        place = f"{self.size.split} {self.size.name}"
        unknown = [one for one in self.missing if one not in self._recorded_hashes]
        if unknown:
            return DataError(
                f"no hash of scenarios {format_ids(unknown)} is recorded to check "
                f"downloads against; {suggest_repair(self.size)}",
                where=place,
            )
        reason: Reason = UsageError(
            "no store is known to download from; name one: --from URL, or "
            f"{RELEASES_VARIABLE}=URL; or leave out --no-generate",
            where=place,
        )
        for url in urls:
            if not self.missing:
                break
            try:
                reason = self._fetch_from(url.rstrip("/")) or reason
            except StoreUnreachableError as error:
                reason = error
            finally:
                done = self.downloaded
                self.missing = [one for one in self.missing if one not in done]
        return reason

    def _fetch_from(self, url: str) -> NotInStoreError | None:
        """Fetch what one store has.

        Returns the error of the last file that it does not have.
        """
        size = self.size
        check_disk(self.root, sum(map(size.file_bytes, self.missing)))
        claims = self._read_claims(url)
        requests = {}
        for scenario in self.missing:
            key = size.key(scenario)
            claim = (claims or {}).get(scenario)
            requests[scenario] = FetchRequest(
                url=object_address(size, url, f"{key.subset}/{scenario:04d}.nc"),
                target=scenario_path(self.root, key),
                limit=size.longest_file(scenario),
                content_sha256=self._recorded_hashes[scenario],
                length=claim.bytes if claim else None,
                file_sha256=claim.file_sha256 if claim else None,
            )
        lengths = [request.length for request in requests.values()]
        total = 0 if None in lengths else sum(filter(None, lengths))
        self._meter.begin("downloading", total=total, scenarios=len(requests))
        if claims is None:
            # a store without a manifest may have the archive of the data set
            archive = fetch_archive(size, url, requests, self._count_bytes)
            try:
                with closing(archive) as arrived_entries:
                    for entry in arrived_entries:
                        self._record_file(url, entry.scenario, entry)
                return None
            except NotInStoreError:
                claims = {}
            for scenario in self.downloaded:
                requests.pop(scenario, None)

        last_absent = None
        arrivals = fetch_scenarios(
            requests, self._count_bytes, connections=self._connections
        )
        with closing(arrivals):
            for scenario, absent in arrivals:
                if absent is None:
                    self._record_file(url, scenario, claims.get(scenario))
                else:
                    last_absent = absent
        return last_absent

    def _read_claims(self, url: str) -> dict[int, FileEntry] | None:
        """Return what a store's manifest says of its files; None without one.

        Raises:
            DataError: it has other content hashes than datasets.yaml.
        """
        place = object_address(self.size, url, MANIFEST_NAME)
        try:
            text = read_object(place, limit=MANIFEST_LIMIT)
        except NotInStoreError:
            return None
        manifest = parse_manifest(self.size, text, where=place)
        claims = {entry.scenario: entry for entry in manifest.files}
        foreign_scenarios = []
        for scenario in self.missing:
            claim = claims.get(scenario)
            if claim and not claim.has_hash(self._recorded_hashes[scenario]):
                foreign_scenarios.append(scenario)
        refuse_foreign_hashes(self.size, manifest, foreign_scenarios, where=place)
        return claims

    def _record_file(self, url: str, scenario: int, claim: FileEntry | None) -> None:
        """Note a new file.

        The store's word is taken for what the file cannot tell: the predictability
        limit, and what files of earlier versions do not state.
        """
        entry = describe_file(self.root, self.size.key(scenario))
        if claim is not None:
            update = {
                "facts": entry.facts or claim.facts,
                "twin_floor": claim.twin_floor,
            }
            entry = entry.model_copy(update=update)
        self._entries.append(entry)
        self.downloaded.append(scenario)
        self.has_changed = True
        self.url = url
        self._meter.count(scenarios=1)

    def _count_bytes(self, byte_count: int) -> None:
        """Count bytes that came from a store."""
        self.byte_count += byte_count
        self._meter.count(byte_count)

    def write_manifest(self) -> Manifest:
        """Write the manifest of the files that are there and right; return it.

        An empty manifest is written only over an older one.
        """
        folder = self.size.folder(self.root)
        record_entry_hashes(folder, self._entries)
        manifest = merge_entries(self.size, self._old_manifest, self._entries)
        if self.size.measured and "train" in manifest.subset_sha256:
            update = {"statistics": self.size.measured.statistics}
            manifest = manifest.model_copy(update=update)
        if manifest.files or (folder / MANIFEST_NAME).exists():
            write_manifest(self.root, manifest)
        return manifest
