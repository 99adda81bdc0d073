"""Numbers that the thesis prints: D. Dharma, PhD thesis, University of Leeds, 2025.

Models have our names: ``supergat`` is the thesis's own model ("OURS"), ``transformer``
is its graph transformer. Where the thesis contradicts itself, a comment beside the
number says which reading is used here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class MLPStudy:
    """One row of Tables 4.2 to 4.5: an MLP from frame to frame."""

    table: str  # its number, as in "4.2"
    row: int  # from 1
    widths: tuple[int, ...]  # units of the hidden layers
    parameters: int  # as printed
    epochs: int
    batch: int  # frames of an optimiser step
    train: float  # mean squared error of training [standardised^2]
    valid: float  # of validation
    activation: str = "elu"


MLP_STUDIES = (
    # the batch of Table 4.2 is not stated; that of Table 4.3 stands here
    MLPStudy("4.2", 1, (200,) * 3, 4_090_600, 500, 512, 0.1405, 0.1547, "sigmoid"),
    MLPStudy("4.2", 2, (200,) * 3, 4_090_600, 500, 512, 0.1312, 0.1467, "tanh"),
    MLPStudy("4.2", 3, (200,) * 3, 4_090_600, 500, 512, 0.1161, 0.1204, "relu"),
    MLPStudy("4.2", 4, (200,) * 3, 4_090_600, 500, 512, 0.1131, 0.1187, "elu"),
    MLPStudy("4.3", 1, (100,) * 3, 2_030_300, 200, 512, 0.1915, 0.1968),
    MLPStudy("4.3", 2, (200,) * 3, 4_090_600, 200, 512, 0.1147, 0.1194),
    MLPStudy("4.3", 3, (400,) * 3, 8_331_200, 200, 512, 0.0591, 0.0657),
    MLPStudy("4.3", 4, (800,) * 3, 17_292_400, 200, 512, 0.0290, 0.0362),
    MLPStudy("4.3", 5, (1000,) * 3, 22_013_000, 200, 512, 0.0235, 0.0309),
    MLPStudy("4.3", 6, (1600,) * 3, 37_134_800, 200, 512, 1.0036, 1.0247),
    MLPStudy("4.4", 1, (1000,) * 3, 22_013_000, 250, 1024, 0.0197, 0.0268),
    MLPStudy("4.4", 2, (1000,) * 4, 23_014_000, 250, 1024, 0.0185, 0.0267),
    MLPStudy("4.4", 3, (1000,) * 5, 24_015_000, 250, 1024, 0.0200, 0.0279),
    MLPStudy("4.4", 4, (1000,) * 6, 25_016_000, 250, 1024, 0.0241, 0.0306),
    MLPStudy("4.4", 5, (1000,) * 7, 26_017_000, 250, 1024, 0.0244, 0.0322),
    MLPStudy("4.5", 1, (1000,) * 3, 22_013_000, 250, 4096, 0.0287, 0.0345),
    # the thesis prints a training error above the validation error
    MLPStudy("4.5", 2, (1000,) * 4, 23_014_000, 400, 4096, 0.0339, 0.0282),
    MLPStudy("4.5", 3, (2500, 1250, 1250, 2500), 57_830_000, 600, 4096, 0.0091, 0.0152),
    MLPStudy("4.5", 4, (2500,) * 4, 68_770_000, 500, 4096, 0.0107, 0.0162),
)
"""Tables 4.2 to 4.5."""

FRAME_MODELS = ("mlp", "lstm", "lstm-mlp")


@dataclass(frozen=True)
class RolloutErrors:
    """One row of Table 4.8: errors of the frame models, in the order of FRAME_MODELS.

    Eqs. 4.17 and 4.18 define the average and the end [standardised^2].
    """

    scenario: int  # id in the thesis, and in our size full
    scene: str  # what moves
    average: tuple[float, float, float]
    end: tuple[float, float, float]  # at the last frame


TABLE_4_7 = RolloutErrors(
    26, "falling circle of liquid", (3.342, 3.583, 1.485), (2.127, 4.489, 0.222)
)
"""Table 4.7 as printed.

It swaps average and end of MLP and LSTM + MLP against :data:`TABLE_4_8`, whose reading
is used here.
"""

TABLE_4_8: Mapping[str, tuple[RolloutErrors, ...]] = MappingProxyType(
    {
        "fluid": (
            RolloutErrors(
                0,
                "falling rectangle of liquid",
                (4.413, 2.58, 0.58),
                (5.019, 3.74, 2.274),
            ),
            RolloutErrors(
                26,
                "falling circle of liquid",
                (2.127, 3.583, 0.222),
                (3.342, 4.489, 1.485),
            ),
        ),
        "multimaterial": (
            RolloutErrors(
                54, "liquid and snow", (2.344, 2.485, 1.019), (4.231, 3.891, 2.668)
            ),
            RolloutErrors(
                55, "rope and snow", (3.156, 3.132, 1.279), (3.521, 4.132, 2.886)
            ),
            RolloutErrors(
                56, "rope and liquid", (2.123, 2.987, 0.63), (4.124, 3.798, 2.775)
            ),
            RolloutErrors(
                57, "snow and snow", (3.891, 3.567, 1.571), (3.277, 4.235, 3.04)
            ),
            RolloutErrors(
                58, "rope and jelly ball", (3.325, 2.576, 0.998), (4.362, 3.234, 2.549)
            ),
            RolloutErrors(
                59, "liquid and liquid", (2.315, 3.478, 0.494), (3.897, 4.561, 2.756)
            ),
        ),
    }
)
"""Table 4.8 by split."""

SECTION_4_8_3: Mapping[str, float] = MappingProxyType(
    {"minutes": 33.0, "gigabytes": 19.0, "mse": 3.5e18}
)
"""VAR(1) of 10,000 dimensions (section 4.8.3): time, virtual memory, forecast error."""

MEASURES = ("mae", "mse", "rmse", "kl", "pearson")
"""Measures of vorticity in Tables 5.4 and 5.5 and Fig. 5.13."""

TABLE_5_4: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        name: dict(zip(MEASURES, row, strict=True))
        for name, row in {
            "supergat": (0.007715, 0.000151, 0.012297, 0.127755, 0.956670),
            "gat": (0.010443, 0.000289, 0.017006, 0.354617, 0.918301),
            "pointnet": (0.012597, 0.000420, 0.020484, 0.296943, 0.885932),
            "gns": (0.009757, 0.000449, 0.021191, 0.172230, 0.883097),
            "gatv2": (0.011476, 0.000447, 0.021138, 0.269795, 0.877435),
            "transformer": (0.014519, 0.000724, 0.026903, 0.391100, 0.811620),
        }.items()
    }
)
"""Tables 5.4 and 5.5 and the correlations of Fig. 5.13, in the order of Table 5.4.

Vorticity of test case T0 of the cavity at frame 54: MAE and RMSE [1/frame], divergence
of the magnitudes per node [nat], correlation.
"""

OPERATORS = tuple(TABLE_5_4)  # the six operators

STATISTICS: Mapping[str, Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "curl-noise": {
            "position_mean": (0.499, 0.4999),
            "position_std": (0.272, 0.272),
            "velocity_mean": (-1.8180e-05, 4.789e-07),
            "velocity_std": (1.600e-03, 1.600e-03),
            "acceleration_mean": (-3.116e-09, 7.532e-08),
            "acceleration_std": (7.334e-05, 7.315e-05),
        },
        "cavity": {
            "velocity_mean": (-3.5108e-05, -2.6359e-06),
            "velocity_std": (0.002191, 0.002195),
            "acceleration_mean": (8.5449e-10, 1.3844e-07),
            "acceleration_std": (9.9393e-05, 9.9605e-05),
        },
    }
)
"""Tables 5.1 (taken as curl-noise) and 5.3 (cavity), per frame."""

_TERMS = (
    "acceleration",
    "velocity",
    "density",
    "position",
    "divergence",
    "vorticity",
    "total",
)

LOSS_SNAPSHOTS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        when: dict(zip(_TERMS, values, strict=True))
        for when, values in {
            "step 507": (
                0.035660,
                0.000256,
                0.017083963,
                0.0,
                0.120924,
                0.127761,
                0.301686,
            ),
            "end": (
                0.16061589,
                0.000623,
                0.0268355,
                0.0000000249,
                0.25397250,
                0.2022085,
                0.64425,
            ),
        }.items()
    }
)
"""Raw terms of the loss on curl-noise (section 5.9.3, Fig. 5.21).

The total rises during the training, so it cannot rank models.
"""
