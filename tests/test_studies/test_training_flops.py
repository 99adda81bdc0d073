"""Operations of trainings: counted on models whose steps can be counted by hand."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from simple_models import batch, info, swirl
from torch.utils.flop_counter import FlopCounterMode

from lagbench.baselines.neuralmpm import NeuralMPM
from studies.training_flops import count_window


def small_model(pushforward: int) -> NeuralMPM:
    """Return a small NeuralMPM that draws up to so many calls before its loss."""
    options: dict[str, Any] = {
        "cells": 10,
        "width": 8,
        "velocities": 2,
        "bundle": 2,
        "calls": 2,
        "materials": [0, 1, 2, 3],
        "pushforward": pushforward,
    }
    torch.manual_seed(0)
    return NeuralMPM.build(options, info())


@pytest.mark.parametrize("pushforward", [0, 1, 3])
def test_every_length_of_a_pushforward_counts_the_same(pushforward: int) -> None:
    """The loss takes two calls. From 0 to P calls, P / 2 in the mean, come before. All
    calls do the same on a grid, so their sum is a multiple of one counted call.
    """
    model = small_model(pushforward)
    window = batch(swirl(0, 13))
    given = window.part(slice(model.history))
    with torch.no_grad():
        state = model.start(given, average=False)
        with FlopCounterMode(display=False) as counter:
            model.call(state, average=False)
    of_one_call = counter.get_total_flops()
    assert of_one_call > 0
    expected = (2 + pushforward / 2) * of_one_call
    assert count_window(model, window) == pytest.approx(expected, rel=1e-12)
