"""What a recording for Rerun's viewer holds, read back by Rerun."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import lagbench
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.errors import UsageError
from lagbench.exchange.viewing import view
from lagbench.make.generate import GenerationResult

chunk = pytest.importorskip("rerun.chunk")

SPLIT = "curl-noise"
PREDICTED = "/prediction/particles"


def positions(file: Path, entity: str) -> dict[int, NDArray[np.float32]]:
    """Return the points of an entity by frame, shape [particle, axis]."""
    points: dict[int, NDArray[np.float32]] = {}
    for part in chunk.RrdReader(file).stream():
        if part.entity_path != entity or part.is_static:
            continue
        batch = part.to_record_batch()
        (column,) = [name for name in batch.schema.names if "positions" in name]
        frames = batch.column("frame").to_pylist()
        for frame, rows in zip(frames, batch.column(column).to_pylist(), strict=True):
            points[frame] = np.array(rows, np.float32)
    return points


def write_still(generated: GenerationResult, path: Path) -> None:
    """Write predictions in which the last given frame stays."""
    data = lagbench.open_split(SPLIT, subset="test", size="tiny", root=generated.root)
    task = load().size(SPLIT, "tiny").task
    still = {}
    for scenario in data.scenario.values:
        last = data.position.sel(scenario=scenario)[task.input_frames - 1].values
        still[int(scenario)] = np.stack([last] * task.horizon)
    lagbench.submission.write(path, still, split=SPLIT, size="tiny", method="still")


def test_a_recording_holds_truth_and_prediction(
    generated: GenerationResult, tmp_path: Path
) -> None:
    """Rerun reads the positions of every frame, with y downwards as it draws."""
    size = load().size(SPLIT, "tiny")
    scenario = size.path(generated.root, size.subsets["test"][0])
    write_still(generated, tmp_path / "still.nc")
    file = tmp_path / "view.rrd"
    view(scenario, predictions=tmp_path / "still.nc", output=file)

    with read_scenario(scenario) as opened:
        expected = opened.read("position", slice(None))
    low, high = size.box.bounds[1]
    expected[..., 1] = low + high - expected[..., 1]
    truth = positions(file, "/truth/particles")
    assert sorted(truth) == list(range(size.frames))
    np.testing.assert_allclose(np.stack(list(truth.values())), expected, atol=1e-6)

    predicted = positions(file, PREDICTED)
    given = size.task.input_frames
    assert sorted(predicted) == list(range(given, given + size.task.horizon))
    for rows in predicted.values():
        np.testing.assert_allclose(rows, expected[given - 1], atol=1e-6)


def test_predictions_of_other_data_are_refused(
    generated: GenerationResult, tmp_path: Path
) -> None:
    size = load().size(SPLIT, "tiny")
    write_still(generated, tmp_path / "still.nc")
    train = size.path(generated.root, size.subsets["train"][0])
    with pytest.raises(UsageError):
        view(train, predictions=tmp_path / "still.nc", output=tmp_path / "view.rrd")
    assert not (tmp_path / "view.rrd").exists()
