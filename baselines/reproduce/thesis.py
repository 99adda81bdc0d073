"""Numbers that the thesis prints, by table: D. Dharma, PhD thesis, University of Leeds, 2025.

Models have our names: ``supergat`` is the thesis's own model ("OURS"), ``transformer`` its graph
transformer. Where the thesis contradicts itself, the reading that holds here is said beside
the number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

__all__ = [
    "FRAME_MODELS",
    "LOSS_SNAPSHOTS",
    "OPERATORS",
    "SECTION_4_8_3",
    "STATISTICS",
    "STUDIES",
    "TABLE_4_7",
    "TABLE_4_8",
    "TABLE_5_4",
    "Rollout",
    "Study",
    "VorticityRow",
]


@dataclass(frozen=True, kw_only=True)
class Study:
    """One row of Tables 4.2 to 4.5: an MLP from frame to frame."""

    table: str  # number of the table, as in "4.2"
    row: int  # number of the row, from 1
    widths: tuple[int, ...]  # units of the hidden layers
    activation: str  # elu, relu, tanh or sigmoid
    parameters: int  # as printed
    epochs: int  # passes over the data
    batch: int  # frames of an optimiser step
    train: float  # mean squared error of training [standardised^2]
    valid: float  # of validation


def _study(
    table: str,
    row: int,
    widths: tuple[int, ...],
    parameters: int,
    budget: tuple[int, int],
    errors: tuple[float, float],
    activation: str = "elu",
) -> Study:
    (epochs, batch), (train, valid) = budget, errors
    return Study(
        table=table,
        row=row,
        widths=widths,
        activation=activation,
        parameters=parameters,
        epochs=epochs,
        batch=batch,
        train=train,
        valid=valid,
    )


_4_2 = {
    "sigmoid": (0.1405, 0.1547),
    "tanh": (0.1312, 0.1467),
    "relu": (0.1161, 0.1204),
    "elu": (0.1131, 0.1187),
}
_4_3 = {
    100: (2_030_300, 0.1915, 0.1968),
    200: (4_090_600, 0.1147, 0.1194),
    400: (8_331_200, 0.0591, 0.0657),
    800: (17_292_400, 0.0290, 0.0362),
    1000: (22_013_000, 0.0235, 0.0309),
    1600: (37_134_800, 1.0036, 1.0247),
}
_4_4 = {
    3: (22_013_000, 0.0197, 0.0268),
    4: (23_014_000, 0.0185, 0.0267),
    5: (24_015_000, 0.0200, 0.0279),
    6: (25_016_000, 0.0241, 0.0306),
    7: (26_017_000, 0.0244, 0.0322),
}
_4_5 = (
    ((1000,) * 3, 22_013_000, 250, 0.0287, 0.0345),
    ((1000,) * 4, 23_014_000, 400, 0.0339, 0.0282),  # printed with the training error above the other
    ((2500, 1250, 1250, 2500), 57_830_000, 600, 0.0091, 0.0152),
    ((2500,) * 4, 68_770_000, 500, 0.0107, 0.0162),
)

STUDIES = (
    *(
        # the batch is not stated; that of Table 4.3 stands here
        _study("4.2", row, (200,) * 3, 4_090_600, (500, 512), errors, activation)
        for row, (activation, errors) in enumerate(_4_2.items(), start=1)
    ),
    *(
        _study("4.3", row, (width,) * 3, parameters, (200, 512), (train, valid))
        for row, (width, (parameters, train, valid)) in enumerate(_4_3.items(), start=1)
    ),
    *(
        _study("4.4", row, (1000,) * layers, parameters, (250, 1024), (train, valid))
        for row, (layers, (parameters, train, valid)) in enumerate(_4_4.items(), start=1)
    ),
    *(
        _study("4.5", row, widths, parameters, (epochs, 4096), (train, valid))
        for row, (widths, parameters, epochs, train, valid) in enumerate(_4_5, start=1)
    ),
)
"""Tables 4.2 to 4.5."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """One row of Table 4.8: errors of a rollout (Eqs. 4.17, 4.18) [standardised^2]."""

    scenario: int  # id in the thesis, and in our size 'full'
    scene: str  # what moves
    average: Mapping[str, float]  # average error by model
    end: Mapping[str, float]  # error at the last frame by model


FRAME_MODELS = ("mlp", "lstm", "lstm-mlp")


def _rollout(
    scenario: int, scene: str, average: tuple[float, float, float], end: tuple[float, float, float]
) -> Rollout:
    return Rollout(
        scenario=scenario,
        scene=scene,
        average=dict(zip(FRAME_MODELS, average, strict=True)),
        end=dict(zip(FRAME_MODELS, end, strict=True)),
    )


TABLE_4_7 = _rollout(26, "falling circle of liquid", (3.342, 3.583, 1.485), (2.127, 4.489, 0.222))
"""As printed; it swaps average and end of MLP and LSTM+MLP, see :data:`TABLE_4_8`, which holds."""

TABLE_4_8 = (
    _rollout(0, "falling rectangle of liquid", (4.413, 2.58, 0.58), (5.019, 3.74, 2.274)),
    _rollout(26, "falling circle of liquid", (2.127, 3.583, 0.222), (3.342, 4.489, 1.485)),
    _rollout(54, "liquid and snow", (2.344, 2.485, 1.019), (4.231, 3.891, 2.668)),
    _rollout(55, "rope and snow", (3.156, 3.132, 1.279), (3.521, 4.132, 2.886)),
    _rollout(56, "rope and liquid", (2.123, 2.987, 0.63), (4.124, 3.798, 2.775)),
    _rollout(57, "snow and snow", (3.891, 3.567, 1.571), (3.277, 4.235, 3.04)),
    _rollout(58, "rope and jelly ball", (3.325, 2.576, 0.998), (4.362, 3.234, 2.549)),
    _rollout(59, "liquid and liquid", (2.315, 3.478, 0.494), (3.897, 4.561, 2.756)),
)
"""Table 4.8: the first two are fluid, the others multimaterial."""

SECTION_4_8_3: Mapping[str, float] = MappingProxyType({"minutes": 33.0, "gigabytes": 19.0, "mse": 3.5e18})
"""VAR(1) of 10,000 dimensions: time, virtual memory, error of the forecast (section 4.8.3)."""


@dataclass(frozen=True, kw_only=True)
class VorticityRow:
    """One row of Tables 5.4 and 5.5 and Fig. 5.13: test scenario T0 of the cavity at frame 54."""

    mae: float  # mean absolute error of the vorticity [1/frame]
    mse: float  # mean squared error
    rmse: float  # its root
    kl: float  # divergence of the magnitudes per node [nat]
    pearson: float  # correlation with the truth


def _vorticity(mae: float, mse: float, rmse: float, kl: float, pearson: float) -> VorticityRow:
    return VorticityRow(mae=mae, mse=mse, rmse=rmse, kl=kl, pearson=pearson)


TABLE_5_4: Mapping[str, VorticityRow] = MappingProxyType(
    {
        "supergat": _vorticity(0.007715, 0.000151, 0.012297, 0.127755, 0.956670),
        "gat": _vorticity(0.010443, 0.000289, 0.017006, 0.354617, 0.918301),
        "pointnet": _vorticity(0.012597, 0.000420, 0.020484, 0.296943, 0.885932),
        "gns": _vorticity(0.009757, 0.000449, 0.021191, 0.172230, 0.883097),
        "gatv2": _vorticity(0.011476, 0.000447, 0.021138, 0.269795, 0.877435),
        "transformer": _vorticity(0.014519, 0.000724, 0.026903, 0.391100, 0.811620),
    }
)
"""Tables 5.4 and 5.5 and the correlations of Fig. 5.13, in the order of Table 5.4."""

OPERATORS = tuple(TABLE_5_4)
"""The six operators, as in the thesis without a link loss."""

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

LOSS_SNAPSHOTS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "step 507": {
            "acceleration": 0.035660,
            "velocity": 0.000256,
            "density": 0.017083963,
            "position": 0.0,
            "divergence": 0.120924,
            "vorticity": 0.127761,
            "total": 0.301686,
        },
        "end": {
            "acceleration": 0.16061589,
            "velocity": 0.000623,
            "density": 0.0268355,
            "position": 0.0000000249,
            "divergence": 0.25397250,
            "vorticity": 0.2022085,
            "total": 0.64425,
        },
    }
)
"""Raw terms of the loss on curl-noise (section 5.9.3, Fig. 5.21); the total rises: no yardstick."""
