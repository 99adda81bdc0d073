"""Pictures of the scenarios of a split, found by the split's name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import check_output_file
from lagbench.data.layout import expand_home
from lagbench.data.local import locate, suggest_repair
from lagbench.errors import DataError, UsageError
from lagbench.store.copy import update_working_copy

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
    """
    check_kind(kind)
    file = find_scenario(
        source, size=size, scenario=scenario, root=root, registry=registry
    )
    path = None
    if output is not None:
        path = check_picture_name(expand_home(output, "output"))
        require_place(path, overwrite=overwrite)
    drawn = draw_frame(file, frame, kind=kind, dpi=dpi, registry=registry)
    if path is not None:
        save(drawn, path)
    return drawn


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
    if str(source).endswith(SCENARIO_ENDING):
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
