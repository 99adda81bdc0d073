"""A scenario as a recording of Rerun, a viewer of scenes in time.

The truth stands beside a prediction: particles by speed, and the vorticity on the score
grid (in three dimensions its magnitude in one plane across z). Needs
``pip install 'lagbench[view]'``.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.box import Box
from lagbench.errors import UsageError, require
from lagbench.figures.colours import MATERIAL_COLOURS, PAPER, WALL, parse_rgb
from lagbench.figures.recording import Recording, Scene, open_recording
from lagbench.submission.predictions import Predictions, open_predictions

NEGATIVE = parse_rgb(MATERIAL_COLOURS[0])
POSITIVE = parse_rgb(MATERIAL_COLOURS[1])
ZERO = parse_rgb(PAPER)

SAMPLES = 12  # frames that set the colour scale, spread over the scenario
SCALE_QUANTILE = 0.99  # share of the values that the colour scale has room for


def view(
    scenario: str | Path,
    *,
    predictions: str | Path | None = None,
    output: str | Path | None = None,
    every: int = 1,
) -> None:
    """Show a scenario in Rerun's viewer, or write it to a file for the viewer.

    Args:
        scenario: scenario file.
        predictions: a predictions.nc of this scenario, shown beside the truth.
        output: file to write, which `rerun FILE` opens; the viewer starts when None.
        every: show every n-th frame.

    Raises:
        UsageError: the predictions are of another data set or lack the scenario, or
            rerun is not installed.
        DataError: the scenario file is missing or damaged.
        UnreadableFileError: the predictions cannot be read.
    """
    rerun = require("rerun", extra="view")
    with ExitStack() as stack:
        recording = stack.enter_context(open_recording(scenario))
        predicted = None
        if predictions is not None:
            predicted = stack.enter_context(open_predictions(predictions))
            _check_scenario(predicted, recording)

        size = recording.size
        name = f"{size.split} {size.name} {recording.scenario}"
        stream = stack.enter_context(rerun.RecordingStream(f"lagbench {name}"))
        if output is None:
            stream.spawn()
        else:
            stream.save(stack.enter_context(atomic_path(Path(output))))
        sides = ["truth"]
        if predicted is not None:
            sides.append("prediction")
        stream.send_blueprint(_lay_out(sides, is_solid=recording.is_solid))
        for side in sides:
            stream.log(f"{side}/particles/box", _outline(size.box), static=True)
        speed_limit, vorticity_limit = _colour_limits(recording)

        for number in range(0, recording.frames, every):
            truth = recording.scene(number)
            scenes = {"truth": truth}
            if predicted is not None and number in predicted.header.frames:
                scenes["prediction"] = _predicted_scene(truth, predicted)
            stream.set_time("frame", sequence=number)
            stream.set_time("time", duration=truth.time)
            for side, scene in scenes.items():
                colours = shade(scene.speed, speed_limit)
                stream.log(f"{side}/particles", _points(scene, colours))
                image = shade(scene.vorticity, vorticity_limit)
                # rows of an image run downwards, columns along x
                rows = image.swapaxes(0, 1)[::-1]
                stream.log(f"{side}/vorticity", rerun.Image(rows))


def _check_scenario(predicted: Predictions, recording: Recording) -> None:
    header = predicted.header
    size = recording.size
    is_same = (header.split, header.size) == (size.split, size.name)
    if not is_same or recording.scenario not in header.scenarios:
        raise UsageError(
            f"no prediction of scenario {recording.scenario} of {size.split} "
            f"{size.name}; name a file that has it",
            where=str(predicted.path),
        )


def _lay_out(sides: list[str], *, is_solid: bool) -> Any:  # noqa: ANN401 (rerun is optional)
    """Return the views: particles above, vorticity below, truth at the left."""
    blueprint = require("rerun.blueprint", extra="view")
    space = blueprint.Spatial3DView if is_solid else blueprint.Spatial2DView
    views = []
    for side in sides:
        origin = f"{side}/particles"
        views.append(space(origin=origin, name=f"{side}: speed"))
    for side in sides:
        origin = f"{side}/vorticity"
        flat = blueprint.Spatial2DView(origin=origin, name=f"{side}: vorticity")
        views.append(flat)
    grid = blueprint.Grid(*views, grid_columns=len(sides))
    return blueprint.Blueprint(grid, collapse_panels=True)


def _outline(box: Box) -> Any:  # noqa: ANN401 (rerun is optional)
    """Return the walls, so that all views show the same part of space."""
    rerun = require("rerun", extra="view")
    boxes = rerun.Boxes3D if box.dimension == 3 else rerun.Boxes2D
    return boxes(centers=[box.centre], sizes=[box.lengths], colors=parse_rgb(WALL))


def _colour_limits(recording: Recording) -> tuple[float, float]:
    """Return where the colour scales of speed [length/s] and vorticity [1/s] end."""
    speeds = []
    vorticities = []
    for number in np.linspace(0, recording.frames - 1, SAMPLES).astype(int):
        scene = recording.scene(int(number))
        speeds.append(scene.speed)
        vorticities.append(np.abs(scene.vorticity).ravel())
    limits = []
    for values in (np.concatenate(speeds), np.concatenate(vorticities)):
        known = values[np.isfinite(values)]
        limits.append(float(np.quantile(known, SCALE_QUANTILE)) if known.size else 0.0)
    return limits[0], limits[1]


def _predicted_scene(truth: Scene, predicted: Predictions) -> Scene:
    """Return the prediction of the frame of a scene, with the truth's particles."""
    scenario = truth.recording.scenario
    size = truth.recording.size
    position = predicted.frames(scenario, truth.frame, 1)[0].astype(np.float64)
    if truth.frame - 1 in predicted.header.frames:
        before = predicted.frames(scenario, truth.frame - 1, 1)[0].astype(np.float64)
    else:
        before = truth.recording.scene(truth.frame - 1).position
    displacement = size.box.displacement(before, position)
    return replace(
        truth,
        position=position,
        displacement=displacement,
        velocity=displacement / size.frame_interval,
    )


def _points(scene: Scene, colours: NDArray[np.uint8]) -> Any:  # noqa: ANN401 (rerun is optional)
    """Return a scene's particles as Rerun draws them, with y upwards."""
    rerun = require("rerun", extra="view")
    radius = scene.recording.spacing / 2
    if scene.recording.is_solid:
        return rerun.Points3D(scene.position, colors=colours, radii=radius)
    box = scene.recording.size.box
    upwards = scene.position.copy()
    upwards[:, 1] = box.low[1] + box.high[1] - upwards[:, 1]
    return rerun.Points2D(upwards, colors=colours, radii=radius)


def shade(values: NDArray[np.float64], limit: float) -> NDArray[np.uint8]:
    """Return a colour per value: blue at minus the limit, white at 0, red at the limit.

    A value that is not known is white.

    Args:
        values: any shape.
        limit: magnitude of the full colours; 0 leaves all white.

    Returns:
        Red, green and blue, shape [..., 3].

    >>> shade(np.array([-2.0, 0.0, 1.0]), 1.0)
    array([[  0, 114, 178],
           [255, 255, 255],
           [213,  94,   0]], dtype=uint8)
    """
    share = np.zeros_like(values)
    if limit > 0:
        share = np.clip(np.nan_to_num(values / limit), -1.0, 1.0)
    strength = np.abs(share)[..., None]
    full = np.where(share[..., None] < 0, NEGATIVE, POSITIVE)
    colours = ZERO + strength * (full.astype(float) - ZERO)
    return np.rint(colours).astype(np.uint8)
