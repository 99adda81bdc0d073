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
from lagbench.data.layout import expand_home
from lagbench.data.local import locate, suggest_repair
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.store.copy import update_working_copy

from . import animate as films
from .canvas import DPI, check_picture_name, save
from .plot import ALL, check_kind, draw_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
) -> Figure:
    """Draw one frame of a scenario; a notebook shows the figure.

    Args:
        source: name of the split, path of a local split's folder, or a scenario file.
        size: name of the size; as :func:`lagbench.open_split` picks it when None.
        scenario: scenario id, where the source is a split; the first one of test when
            None.
        frame: absolute frame number; negative ones count from the end.
        kind: all (three panels), speed, material, vorticity or streamlines; in three
            dimensions also front or above. Of a free surface kind ``all`` shows these
            two.
        output: file to write too, ending in .png, .pdf or .svg.
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
    file = find_scenario(
        source, size=size, scenario=scenario, root=root, registry=registry
    )
    path = None
    if output is not None:
        path = check_picture_name(expand_home(output, "output"))
        require_place(path, overwrite=overwrite)
    with _blame_named_files(source):
        drawn = draw_frame(file, frame, kind=kind, dpi=dpi, registry=registry)
    if path is not None:
        save(drawn, path)
    return drawn


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
    file = find_scenario(
        source, size=size, scenario=scenario, root=root, registry=registry
    )
    second: Path | None = None
    if isinstance(beside, str | Path):
        second = expand_home(beside, "beside")
    elif beside is not None:
        second = find_scenario(
            source,
            size=size,
            scenario=operator.index(beside),
            root=root,
            registry=registry,
        )
    if output is None:
        path = Path(f"{data_name(file)}.mp4")
    else:
        path = expand_home(output, "output")
    films.check_ending(path)
    require_place(path, overwrite=overwrite)
    with _blame_named_files(source, beside):
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
                f"{source} holds one scenario, and {scenario} names another; leave one "
                "of them out"
            )
        return expand_home(source, "source")
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
    if not path.is_file():
        fix = suggest_repair(tier, repair, root=folder)
        raise DataError(f"scenario {scenario_id} is not there: no {path}; {fix}")
    return path


def _is_file(source: str | Path) -> bool:
    """Return whether a user names a scenario file, not a split."""
    return str(source).endswith(SCENARIO_ENDING)


@contextmanager
def _blame_named_files(*sources: object) -> Iterator[None]:
    """Turn errors of damaged data into errors of the files that the user named.

    Raises:
        UnreadableFileError: a named file cannot be read or is no scenario file.
        DataError: a file of a data set is damaged.
    """
    try:
        yield
    except DataError as error:
        place = error.where or ""
        for source in sources:
            if isinstance(source, str | Path) and place.startswith(str(source)):
                raise UnreadableFileError(error.text, where=error.where) from error
        raise


def require_place(path: Path, *, overwrite: bool) -> None:
    """Refuse a path whose folder does not exist, or whose file must not be replaced.

    Raises:
        UsageError: there is no such folder, or there is such a file.
    """
    if not path.parent.is_dir():
        raise UsageError(
            f"there is no folder {path.parent}; create it first", where="--output"
        )
    check_output_file(path, overwrite=overwrite)


def data_name(file: Path) -> str:
    """Return split-size-scenario where the path names them, else the file's name."""
    parts = file.absolute().parts
    # A file of a data set lies at ROOT/SPLIT/SIZE/v1/SUBSET/SCENARIO.nc.
    if len(parts) > 5 and VERSION_FOLDER.fullmatch(parts[-3]):
        return f"{parts[-5]}-{parts[-4]}-{file.stem}"
    return file.stem
