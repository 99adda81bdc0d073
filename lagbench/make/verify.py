"""Verify a data set: hash the files again, compare with datasets.yaml, simulate some anew.

The manifest is a claim of whoever wrote it; datasets.yaml comes with lagbench. So files are
held against datasets.yaml, and against the manifest only where datasets.yaml has no hash yet,
or where a machine wrote files that promises no equal bits.

Which scenarios of a data set are on disk, and whether their content is right.

Right means: the file says what it is in the place where it stands, its parameters are those
of the registry, its values have the hash that it states, and that hash is the one in
datasets.yaml; where there is none yet, the one in the manifest. A file of a machine that
promises no equal bits may differ from datasets.yaml, but not from its manifest.

How a data set compares with what datasets.yaml says about it, hash by hash.
"""

from __future__ import annotations

import enum
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import HASHED_SUBSETS, dataset_hash, file_sha256, plain, subset_hash
from lagbench.data.layout import dataset_folder, scenario_path
from lagbench.data.local import DESCRIPTION, locate, remedy
from lagbench.data.manifest import FileEntry, Manifest, describe_file, note, read_manifest
from lagbench.data.registry import Registry, Size, spell_ids
from lagbench.data.scenario import ScenarioHeader, check_scenario, read_scenario
from lagbench.errors import DataError, check_installed
from lagbench.generators.batch import SimulationJob
from lagbench.generators.simulate import simulate
from lagbench.generators.solver import Device
from lagbench.store.copy import bring, unstored
from lagbench.work.machine import may_differ
from lagbench.work.pool import Pool, Task, worker_count
from lagbench.work.progress import Meter, Progress

from .plan import Scenarios, Selection, estimate, select

__all__ = [
    "Finding",
    "Look",
    "State",
    "examine",
    "extra_files",
    "look",
    "recorded_hash",
    "EQUAL",
    "TOLERATED",
    "UNLIKE",
    "compare",
    "hash_verdict",
    "told",
    "unlike_measures",
    "SubsetReport",
    "VerificationResult",
    "verify",
]


class State(enum.StrEnum):
    """What became of a scenario's file."""

    GOOD = "good"
    MISSING = "missing"
    WRONG = "wrong"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a look at one scenario's file showed."""

    scenario: int  # its id
    state: State  # whether the file is there and right
    content_sha256: str | None = None  # content hash of a good file
    problem: str | None = None  # what is wrong, naming file and, where it can be told, variable
    entry: FileEntry | None = None  # manifest entry of a good file, where one was asked for
    tolerated: bool = False  # whether a good file has other bits than datasets.yaml


def recorded_hash(size: Size, scenario: int) -> str | None:
    """Return the first 16 digits of a content hash as datasets.yaml has them, or None."""
    return size.measured.scenario_sha256.get(scenario) if size.measured else None


def examine(
    root: Path, size: Size, scenario: int, *, manifest: Manifest | None = None, quick: bool = False
) -> Finding:
    """Look at the file of one scenario."""
    from lagbench.generators.simulate import scenario_key

    key = scenario_key(size, scenario)
    path = scenario_path(root, key)
    if not path.exists():
        return Finding(scenario=scenario, state=State.MISSING)
    claim = manifest.entry(scenario) if manifest else None
    try:
        digest = file_sha256(path) if quick else None
        with read_scenario(path) as file:
            _check_header(path, file.header, size, scenario)
            unchanged = claim is not None and digest == claim.file_sha256
            if unchanged:
                file.check_attributes()
        content = claim.content_sha256 if claim and unchanged else check_scenario(path)
        tolerated = _check_known(path, content, recorded_hash(size, scenario), claim, manifest)
        entry = describe_file(root, key, digest=digest) if digest and not unchanged else claim
    except (DataError, OSError) as error:
        return Finding(scenario=scenario, state=State.WRONG, problem=_spelled(error, path))
    return Finding(
        scenario=scenario,
        state=State.GOOD,
        content_sha256=content,
        entry=entry if quick else None,
        tolerated=tolerated,
    )


@dataclass(frozen=True, kw_only=True)
class Look:
    """The arguments of a quick :func:`examine`, for a worker."""

    root: Path  # folder that holds all data sets
    size: Size  # tier of a split
    scenario: int  # id
    manifest: Manifest  # what the folder's manifest says of this scenario


def look(order: Look, report: Callable[[int], None]) -> Finding:
    """Examine the file of one scenario quickly and report it as one unit of work."""
    finding = examine(order.root, order.size, order.scenario, manifest=order.manifest, quick=True)
    report(1)
    return finding


def _spelled(error: DataError | OSError, path: Path) -> str:
    if not isinstance(error, DataError):
        return f"cannot read {path}: {error.strerror}"
    # How to mend it depends on the split, and is said once for all files.
    return str(DataError(error.what, where=error.where, expected=error.expected, got=error.got))


def extra_files(root: Path, size: Size) -> dict[str, list[str]]:
    """Return, by subset folder, the names of files that no scenario of the size has."""
    folder = dataset_folder(root, size.split, size.name, size.major)
    known = {(subset, f"{i:04d}.nc") for subset, ids in size.subsets.items() for i in ids}
    extra: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*/*.nc")):
        if (path.parent.name, path.name) not in known and not path.name.startswith("."):
            extra.setdefault(path.parent.name, []).append(path.name)
    return extra


def _check_header(path: Path, header: ScenarioHeader, size: Size, scenario: int) -> None:
    """Refuse a file of another scenario or simulated with other parameters."""
    key = header.key
    found = (key.split, key.size, key.major, key.scenario, key.subset)
    wanted = (size.split, size.name, size.major, scenario, size.subset_of(scenario))
    if found != wanted:
        raise DataError("a file holds another scenario", where=str(path), expected=wanted, got=found)
    if not size.simulated:  # then the recorded content hash covers the parameters
        return
    from lagbench.generators.batch import draw
    from lagbench.generators.simulate import OUTCOMES, file_parameters

    parameters = plain(file_parameters(size, draw(size, scenario)))
    # What only the simulation tells is covered by the content hash.
    stated = {name: value for name, value in header.parameters.items() if name not in OUTCOMES}
    if parameters != stated:
        names = _differing(parameters, stated)
        raise DataError(
            "a file was simulated with other parameters",
            where=f"{path}, attributes {', '.join(names)}",
            expected="those of datasets.yaml",
        )


def _differing(wanted: object, found: object) -> list[str]:
    left = dict(wanted) if isinstance(wanted, dict) else {}
    right = dict(found) if isinstance(found, dict) else {}
    return sorted(name for name in left.keys() | right.keys() if left.get(name) != right.get(name))


def _check_known(
    path: Path, content: str, recorded: str | None, claim: FileEntry | None, manifest: Manifest | None
) -> bool:
    """Compare a content hash with what is known; return whether its being another is tolerated."""
    expected = recorded or (claim.content_sha256 if claim else None)
    if expected is None or content.startswith(expected):
        return False
    if (
        manifest is not None
        and manifest.identity == "tolerance"
        and claim is not None
        and claim.content_sha256 == content
        and may_differ(claim.device, manifest.environments)
    ):
        return True
    raise DataError(
        "the file has another content hash",
        where=str(path),
        expected=f"{expected} of {'datasets.yaml' if recorded else 'the manifest'}",
        got=content,
    )


RECORD = "datasets.yaml"
"""Where the hashes of our own splits are recorded, as the words here have it."""

EQUAL = "equal to datasets.yaml"
UNLIKE = "NOT that of datasets.yaml"
TOLERATED = "other bits than datasets.yaml (identity: tolerance)"


def compare(size: Size, manifest: Manifest, *, promised: Collection[int] = ()) -> str:
    """Return how the hashes of a manifest compare with datasets.yaml, in words."""
    measured = size.measured
    if measured is None:
        return "datasets.yaml holds no hash of this size yet: nothing to compare with"
    recorded = measured.scenario_sha256
    differing = [e.scenario for e in manifest.files if not e.has_hash(recorded.get(e.scenario))]
    tolerated = {e.scenario for e in manifest.files if _may_differ(e, manifest)} - set(promised)
    broken = [i for i in differing if i not in tolerated]
    if broken:
        what = f"{len(broken)} of {len(manifest.files)} scenarios have another hash"
        raise _broken(what, f"{size.split} {size.name}, scenarios {spell_ids(broken)}")
    if differing:
        return f"scenarios {spell_ids(differing)} have {TOLERATED}"
    found = {**manifest.subset_sha256, "the data set": manifest.dataset_sha256}
    wanted = {**measured.subset_sha256, "the data set": measured.dataset_sha256}
    unlike = [name for name, digest in found.items() if digest is not None and digest != wanted.get(name)]
    if unlike:
        where = f"{size.split} {size.name}, {', '.join(unlike)}"
        raise _broken("subsets or the data set have another hash though every scenario has its own", where)
    return EQUAL if manifest.complete else f"what is there is {EQUAL}"


def hash_verdict(computed: str | None, recorded: str | None, *, tolerated: bool = False) -> str:
    """Return how one subset or data set hash compares with datasets.yaml, in words."""
    if recorded is None:
        return "no hash in datasets.yaml yet"
    if computed is None:
        return "incomplete"
    if computed == recorded:
        return EQUAL
    return TOLERATED if tolerated else UNLIKE


def told(words: str, size: Size) -> str:
    """Return words about hashes that name the file which records those of a split.

    >>> from lagbench.data.registry import load
    >>> told(EQUAL, load().size("cavity", "tiny"))
    'equal to datasets.yaml'
    """
    return words if size.simulated else words.replace(RECORD, DESCRIPTION)


def unlike_measures(size: Size, manifest: Manifest) -> list[str]:
    """Return the statistics, and the twin floor, of a manifest that datasets.yaml has otherwise.

    They follow from the bits, so a manifest that is complete and bitwise must have them.
    """
    measured = size.measured
    if measured is None or not manifest.complete or manifest.identity != "bitwise":
        return []
    names = sorted(measured.statistics.keys() | manifest.statistics.keys())
    unlike = [n for n in names if measured.statistics.get(n) != manifest.statistics.get(n)]
    return unlike + (["twin floor"] if manifest.mean_twin_floor() != measured.twin_floor else [])


def _may_differ(entry: FileEntry, manifest: Manifest) -> bool:
    return may_differ(entry.device, manifest.environments)


def _broken(what: str, where: str) -> DataError:
    return DataError(
        what,
        where=where,
        expected="the hashes in datasets.yaml",
        fix="see docs/determinism.md; `lagbench doctor` prints what a report needs",
    )


@dataclass(frozen=True, kw_only=True)
class SubsetReport:
    """What was found of one subset."""

    name: str  # name of the subset
    present: int  # scenarios that are there and right
    missing: tuple[int, ...]  # ids that are not there
    wrong: tuple[int, ...]  # ids whose file is damaged or has another hash
    extra: tuple[str, ...]  # files in the subset's folder that belong to no scenario
    verdict: str  # how its hash compares with datasets.yaml, in words


@dataclass(frozen=True, kw_only=True)
class VerificationResult:
    """What a verification found."""

    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the data set
    subsets: tuple[SubsetReport, ...]  # a report on each subset looked at
    # "bitwise", or "tolerance" where a device wrote files that does not keep the promise of equal bits;
    # "unknown" without a manifest
    identity: str
    dataset_sha256: str | None  # data set hash of the files, where all of them are there and right
    regenerated: Mapping[int, str]  # id to "identical", "different" or "nothing to compare with"
    problems: tuple[str, ...]  # what is wrong, each naming file and, where it can be told, variable
    warnings: tuple[str, ...]  # what a reader should know although it is no fault
    must_be_complete: bool  # whether a missing scenario is a fault
    verdict: str  # how the data set hash compares with datasets.yaml, in words
    fix: str  # what makes the data set whole again

    @property
    def complete(self) -> bool:
        """Whether nothing that was looked at is missing."""
        return not any(report.missing for report in self.subsets)

    def check(self) -> None:
        """Raise unless everything that has to hold does."""
        if self.problems:
            listing = "\n  ".join(self.problems)
            raise DataError(
                f"{len(self.problems)} problems\n  {listing}", where=str(self.folder), fix=self.fix
            )
        if not any(report.present for report in self.subsets):
            raise DataError("nothing is generated", where=str(self.folder), fix=self.fix)
        if self.must_be_complete and not self.complete:
            missing = ", ".join(f"{r.name} {spell_ids(r.missing)}" for r in self.subsets if r.missing)
            where, got = str(self.folder), f"missing: {missing}"
            raise DataError("the data set is incomplete", where=where, got=got, fix=self.fix)


def verify(
    split: str,
    size: str = "full",
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
    """Compare the files of a data set with datasets.yaml; call ``check()`` on the result.

    Args:
        split: name of the split.
        size: name of the size.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data folder.
        subset: some subsets only.
        scenarios: some ids only.
        regenerate: how many scenarios to simulate anew, evenly spaced, first and last included.
        complete: whether a missing scenario is a fault.
        workers: worker processes for ``regenerate``; one per core when None.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, subset or scenario, or fewer than one worker.
        WorkFailedError: simulating anew failed.
    """
    tier, folder, _ = locate(split, size, root=root, registry=registry)
    ids = select(tier, subset=subset, scenarios=scenarios)
    meter, cores = Meter(progress), worker_count(workers)
    if regenerate:
        check_installed("taichi", extra="generate")
    bring(tier, folder, ids, thoroughly=True)
    manifest, warnings = _manifest(folder, tier)
    findings = _examine_all(folder, tier, ids, manifest, meter)
    _note_test(folder, tier, findings)
    anew = _regenerate(tier, evenly_spaced(ids, regenerate), cores, meter)
    regenerated = {i: _likeness(tier, findings[i], content) for i, content in anew.items()}
    problems = [f.problem for f in findings.values() if f.problem]
    problems += [f"scenario {i} differs when simulated anew" for i in anew if regenerated[i] == DIFFERENT]
    # A killed writer leaves files here that the store never got.
    alone = unstored(tier, folder, [i for i in ids if findings[i].state is State.GOOD])
    problems += [f"scenario {i} is in the working copy alone, not in the store" for i in alone]
    reports = _reports(folder, tier, ids, findings)
    whole, verdict = _whole(tier, findings)
    unlike = told(UNLIKE, tier)
    problems += [f"{r.name}: its hash is {unlike}" for r in reports if r.verdict == unlike]
    problems += [f"the data set hash is {unlike}"] if verdict == unlike else []
    return VerificationResult(
        split=tier.split,
        size=size,
        folder=dataset_folder(folder, tier.split, size, tier.major),
        subsets=reports,
        identity=manifest.identity if manifest else "unknown",
        dataset_sha256=whole,
        regenerated=regenerated,
        problems=tuple(told(words, tier) for words in problems),
        warnings=tuple(
            told(words, tier) for words in (*warnings, *_gaps(reports), *_notes(tier, manifest, findings))
        ),
        must_be_complete=complete,
        verdict=verdict,
        fix=remedy(tier, root=folder),
    )


IDENTICAL = "identical"
DIFFERENT = "different"
INCOMPARABLE = "nothing to compare with"


def evenly_spaced(ids: Sequence[int], count: int) -> tuple[int, ...]:
    """Return some of the ids, evenly spaced, the first and the last included.

    >>> evenly_spaced(range(60), 3)
    (0, 30, 59)
    """
    count = min(count, len(ids))
    if count < 2:
        return tuple(ids[:count])
    last = len(ids) - 1
    return tuple(ids[(2 * k * last + count - 1) // (2 * (count - 1))] for k in range(count))


def _examine_all(
    root: Path, size: Size, ids: Sequence[int], manifest: Manifest | None, meter: Meter
) -> dict[int, Finding]:
    meter.begin("hashing", total=len(ids), scenarios=len(ids))
    findings = {}
    for scenario in ids:
        findings[scenario] = examine(root, size, scenario, manifest=manifest)
        meter.count(1, scenarios=1)
    return findings


def _note_test(root: Path, size: Size, findings: Mapping[int, Finding]) -> None:
    """Note which test files are right, so that the scorer need not hash their values again."""
    folder = dataset_folder(root, size.split, size.name, size.major)
    known = {i: findings[i].content_sha256 for i in size.subsets["test"] if i in findings}
    note(folder, {folder / "test" / f"{i:04d}.nc": content for i, content in known.items() if content})


def _manifest(root: Path, size: Size) -> tuple[Manifest | None, list[str]]:
    try:
        manifest = read_manifest(root, size.split, size.name, size.major)
    except DataError as error:
        return None, [str(error)]
    if manifest is None:
        return None, [f"there is no manifest: {remedy(size, root=root)}"]
    tolerance = "identity: tolerance - a device wrote these files that does not promise equal bits"
    return manifest, [tolerance] if manifest.identity == "tolerance" else []


def _regenerate(size: Size, ids: Sequence[int], workers: int, meter: Meter) -> dict[int, str]:
    """Simulate scenarios into a folder that vanishes; return their content hashes."""
    if not ids:
        return {}
    substeps = estimate(size, ids).substeps
    meter.begin("simulating anew", total=sum(substeps), scenarios=len(ids))
    hashes: dict[int, str] = {}
    with tempfile.TemporaryDirectory(prefix="lagbench-") as folder, Pool(min(workers, len(ids))) as pool:
        for scenario, cost in zip(ids, substeps, strict=True):
            job = SimulationJob(size=size, scenarios=(scenario,), root=Path(folder), device=Device.CPU)
            name = f"{size.split} {size.name}, scenario {scenario}"
            pool.submit(Task(name=name, function=simulate, arguments=(job,), cost=cost))
        for event in pool.events():
            if event.kind == "done":
                hashes |= {outcome.scenario: outcome.content_sha256 for outcome in event.value}
                meter.count(scenarios=1)
            else:
                meter.count(event.value if event.kind == "progress" else -event.value)
    return {scenario: hashes[scenario] for scenario in ids}


def _likeness(size: Size, finding: Finding, content: str) -> str:
    """Compare a scenario simulated anew with its file, else with datasets.yaml."""
    known = [finding.content_sha256] if finding.content_sha256 else []
    if finding.tolerated or not known:
        known += filter(None, [recorded_hash(size, finding.scenario)])
    if not known:
        return INCOMPARABLE
    return IDENTICAL if any(map(content.startswith, known)) else DIFFERENT


def _reports(
    root: Path, size: Size, ids: Sequence[int], findings: Mapping[int, Finding]
) -> tuple[SubsetReport, ...]:
    extra = extra_files(root, size)
    reports = []
    for name, members in size.subsets.items():
        held = {i: findings[i] for i in members if i in findings}
        if held:
            by_state = {state: tuple(i for i, f in held.items() if f.state is state) for state in State}
            reports.append(
                SubsetReport(
                    name=name,
                    present=len(by_state[State.GOOD]),
                    missing=by_state[State.MISSING],
                    wrong=by_state[State.WRONG],
                    extra=tuple(extra.get(name, ())),
                    verdict=_subset_verdict(size, name, findings),
                )
            )
    return tuple(reports)


def _subset_digest(size: Size, name: str, findings: Mapping[int, Finding]) -> str | None:
    """Return the hash of a subset; None unless every scenario of it is there and right."""
    hashes = {i: findings[i].content_sha256 for i in size.subsets[name] if i in findings}
    known = {i: content for i, content in hashes.items() if content is not None}
    return subset_hash(known) if len(known) == len(size.subsets[name]) else None


def _subset_verdict(size: Size, name: str, findings: Mapping[int, Finding]) -> str:
    recorded = size.measured.subset_sha256.get(name) if size.measured else None
    tolerated = any(findings[i].tolerated for i in size.subsets[name] if i in findings)
    return told(hash_verdict(_subset_digest(size, name, findings), recorded, tolerated=tolerated), size)


def _whole(size: Size, findings: Mapping[int, Finding]) -> tuple[str | None, str]:
    """Return the data set hash, where it can be told, and how it compares."""
    digests = {name: _subset_digest(size, name, findings) for name in HASHED_SUBSETS}
    known = {name: digest for name, digest in digests.items() if digest is not None}
    whole = dataset_hash(size.split, size.name, size.major, known) if len(known) == len(digests) else None
    recorded = size.measured.dataset_sha256 if size.measured else None
    tolerated = any(finding.tolerated for finding in findings.values())
    return whole, told(hash_verdict(whole, recorded, tolerated=tolerated), size)


def _gaps(reports: Sequence[SubsetReport]) -> list[str]:
    gaps = [f"{r.name} lacks {spell_ids(r.missing)}" for r in reports if r.missing]
    return gaps + [f"{r.name} has files of no scenario: {', '.join(r.extra)}" for r in reports if r.extra]


def _notes(size: Size, manifest: Manifest | None, findings: Mapping[int, Finding]) -> list[str]:
    """Return how files that are right differ from datasets.yaml, and the manifest from both."""
    tolerated = [i for i, finding in findings.items() if finding.tolerated]
    notes = [f"scenarios {spell_ids(tolerated)} have {TOLERATED}"] if tolerated else []
    if manifest is None:
        return notes
    entries = {entry.scenario: entry.content_sha256 for entry in manifest.files}
    unlike = [i for i, f in findings.items() if i in entries and f.content_sha256 not in (None, entries[i])]
    notes += [f"the manifest has other hashes of {spell_ids(unlike)}"] if unlike else []
    names = unlike_measures(size, manifest)
    return notes + ([f"the manifest has another {', '.join(names)} than datasets.yaml"] if names else [])
