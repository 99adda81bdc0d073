"""Our test scenarios and frames that stand for those of the thesis."""

from __future__ import annotations

from lagbench.data.registry import Size

# scenes repeat with the scenario's id: four families of shapes, six pairs of materials
_SCENE_COUNTS = {
    "fluid": 4,
    "multimaterial": 6,
}

_KEY_FRAMES = {"cavity": 54, "curl-noise": 40}
"""Frames at which the thesis compares models.

In the cavity it is frame 54, in curl noise the 35th after the last of six given ones.
"""


def scenario_of(size: Size, case: int) -> int | None:
    """Return our test scenario for a test case of the thesis; None without a like one.

    In a full box, case k is T_k of the thesis and our k-th test scenario. On the free
    surface a case is an id; our first test scenario of the same family of shapes, or
    pair of materials, stands for it.
    """
    test_scenarios = sorted(size.subsets["test"])
    scene_count = _SCENE_COUNTS.get(size.split)
    if scene_count is None:
        if case < len(test_scenarios):
            return test_scenarios[case]
        return None
    for scenario in test_scenarios:
        if scenario % scene_count == case % scene_count:
            return scenario
    return None


def key_frame(size: Size) -> int:
    """Return the frame of interest nearest to the key frame of the thesis."""
    frames = size.task.frames_of_interest
    thesis_frame = _KEY_FRAMES.get(size.split, frames[0])
    return min(frames, key=lambda frame: (abs(frame - thesis_frame), frame))
