"""Download a data set from a mirror, check its content, and simulate what no mirror has."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.layout import dataset_folder
from lagbench.data.local import locate
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, spell_ids
from lagbench.errors import UsageError
from lagbench.make.cards import write_cards
from lagbench.make.generate import generate
from lagbench.make.plan import Scenarios, Selection, select
from lagbench.make.verify import compare, told
from lagbench.store.publication import publication
from lagbench.work.progress import Meter, Progress

from .errand import Errand, Reason

__all__ = ["CONNECTIONS", "DownloadResult", "download"]

CONNECTIONS = 4
"""Files that are fetched side by side."""


@dataclass(frozen=True, kw_only=True)
class DownloadResult:
    """What a download did."""

    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the data set
    mirror: str | None  # base URL that files came from; None where none was needed or reached
    downloaded: tuple[int, ...]  # ids that were downloaded
    kept: tuple[int, ...]  # ids whose files were there and right
    generated: tuple[int, ...]  # ids that were simulated instead
    bytes: int  # bytes that came from the mirror
    seconds: float  # time that it took [s]
    complete: bool  # whether train, valid and test are all there
    dataset_sha256: str | None  # data set hash, once complete
    verdict: str  # how the hashes compare with datasets.yaml, in words


def download(
    split: str,
    size: str = "full",
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
    registry: Registry | None = None,
) -> DownloadResult:
    """Fetch the scenarios of a split that are not on disk yet; simulate those no mirror has.

    Every file has a temporary name until its content hash is that of datasets.yaml. What was
    fetched before an interruption is not fetched again.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size.
        mirror: base URL of a copy of a root folder; else those of datasets.yaml, in order.
        subset: some subsets only.
        scenarios: some ids only.
        root: folder of all data sets, see :func:`lagbench.data.layout.resolve_root`.
        connections: files that are fetched side by side.
        or_generate: whether to simulate what no mirror has, or when none answers.
        workers: worker processes of the simulation.
        progress: called as the work advances.
        announce: told in a sentence when the simulation takes over, and why.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset or scenario, or no mirror is known and nothing
            may be simulated.
        DataError: the mirror sent what is no data or has another length or content, see
            :mod:`lagbench.store.mirror`; the file is gone, all that were right stay.
        WorkFailedError: the connection kept breaking, the disk is full, no mirror answers and
            nothing may be simulated.
    """
    started = time.monotonic()
    if connections < 1:
        raise UsageError("no file comes without a connection", where="--connections", expected=">= 1")
    tier, folder, splits = locate(split, size, root=root, registry=registry)
    wanted = select(tier, subset=subset, scenarios=scenarios)
    bases = (mirror,) if mirror else splits.split(tier.split).mirrors
    with (
        dataset_lock(folder, tier.split, tier.name, tier.major),
        publication(tier, folder) as store,
    ):
        held = [i for i in wanted if store and i in store.held]
        lacking = [i for i in wanted if i not in held]
        errand = Errand(tier, folder, lacking, Meter(progress), connections)
        try:
            reason = errand.run(bases)
        finally:
            manifest = errand.record()
            if store:
                store.follow(manifest, at_once=True)
        if not errand.missing:
            verdict = told(compare(tier, manifest), tier)
            if errand.downloaded and tier.simulated:
                if store:
                    store.bring(held)
                cards = write_cards(folder, tier, splits.split(tier.split), manifest)
                if store:
                    store.finish(manifest, cards)
    if errand.missing:
        if not or_generate:
            raise reason
        if announce is not None:
            announce(f"{_sentence(reason)}: simulating scenarios {spell_ids(errand.missing)}")
        rest = generate(
            tier.split,
            tier.name,
            scenarios=errand.missing,
            root=folder,
            workers=workers,
            progress=progress,
            registry=splits,
        )
        verdict = rest.verdict
        manifest = read_manifest(folder, tier.split, tier.name, tier.major) or manifest
    return DownloadResult(
        split=tier.split,
        size=tier.name,
        folder=dataset_folder(folder, tier.split, tier.name, tier.major),
        mirror=errand.mirror,
        downloaded=tuple(sorted(errand.downloaded)),
        kept=tuple(sorted((*held, *errand.kept))),
        generated=tuple(errand.missing),
        bytes=errand.bytes,
        seconds=time.monotonic() - started,
        complete=manifest.complete,
        dataset_sha256=manifest.dataset_sha256,
        verdict=verdict,
    )


def _sentence(reason: Reason) -> str:
    place = f" ({reason.where})" if reason.where else ""
    return f"{reason.what}{place}"
