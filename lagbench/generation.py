"""Generate a data set: simulate what is missing, crash-safe, resumable, on all cores.

A scenario's file appears whole or not at all, and the manifest is brought up to date after
each, so that an interrupted generation goes on where it stopped and ends with the same bytes
as an uninterrupted one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .campaign import Campaign
from .crew import Crew
from .errors import UsageError, nearest
from .extras import check_installed
from .layout import dataset_folder
from .locating import locate
from .locking import dataset_lock
from .plan import Scenarios, Selection, free_bytes, select
from .pool import worker_count
from .progress import Meter, Progress
from .registry import Registry
from .store.publication import look_at, publication

if TYPE_CHECKING:
    from .generators.solver import Device

__all__ = ["GenerationResult", "Progress", "generate", "parse_device"]


@dataclass(frozen=True, kw_only=True)
class GenerationResult:
    """What a generation did, or would do.

    Attributes:
        split: name of the split.
        size: name of the size.
        version: semantic version.
        root: folder of all data sets.
        folder: folder of this one.
        device: where the solver ran.
        workers: worker processes.
        simulated: ids that were (dry run: would be) simulated.
        kept: ids whose files were there and right.
        missing: ids of the size that are still not there.
        bytes_needed: disk space of ``simulated`` before compression [bytes].
        bytes_free: free disk space before the start [bytes].
        seconds_expected: expected time [s], for orientation.
        seconds: time that it took [s].
        complete: whether train, valid and test are all there.
        dataset_sha256: data set hash, once complete.
        verdict: how the hashes compare with datasets.yaml, in words.
        dry_run: whether nothing was done.
    """

    split: str
    size: str
    version: str
    root: Path
    folder: Path
    device: str
    workers: int
    simulated: tuple[int, ...]
    kept: tuple[int, ...]
    missing: tuple[int, ...]
    bytes_needed: int
    bytes_free: int
    seconds_expected: float
    seconds: float = 0.0
    complete: bool = False
    dataset_sha256: str | None = None
    verdict: str = ""
    dry_run: bool = False


def generate(
    split: str,
    size: str = "full",
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
    """Simulate the scenarios of a split that are not on disk yet, and check their hashes.

    Args:
        split: name of the split.
        size: name of the size.
        subset: some subsets only.
        scenarios: some ids only, as numbers or as text such as "0,3-5".
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data folder. With a
            URL (``s3://bucket/prefix``) files are written to its working copy and put into the
            store, see docs/scaling.md.
        workers: worker processes; one per core, or one for the parallel devices.
        device: "cpu", "parallel" or "cuda"; the bits do not depend on it.
        scheduler: address of a Dask scheduler whose workers simulate instead; they must see
            the root folder under the same path.
        gather: other root folders, from which finished scenarios are taken first.
        force: simulate anew what is there and right.
        dry_run: only say what it would take.
        progress: called as the work advances.
        on_wait: called with the holder in words when another process holds the lock.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset, scenario or device, fewer than one worker, or
            Taichi is not installed; or nothing can be gathered from a folder.
        WorkFailedError: disk full or not writable, a scenario blew up, workers keep dying, the
            cluster is lost or does not see the root folder; or the store refuses, does not answer,
            or knows no conditional put.
        DataError: the result has other hashes than datasets.yaml, or there is no such bucket.
    """
    started = time.monotonic()
    tier, folder, splits = locate(split, size, root=root, registry=registry)
    wanted = select(tier, subset=subset, scenarios=scenarios)
    target = parse_device(device)
    cores = worker_count(workers, default=None if target.value == "cpu" else 1)
    free = free_bytes(dataset_folder(folder, tier.split, size, tier.major))
    campaign = Campaign(
        tier,
        folder,
        target,
        Crew(workers=cores, scheduler=scheduler),
        Meter(progress),
        split=splits.split(tier.split),
        sources=[Path(source).expanduser().absolute() for source in gather],
    )
    if dry_run:
        campaign.store = look_at(tier, folder)
        campaign.survey(wanted, force=force)
    else:
        if scheduler is None:
            check_installed("taichi", extra="generate")
        with (
            dataset_lock(folder, tier.split, size, tier.major, on_wait=on_wait),
            publication(tier, folder, on_wait=on_wait) as campaign.store,
        ):
            campaign.run(wanted, force=force)
    seconds = time.monotonic() - started
    return _result(campaign, bytes_free=free, seconds=seconds, dry_run=dry_run)


def _result(campaign: Campaign, *, bytes_free: int, seconds: float, dry_run: bool) -> GenerationResult:
    size = campaign.size
    return GenerationResult(
        split=size.split,
        size=size.name,
        version=size.version,
        root=campaign.root,
        folder=dataset_folder(campaign.root, size.split, size.name, size.major),
        device=campaign.device.value,
        workers=campaign.crew.workers,
        simulated=campaign.to_do.scenarios,
        kept=tuple(campaign.kept),
        missing=campaign.missing(),
        bytes_needed=campaign.to_do.bytes,
        bytes_free=bytes_free,
        seconds_expected=campaign.to_do.seconds(campaign.crew.workers),
        seconds=seconds,
        complete=campaign.manifest.complete,
        dataset_sha256=campaign.manifest.dataset_sha256,
        verdict=campaign.verdict,
        dry_run=dry_run,
    )


def parse_device(name: str) -> Device:
    """Return a device by name.

    Raises:
        UsageError: there is none; the message names the nearest.
    """
    from .generators.solver import Device

    names = [device.value for device in Device]
    if name not in names:
        raise UsageError(f"no device {name!r}", where="--device", fix=nearest(name, names))
    return Device(name)
