"""Export a data set to what other code bases read, so that their models train on it unchanged."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.layout import ScenarioKey, scenario_path
from lagbench.data.local import locate, remedy
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size, spell_ids
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError, UsageError, nearest
from lagbench.generators.batch import solver_constants
from lagbench.store.bringing import bring
from lagbench.work.progress import Meter, Progress

from . import gns_npz, lagrangebench_h5
from .kinds import Format
from .metadata import NAME, describe, floor_of, write_metadata

__all__ = ["ExportResult", "export", "parse_format"]


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """What was written."""

    format: str  # name of the format
    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the files
    files: tuple[Path, ...]
    trajectories: dict[str, int]  # number of trajectories by subset
    frames: dict[str, int]  # frames by subset, over all trajectories
    left_out: int  # frames that are not in the files, because that format needs equal lengths
    bytes: int  # length of the files together [bytes]


def parse_format(name: str) -> Format:
    """Return a format by name."""
    known = [form.value for form in Format]
    if name not in known:
        raise UsageError(f"no format {name!r}", where="--format", fix=nearest(name, known))
    return Format(name)


def export(
    split: str,
    size: str = "full",
    *,
    format: str,
    output: str | Path,
    root: str | Path | None = None,
    from_walls: bool = False,
    force: bool = False,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> ExportResult:
    """Write train, valid and test of a data set, and metadata.json, in another format.

    A few frames are in memory at a time. The same data give the same bytes.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size.
        format: "gns-npz" or "lagrangebench-h5".
        output: folder for the files.
        root: folder of all data sets, see :func:`lagbench.data.layout.resolve_root`.
        from_walls: lagrangebench-h5 only: measure positions from the lower walls, so that the
            bounds that its models see are the walls; no bit is lost. Else positions are ours,
            and the bounds those of the unit box, which that program's neighbour search needs.
        force: write over an earlier export.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or format, files are there already, or a ``force.py`` is,
            which the program that reads lagrangebench-h5 would run.
        DataError: scenarios are missing or damaged, or their statistics are recorded nowhere.
        WorkFailedError: the disk is full or not writable.
    """
    form = parse_format(format)
    tier, home, splits = locate(split, size, root=root, registry=registry)
    folder, ending = Path(output), _ENDINGS[form]
    _claim_target(folder, [f"{subset}{ending}" for subset in HASHED_SUBSETS], force=force)
    bring(tier, home, [i for subset in HASHED_SUBSETS for i in tier.subsets[subset]])
    statistics, digest = _recorded(tier, home)
    paths = {subset: _paths(tier, home, subset) for subset in HASHED_SUBSETS}
    origin = _origin(tier, form, from_walls=from_walls)
    meter = Meter(progress)
    meter.begin("exporting", total=len(paths), scenarios=sum(map(len, paths.values())))
    shapes: dict[str, list[tuple[int, int]]] = {}
    for subset, files in paths.items():
        target = folder / f"{subset}{ending}"
        if form is Format.GNS_NPZ:
            shapes[subset] = gns_npz.write(target, files)
        else:
            length = min(map(_frames, files))
            shapes[subset] = lagrangebench_h5.write(target, files, length=length, origin=origin)
        meter.count(1, scenarios=len(files))
    metadata = describe(
        tier,
        form,
        shapes,
        statistics,
        title=splits.split(tier.split).title,
        dataset_sha256=digest,
        spacing=_spacing(paths["train"][0], tier),
        origin=origin,
        free_slip=_free_slip(tier),
    )
    written = (*(folder / f"{subset}{ending}" for subset in paths), write_metadata(folder, metadata))
    frames = {subset: sum(count for count, _ in rows) for subset, rows in shapes.items()}
    return ExportResult(
        format=form.value,
        split=tier.split,
        size=tier.name,
        folder=folder,
        files=written,
        trajectories={subset: len(rows) for subset, rows in shapes.items()},
        frames=frames,
        left_out=sum(_frames(path) for files in paths.values() for path in files) - sum(frames.values()),
        bytes=sum(path.stat().st_size for path in written),
    )


_ENDINGS = {Format.GNS_NPZ: gns_npz.ENDING, Format.LAGRANGEBENCH_H5: lagrangebench_h5.ENDING}


def _claim_target(folder: Path, names: Sequence[str], *, force: bool) -> None:
    """Refuse a folder that must not be written to; begin to write over an earlier export."""
    if (folder / lagrangebench_h5.FORCE).exists():
        raise UsageError(
            "the folder holds a program that readers of this format run",
            where=str(folder / lagrangebench_h5.FORCE),
            fix="name another folder: --output",
        )
    there = [name for name in (*names, NAME) if (folder / name).exists()]
    if there and not force:
        raise UsageError(
            "files of that name are there",
            where=str(folder),
            got=", ".join(there),
            fix="name another folder, or write over them: --force",
        )
    with contextlib.suppress(OSError):  # written last, it says that an export is whole
        (folder / NAME).unlink()


def _recorded(size: Size, root: Path) -> tuple[dict[str, tuple[float, ...]], str]:
    """Return statistics over train and data set hash: those of the registry, else of the manifest."""
    if size.measured:
        return dict(size.measured.statistics), size.measured.dataset_sha256
    manifest = read_manifest(root, size.split, size.name, size.major)
    if manifest is None or manifest.dataset_sha256 is None or not manifest.statistics:
        raise DataError(
            "the data set is not complete: the statistics of train are recorded nowhere",
            where=f"{size.split} {size.name} in {root}",
            fix=remedy(size, root=root),
        )
    return dict(manifest.statistics), manifest.dataset_sha256


def _paths(size: Size, root: Path, subset: str) -> list[Path]:
    """Return the files of a subset by id, after a look at each one's header."""
    ids = sorted(size.subsets[subset])
    keys = [
        ScenarioKey(split=size.split, size=size.name, version=size.version, scenario=i, subset=subset)
        for i in ids
    ]
    paths = [scenario_path(root, key) for key in keys]
    missing = [i for i, path in zip(ids, paths, strict=True) if not path.is_file()]
    if missing:
        raise DataError(
            f"{len(missing)} of {len(ids)} scenarios of {subset} are not there",
            where=str(paths[0].parent),
            got=f"missing: {spell_ids(missing)}",
            fix=remedy(size, f"--subset {subset}", root=root),
        )
    known = size.measured.scenario_sha256 if size.measured else {}
    for key, path in zip(keys, paths, strict=True):
        with read_scenario(path) as file:
            found = file.header
        if (found.key.major, found.key.scenario) != (key.major, key.scenario) or not (
            found.content_sha256.startswith(known.get(key.scenario, ""))
        ):
            raise DataError(
                "a scenario is not that of the registry",
                where=str(path),
                expected=f"scenario {key.scenario}, content hash {known.get(key.scenario, 'any')}",
                got=f"scenario {found.key.scenario}, content hash {found.content_sha256[:16]}",
                fix=f"lagbench verify --split {size.split} --size {size.name}",
            )
    return paths


def _frames(path: Path) -> int:
    with read_scenario(path) as file:
        return file.header.frames


def _spacing(path: Path, size: Size) -> float:
    """Return the distance of neighbouring particles at first [length]."""
    with read_scenario(path) as file:
        return math.sqrt(float(file.read("particle_mass")) / float(size.value("density")))


def _origin(size: Size, form: Format, *, from_walls: bool) -> tuple[float, float]:
    if not from_walls:
        return 0.0, 0.0
    if form is not Format.LAGRANGEBENCH_H5:
        raise UsageError("only lagrangebench-h5 needs it", where="--from-walls", got=form.value)
    (x, _), (y, _) = size.bounds
    return floor_of(x), floor_of(y)


def _free_slip(size: Size) -> bool:
    return not (size.simulated and getattr(solver_constants(size), "no_slip", False))
