"""Verify a data set: hash the files again, compare with datasets.yaml, simulate some
anew.

The manifest is a claim of whoever wrote it; datasets.yaml comes with lagbench. So files
are compared with datasets.yaml, and with the manifest only where datasets.yaml has no
hash yet, or where a machine wrote files that promises no equal bits.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import (
    HASHED_SUBSETS,
    dataset_hash,
    file_sha256,
    record_hashes,
    subset_hash,
)
from lagbench.data.layout import format_ids
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UsageError
from lagbench.generators.batch import SimulationJob
from lagbench.generators.simulate import simulate
from lagbench.generators.split import Device
from lagbench.store.copy import update_working_copy
from lagbench.work.engine import find_engine
from lagbench.work.executor import WorkItem, run_items
from lagbench.work.machine import worker_count
from lagbench.work.run import Meter, Progress

from .inventory import (
    DataSetState,
    ScenarioInspection,
    extra_files,
    hash_verdict,
    inspect_scenario,
    other_bits,
    recorded_hash,
    unlike,
)
from .plan import Scenarios, Selection, estimate, select


@dataclass(frozen=True, kw_only=True)
class SubsetReport:
    """What the files of one subset are."""

    name: str  # name of the subset
    present: int  # scenarios that are there and right
    missing: tuple[int, ...]  # ids that are not there
    wrong: tuple[int, ...]  # ids whose file is damaged or has another hash
    extra: tuple[str, ...]  # files in the subset's folder that belong to no scenario
    verdict: str  # how its hash compares with datasets.yaml, in words


@dataclass(frozen=True, kw_only=True)
class VerificationResult:
    """What a verification showed."""

    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the data set
    subsets: tuple[SubsetReport, ...]  # a report on each subset looked at
    # "bitwise", or "tolerance" where a device wrote files that does not keep the
    # promise of equal bits; "unknown" without a manifest
    identity: str
    # data set hash of the files, where all of them are there and right
    dataset_sha256: str | None
    # id to "identical", "different" or "nothing to compare with"
    regenerated: Mapping[int, str]
    # what is wrong, each naming file and, where it can be told, variable
    problems: tuple[str, ...]
    warnings: tuple[str, ...]  # what a reader should know although it is no fault
    must_be_complete: bool  # whether a missing scenario is a fault
    verdict: str  # how the data set hash compares with datasets.yaml, in words
    fix: str  # what makes the data set whole again

    @property
    def complete(self) -> bool:
        """Whether nothing that was looked at is missing."""
        return not any(report.missing for report in self.subsets)

    def check(self) -> None:
        """Raise a DataError unless everything that has to hold does."""
        where = str(self.folder)
        if self.problems:
            problems = "\n  ".join(self.problems)
            raise DataError(
                f"{len(self.problems)} problem(s):\n  {problems}\n{self.fix}",
                where=where,
            )

        if not any(report.present for report in self.subsets):
            raise DataError(f"nothing is generated; {self.fix}", where=where)

        if self.must_be_complete and not self.complete:
            gaps = []
            for report in self.subsets:
                if report.missing:
                    gaps.append(f"{report.name} {format_ids(report.missing)}")
            raise DataError(
                f"the data set is incomplete, missing: {', '.join(gaps)}; {self.fix}",
                where=where,
            )


def verify(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    subset: Selection = None,
    scenarios: Scenarios = None,
    regenerate: int = 0,
    complete: bool = False,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> VerificationResult:
    """Compare the files of a data set with datasets.yaml; call ``check()`` on the
    result.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        subset: some subsets only.
        scenarios: some ids only.
        regenerate: how many scenarios to simulate anew, evenly spaced, first and last
            included.
        complete: whether a missing scenario is a fault.
        workers: worker processes for ``regenerate``; one per core when None.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset or scenario, fewer than one worker, or a
            negative number for ``regenerate``.
        DataError: the root folder is the working copy of a store that holds wrong data.
        WorkFailedError: simulating anew failed, or the store does not answer.
    """
    tier, data_root, _ = locate(split, size, root=root, registry=registry)
    ids = select(tier, subset=subset, scenarios=scenarios)
    meter = Meter(progress)
    cores = worker_count(workers)
    if regenerate < 0:
        raise UsageError(
            f"the number is negative: {regenerate}; leave it out, or give such a "
            "number",
            where="--regenerate",
        )
    if regenerate:
        find_engine()

    update_working_copy(tier, data_root, ids, thoroughly=True)
    manifest = None
    warnings = [f"there is no manifest: {suggest_repair(tier, root=data_root)}"]
    try:
        manifest = read_manifest(data_root, tier.split, tier.name, tier.major)
    except DataError as error:
        warnings = [str(error)]
    if manifest is not None:
        warnings = []
        if manifest.identity == "tolerance":
            warnings.append(
                "identity: tolerance - a device wrote these files that does not "
                "promise equal bits"
            )

    inspections = _inspect_files(tier, data_root, ids, manifest=manifest, meter=meter)
    # content hashes of the files that are there and right
    hashes: dict[int, str] = {}
    problems = []
    tolerated = []
    for scenario, inspection in inspections.items():
        if inspection.content_sha256:
            hashes[scenario] = inspection.content_sha256
        if inspection.problem:
            problems.append(inspection.problem)
        if inspection.tolerated:
            tolerated.append(scenario)

    regenerated: dict[int, str] = {}
    chosen = evenly_spaced(ids, regenerate)
    for scenario, content in _regenerate(tier, chosen, cores, meter).items():
        verdict = _compare_regenerated(tier, inspections[scenario], content)
        regenerated[scenario] = verdict
        if verdict == "different":
            problems.append(f"scenario {scenario} differs when simulated anew")

    # hashes of the subsets whose files are all there and right
    digests = {}
    for name, members in tier.subsets.items():
        if hashes.keys() >= set(members):
            digests[name] = subset_hash({i: hashes[i] for i in members})
    data_set_digest = None
    if digests.keys() >= set(HASHED_SUBSETS):
        covered = {name: digests[name] for name in HASHED_SUBSETS}
        data_set_digest = dataset_hash(tier.split, tier.name, tier.major, covered)
    reports = _subset_reports(data_root, tier, inspections, digests)
    verdict = hash_verdict(tier, data_set_digest, tolerated=bool(tolerated))

    wrong = unlike(tier)
    for report in reports:
        if report.verdict == wrong:
            problems.append(f"{report.name}: its hash is {wrong}")
        if report.missing:
            warnings.append(f"{report.name} lacks {format_ids(report.missing)}")
        if report.extra:
            names = ", ".join(report.extra)
            warnings.append(f"{report.name} has files of no scenario: {names}")
    if verdict == wrong:
        problems.append(f"the data set hash is {wrong}")
    if tolerated:
        warnings.append(f"scenarios {format_ids(tolerated)} have {other_bits(tier)}")
    if manifest is not None:
        warnings += _manifest_differences(tier, manifest, hashes)
    return VerificationResult(
        split=tier.split,
        size=tier.name,
        folder=tier.folder(data_root),
        subsets=reports,
        identity=manifest.identity if manifest else "unknown",
        dataset_sha256=data_set_digest,
        regenerated=regenerated,
        problems=tuple(problems),
        warnings=tuple(warnings),
        must_be_complete=complete,
        verdict=verdict,
        fix=suggest_repair(tier, root=data_root),
    )


def _inspect_files(
    size: Size,
    root: Path,
    ids: Sequence[int],
    *,
    manifest: Manifest | None,
    meter: Meter,
) -> dict[int, ScenarioInspection]:
    """Hash every file; note which are right, so that scorer and generator need not hash
    their values again.
    """
    meter.begin("hashing", total=len(ids), scenarios=len(ids))
    inspections: dict[int, ScenarioInspection] = {}
    file_digests: dict[Path, str] = {}
    contents: dict[Path, str] = {}
    for scenario in ids:
        path = size.path(root, scenario)
        # Before the values, so that a file that changes meanwhile fits no note.
        with suppress(OSError):
            file_digests[path] = file_sha256(path)
        inspection = inspect_scenario(root, size, scenario, manifest=manifest)
        inspections[scenario] = inspection
        if inspection.content_sha256:
            contents[path] = inspection.content_sha256
        meter.count(1, scenarios=1)
    record_hashes(size.folder(root), contents, file_hashes=file_digests)
    return inspections


def evenly_spaced(ids: Sequence[int], count: int) -> tuple[int, ...]:
    """Return some of the ids, evenly spaced: the first, and from two on the last.

    >>> evenly_spaced(range(60), 3)
    (0, 30, 59)
    """
    count = min(count, len(ids))
    if count < 2:
        return tuple(ids[:count])

    last = len(ids) - 1
    chosen = []
    for k in range(count):
        # k last / (count - 1), rounded to the nearest, halves up
        position = (2 * k * last + count - 1) // (2 * (count - 1))
        chosen.append(ids[position])
    return tuple(chosen)


def _regenerate(
    size: Size, ids: Sequence[int], workers: int, meter: Meter
) -> dict[int, str]:
    """Simulate scenarios into a folder that vanishes; return their content hashes."""
    if not ids:
        return {}
    substeps = estimate(size, ids).substeps
    meter.begin("simulating anew", total=sum(substeps), scenarios=len(ids))
    hashes: dict[int, str] = {}
    with tempfile.TemporaryDirectory(prefix="lagbench-") as folder:
        items = []
        for scenario, cost in zip(ids, substeps, strict=True):
            job = SimulationJob(
                size=size, scenarios=(scenario,), root=Path(folder), device=Device.CPU
            )
            name = f"{size.split} {size.name}, scenario {scenario}"
            items.append(
                WorkItem(name=name, function=simulate, argument=job, cost=cost)
            )
        for finished in run_items(items, workers=workers):
            for simulated in finished.value:
                hashes[simulated.scenario] = simulated.content_sha256
            meter.count(finished.units, scenarios=1)
    return {scenario: hashes[scenario] for scenario in ids}


def _compare_regenerated(
    size: Size, inspection: ScenarioInspection, content: str
) -> str:
    """Compare a scenario simulated anew with its file, else with datasets.yaml."""
    references = []
    if inspection.content_sha256:
        references.append(inspection.content_sha256)
    if inspection.tolerated or not references:
        recorded = recorded_hash(size, inspection.scenario)
        if recorded:
            references.append(recorded)
    if not references:
        return "nothing to compare with"
    for reference in references:
        if content.startswith(reference):
            return "identical"
    return "different"


def _subset_reports(
    root: Path,
    size: Size,
    inspections: Mapping[int, ScenarioInspection],
    digests: Mapping[str, str],
) -> tuple[SubsetReport, ...]:
    extra = extra_files(root, size)
    reports = []
    for name, members in size.subsets.items():
        is_tolerated = False
        ids: dict[DataSetState, list[int]] = {state: [] for state in DataSetState}
        for scenario in members:
            if scenario in inspections:
                inspection = inspections[scenario]
                is_tolerated |= inspection.tolerated
                ids[inspection.state].append(scenario)
        if not any(ids.values()):
            continue
        report = SubsetReport(
            name=name,
            present=len(ids[DataSetState.GOOD]),
            missing=tuple(ids[DataSetState.MISSING]),
            wrong=tuple(ids[DataSetState.WRONG]),
            extra=tuple(extra.get(name, ())),
            verdict=hash_verdict(size, digests.get(name), name, tolerated=is_tolerated),
        )
        reports.append(report)
    return tuple(reports)


def _manifest_differences(
    size: Size, manifest: Manifest, hashes: Mapping[int, str]
) -> list[str]:
    """Return how the manifest differs from files that are right, and from
    datasets.yaml.
    """
    differences = []
    different_ids = []
    for scenario, content in hashes.items():
        entry = manifest.entry(scenario)
        if entry and content != entry.content_sha256:
            different_ids.append(scenario)
    if different_ids:
        listing = format_ids(different_ids)
        differences.append(f"the manifest has other hashes of {listing}")

    # Statistics follow from the bits: they must be as recorded where all bits are.
    is_bitwise = manifest.complete and manifest.identity == "bitwise"
    if size.measured is not None and is_bitwise:
        names = []
        recorded = size.measured.statistics
        for name in sorted(manifest.statistics.keys() | recorded.keys()):
            if manifest.statistics.get(name) != recorded.get(name):
                names.append(name)
        if manifest.mean_twin_floor() != size.measured.twin_floor:
            names.append("twin_floor")
        if names:
            listing = ", ".join(names)
            record = size.record_name
            differences.append(f"the manifest has another {listing} than {record}")
    return differences
