"""Pictures and films of the scenarios of a split, found by the split's name.

:mod:`.plot` and :mod:`.animate` draw a scenario file that is given.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import check_output_file
from lagbench.data.layout import expand_home, has_file
from lagbench.data.local import locate, suggest_repair
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.store.copy import update_working_copy

from . import animate as films
from .canvas import DPI
from .plot import ALL, check_kind, plot_frame
from .recording import open_recording

if TYPE_CHECKING:
    from lagbench.data.registry import Registry

SCENARIO_ENDING = ".nc"  # of a source that is a file, not a split

VERSION_FOLDER = re.compile(r"v[0-9]+")
"""Name of the folder of one MAJOR version of a data set."""


def plot(
    source: str | Path,
    *,
    size: str | None = None,
    scenario: int | None = None,
    frame: int = -1,
    kind: str = ALL,
    output: str | Path | None = None,
    overwrite: bool = False,
    dpi: float = DPI,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Path:
    """Draw one frame of a scenario; return the path of the picture.

    Args:
        source: name of the split, path of a local split's folder, or a scenario file.
        size: name of the size; as :func:`lagbench.open_split` picks it when None.
        scenario: scenario id, where the source is a split; the first one of test when
            None.
        frame: absolute frame number; negative ones count from the end.
        kind: all (three panels), speed, material, vorticity or streamlines; in three
            dimensions also front or above. Of a free surface kind ``all`` shows these
            two.
        output: file to write, ending in .png, .pdf or .svg; named after the data in the
            working folder when None.
        overwrite: whether to replace a file of that name.
        dpi: pixels per inch.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, scenario, kind or frame, another ending, no
            such folder, a file that must not be replaced, no matplotlib.
        DataError: the scenario is not on this machine, or damaged.
        UnreadableFileError: the named file is no scenario file.
    """
    check_kind(kind)
    if _is_file(source):
        source = expand_home(source, "source")
    file = find_scenario(
        source, size=size, scenario=scenario, root=root, registry=registry
    )
    named_files = [source] if _is_file(source) else []
    with _blame_named_files(*named_files):
        if output is None:
            path = _frame_path(file, frame)
        else:
            path = expand_home(output, "output")
        require_place(path, overwrite=overwrite)
        return plot_frame(file, frame, path, kind=kind, dpi=dpi, registry=registry)


def animate(
    source: str | Path,
    *,
    size: str | None = None,
    scenario: int | None = None,
    beside: int | str | Path | None = None,
    kind: str | None = None,
    frames_per_second: float = 30.0,
    every: int = 1,
    output: str | Path | None = None,
    overwrite: bool = False,
    root: str | Path | None = None,
    quiet: bool = False,
    registry: Registry | None = None,
) -> Path:
    """Make a film of a scenario, or of two side by side; return its path.

    Args:
        source: name of the split, path of a local split's folder, or a scenario file.
        size: name of the size; as :func:`lagbench.open_split` picks it when None.
        scenario: scenario id, where the source is a split; the first one of test when
            None.
        beside: id of a second scenario of the split, or another scenario file.
        kind: speed, material or vorticity; material where there are several, else
            speed, when None.
        frames_per_second: frames shown per second [1/s], 0.01 to 1000.
        every: show every n-th frame.
        output: file to write, ending in .mp4 or .gif; named after the data in the
            working folder when None.
        overwrite: whether to replace a file of that name.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        quiet: show no progress; without a terminal on stderr none is shown anyway.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, scenario or kind, another ending, a rate out of
            bounds, no such folder, a file that must not be replaced, no matplotlib.
        DataError: a scenario is not on this machine, or damaged.
        UnreadableFileError: a named file is no scenario file.
        WorkFailedError: the video cannot be encoded or written.
    """
    if output is not None:
        films.check_ending(Path(output))
    if _is_file(source):
        source = expand_home(source, "source")
    file = find_scenario(
        source, size=size, scenario=scenario, root=root, registry=registry
    )
    second: Path | None = None
    named_files = [source] if _is_file(source) else []
    if isinstance(beside, str | Path):
        second = expand_home(beside, "beside")
        named_files.append(second)
    elif beside is not None:
        second = find_scenario(
            source,
            size=size,
            scenario=operator.index(beside),
            root=root,
            registry=registry,
        )
    if output is None:
        path = Path(f"{_data_name(file)}.mp4")
    else:
        path = expand_home(output, "output")
    require_place(path, overwrite=overwrite)
    with _blame_named_files(*named_files):
        return films.animate(
            file,
            path,
            beside=second,
            kind=kind,
            frames_per_second=frames_per_second,
            every=operator.index(every),
            quiet=quiet,
            registry=registry,
        )


def find_scenario(
    source: str | Path,
    *,
    size: str | None,
    scenario: int | None,
    root: str | Path | None,
    registry: Registry | None = None,
) -> Path:
    """Return the scenario file that a user names by its path, or by split and id.

    Raises:
        UsageError: no such split, size or scenario, or an id beside a file.
        DataError: the scenario is not on this machine.
    """
    if _is_file(source):
        if scenario is not None:
            raise UsageError(
                "a file holds one scenario, and an id names another",
                where="SPLIT|FILE and --scenario or --beside",
                expected="a file alone, or a split and an id",
                got=f"{source} and {scenario}",
                fix="leave the id out, or name the split instead of the file",
            )
        return Path(source)
    tier, folder, _ = locate(source, size, root=root, registry=registry)
    if scenario is None:
        scenario_id = tier.subsets["test"][0]
        repair = "--subset test"
    else:
        scenario_id = scenario
        repair = f"--scenarios {scenario}"
    tier.subset_of(scenario_id)  # refuses an id that the size does not have
    update_working_copy(tier, folder, [scenario_id])
    path = tier.path(folder, scenario_id)
    if not has_file(path):
        raise DataError(
            f"scenario {scenario_id} is not there",
            where=str(path),
            expected="a scenario file of this size",
            got="no such file",
            fix=suggest_repair(tier, repair, root=folder),
        )
    return path


def _is_file(source: str | Path) -> bool:
    """Return whether a user names a scenario file, not a split."""
    return str(source).endswith(SCENARIO_ENDING)


@contextmanager
def _blame_named_files(*names: str | Path) -> Iterator[None]:
    """Turn errors of damaged data into errors of the files that the user named.

    Raises:
        UnreadableFileError: a named file cannot be read or is no scenario file.
        DataError: a file of a data set is damaged.
    """
    try:
        yield
    except DataError as error:
        place = error.where or ""
        if not any(place.startswith(str(Path(name))) for name in names):
            raise
        raise UnreadableFileError(
            error.what,
            where=error.where,
            expected=error.expected
            or "a scenario file, as lagbench generate writes it",
            got=error.got,
            fix="name another file, or a split: lagbench plot cavity --size tiny; "
            "predictions are drawn by lagbench score FILE --report FOLDER",
        ) from error


def require_place(path: Path, *, overwrite: bool) -> None:
    """Refuse a path whose folder does not exist, or whose file must not be replaced.

    Raises:
        UsageError: there is no such folder, or there is such a file.
    """
    if not path.parent.is_dir():
        raise UsageError(
            "there is no such folder",
            where="--output",
            expected="a file in a folder that exists",
            got=path.parent,
            fix="create it first",
        )
    check_output_file(path, overwrite=overwrite)


def _frame_path(file: Path, frame: int) -> Path:
    with open_recording(file) as recording:
        frame_number = recording.frame_number(frame)
    return Path(f"{_data_name(file)}-frame{frame_number}.png")


def _data_name(file: Path) -> str:
    """Return split-size-scenario where the path names them, else the file's name."""
    parts = file.absolute().parts
    # A file of a data set lies at ROOT/SPLIT/SIZE/v1/SUBSET/SCENARIO.nc.
    if len(parts) > 5 and VERSION_FOLDER.fullmatch(parts[-3]):
        return f"{parts[-5]}-{parts[-4]}-{file.stem}"
    return file.stem
