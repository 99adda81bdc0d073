"""Numbers that the thesis prints, models that results speak of, our scenarios that
stand for its own.

D. Dharma, PhD thesis, University of Leeds, 2025. Models have our names: ``supergat`` is
the thesis's own model ("OURS"), ``transformer`` its graph transformer. Where the thesis
contradicts itself, the reading that holds here is said beside the number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from lagbench.data.registry import Size
from lagbench.figures.colours import MUTED


@dataclass(frozen=True)
class Study:
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


STUDIES = (
    # the batch of Table 4.2 is not stated; that of Table 4.3 stands here
    Study("4.2", 1, (200,) * 3, 4_090_600, 500, 512, 0.1405, 0.1547, "sigmoid"),
    Study("4.2", 2, (200,) * 3, 4_090_600, 500, 512, 0.1312, 0.1467, "tanh"),
    Study("4.2", 3, (200,) * 3, 4_090_600, 500, 512, 0.1161, 0.1204, "relu"),
    Study("4.2", 4, (200,) * 3, 4_090_600, 500, 512, 0.1131, 0.1187, "elu"),
    Study("4.3", 1, (100,) * 3, 2_030_300, 200, 512, 0.1915, 0.1968),
    Study("4.3", 2, (200,) * 3, 4_090_600, 200, 512, 0.1147, 0.1194),
    Study("4.3", 3, (400,) * 3, 8_331_200, 200, 512, 0.0591, 0.0657),
    Study("4.3", 4, (800,) * 3, 17_292_400, 200, 512, 0.0290, 0.0362),
    Study("4.3", 5, (1000,) * 3, 22_013_000, 200, 512, 0.0235, 0.0309),
    Study("4.3", 6, (1600,) * 3, 37_134_800, 200, 512, 1.0036, 1.0247),
    Study("4.4", 1, (1000,) * 3, 22_013_000, 250, 1024, 0.0197, 0.0268),
    Study("4.4", 2, (1000,) * 4, 23_014_000, 250, 1024, 0.0185, 0.0267),
    Study("4.4", 3, (1000,) * 5, 24_015_000, 250, 1024, 0.0200, 0.0279),
    Study("4.4", 4, (1000,) * 6, 25_016_000, 250, 1024, 0.0241, 0.0306),
    Study("4.4", 5, (1000,) * 7, 26_017_000, 250, 1024, 0.0244, 0.0322),
    Study("4.5", 1, (1000,) * 3, 22_013_000, 250, 4096, 0.0287, 0.0345),
    Study(
        "4.5", 2, (1000,) * 4, 23_014_000, 400, 4096, 0.0339, 0.0282
    ),  # training printed above validation
    Study("4.5", 3, (2500, 1250, 1250, 2500), 57_830_000, 600, 4096, 0.0091, 0.0152),
    Study("4.5", 4, (2500,) * 4, 68_770_000, 500, 4096, 0.0107, 0.0162),
)
"""Tables 4.2 to 4.5."""

FRAME_MODELS = ("mlp", "lstm", "lstm-mlp")


@dataclass(frozen=True)
class Rollout:
    """One row of Table 4.8: errors (Eqs. 4.17, 4.18) of :data:`FRAME_MODELS`
    [standardised^2].
    """

    scenario: int  # id in the thesis, and in our size full
    scene: str  # what moves
    average: tuple[float, float, float]
    end: tuple[float, float, float]  # at the last frame


TABLE_4_7 = Rollout(
    26, "falling circle of liquid", (3.342, 3.583, 1.485), (2.127, 4.489, 0.222)
)
"""As printed; it swaps average and end of MLP and LSTM+MLP, see :data:`TABLE_4_8`,
which holds.
"""

TABLE_4_8: Mapping[str, tuple[Rollout, ...]] = MappingProxyType(
    {
        "fluid": (
            Rollout(
                0,
                "falling rectangle of liquid",
                (4.413, 2.58, 0.58),
                (5.019, 3.74, 2.274),
            ),
            Rollout(
                26,
                "falling circle of liquid",
                (2.127, 3.583, 0.222),
                (3.342, 4.489, 1.485),
            ),
        ),
        "multimaterial": (
            Rollout(
                54, "liquid and snow", (2.344, 2.485, 1.019), (4.231, 3.891, 2.668)
            ),
            Rollout(55, "rope and snow", (3.156, 3.132, 1.279), (3.521, 4.132, 2.886)),
            Rollout(56, "rope and liquid", (2.123, 2.987, 0.63), (4.124, 3.798, 2.775)),
            Rollout(57, "snow and snow", (3.891, 3.567, 1.571), (3.277, 4.235, 3.04)),
            Rollout(
                58, "rope and jelly ball", (3.325, 2.576, 0.998), (4.362, 3.234, 2.549)
            ),
            Rollout(
                59, "liquid and liquid", (2.315, 3.478, 0.494), (3.897, 4.561, 2.756)
            ),
        ),
    }
)
"""Table 4.8 by split."""

SECTION_4_8_3: Mapping[str, float] = MappingProxyType(
    {"minutes": 33.0, "gigabytes": 19.0, "mse": 3.5e18}
)
"""VAR(1) of 10,000 dimensions: time, virtual memory, error of the forecast (section
4.8.3).
"""

_MEASURES = ("mae", "mse", "rmse", "kl", "pearson")

TABLE_5_4: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        name: dict(zip(_MEASURES, row, strict=True))
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
"""Tables 5.4 and 5.5 and the correlations of Fig. 5.13 in the order of Table 5.4:
vorticity of test case T0 of the cavity at frame 54. MAE and RMSE [1/frame], divergence
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
"""Raw terms of the loss on curl-noise (section 5.9.3, Fig. 5.21); the total rises: no
yardstick.
"""

SIZES = ("mini", "full")  # sizes that are reported; ``tiny`` is for tests


@dataclass(frozen=True)
class Model:
    """A baseline, or a variant of one, that results speak of."""

    # as in gns-novorticity; it names folders of runs and entries of the board
    name: str
    label: str  # what tables call it
    colour: str = MUTED
    varied: str = ""  # baseline of which it is a variant
    # changes to the recipe, as in model.loss.vorticity=0
    settings: tuple[str, ...] = ()
    # variant of the recipe, as in change; None for the size's own
    recipe: str | None = None
    # model whose weights its entry runs with these settings, empty for its own; a
    # reproduction trains anew
    weights: str = ""

    @property
    def baseline(self) -> str:
        """What ``lagbench train --baseline`` is given."""
        return self.varied or self.name


_MODELS = (
    # Okabe & Ito (2008) and shades of them; SuperGAT is red, as in the thesis
    Model("supergat", "SuperGAT", "#d55e00"),
    Model("gat", "GAT", "#56b4e9"),
    Model("pointnet", "PointNet", "#009e73"),
    Model("gns", "GNS", "#b0569a"),
    Model("gatv2", "GATv2", "#0072b2"),
    Model("transformer", "graph transformer", "#e69f00"),
    Model(
        "supergat-unlinked",
        "SuperGAT without link loss",
        "#d9a46a",
        "supergat",
        ("model.link_weight=0",),
    ),
    Model(
        "supergat-unsummed",
        "SuperGAT without summed messages",
        "#8c3b00",
        "supergat",
        ("model.sum_messages=false",),
    ),
    Model("supergat-sd", "SuperGAT, scaled dot product"),
    Model(
        "gns-novorticity",
        "GNS without vorticity loss",
        "#e3b4d6",
        "gns",
        ("model.loss.vorticity=0",),
    ),
    Model(
        "gns-tenfold",
        "GNS, ten times the vorticity loss",
        varied="gns",
        settings=("model.loss.vorticity=10",),
    ),
    Model(
        "gns-velocity",
        "GNS of velocities",
        varied="gns",
        settings=("model.target=velocity",),
    ),
    Model("gns-l1", "GNS, L1 loss", varied="gns", settings=("model.loss_norm=l1",)),
    Model(
        "gns-unrolled", "GNS, loss over three steps", varied="gns", recipe="unrolled"
    ),
    Model("neuralmpm", "NeuralMPM", "#000000"),
    Model(
        "neuralmpm-long",
        "NeuralMPM from its own rollouts",
        varied="neuralmpm",
        recipe="long",
    ),
    Model(
        "neuralmpm-unmixed",
        "NeuralMPM, materials apart",
        varied="neuralmpm",
        settings=("model.mixture=false",),
    ),
    Model(
        "neuralmpm-unrolled",
        "NeuralMPM, 16 frames unrolled",
        varied="neuralmpm",
        recipe="unrolled",
    ),
    Model(
        "neuralmpm-averaged",
        "NeuralMPM, mean over images",
        varied="neuralmpm",
        settings=("model.average=true",),
        weights="neuralmpm",
    ),
    Model(
        "neuralmpm-long-averaged",
        "NeuralMPM from its own rollouts, mean over images",
        varied="neuralmpm",
        settings=("model.average=true",),
        recipe="long",
        weights="neuralmpm-long",
    ),
    Model(
        "neuralmpm-conserving",
        "NeuralMPM, momentum conserved",
        varied="neuralmpm",
        recipe="conserving",
    ),
    Model(
        "neuralmpm-conserving-averaged",
        "NeuralMPM, momentum conserved, mean over images",
    ),
    Model(
        "neuralmpm-conserving-of-mini", "NeuralMPM, momentum conserved, trained at mini"
    ),
    Model(
        "neuralmpm-projected",
        "NeuralMPM, held in shape",
        varied="neuralmpm",
        recipe="projected",
    ),
    Model("neuralmpm-projected-averaged", "NeuralMPM, held in shape, mean over images"),
    Model("neuralmpm-projected-of-mini", "NeuralMPM, held in shape, trained at mini"),
    Model(
        "neuralmpm-projected-started",
        "NeuralMPM, held in shape, started from another size",
    ),
    Model(
        "neuralmpm-projected-started-averaged",
        "NeuralMPM, held in shape, started from another size, mean over images",
    ),
    Model(
        "neuralmpm-projected-finer",
        "NeuralMPM, held in shape by finer grids, started from another size",
    ),
    Model(
        "neuralmpm-projected-finer-averaged",
        "NeuralMPM, held in shape by finer grids, started from another size, mean "
        "over images",
    ),
    Model("neuralmpm-longer", "NeuralMPM from its own rollouts, for longer"),
    Model(
        "neuralmpm-longer-averaged",
        "NeuralMPM from its own rollouts, for longer, mean over images",
    ),
    Model("neuralmpm-started", "NeuralMPM, started from another size"),
    Model(
        "neuralmpm-started-averaged",
        "NeuralMPM, started from another size, mean over images",
    ),
    Model("neuralmpm-wide", "NeuralMPM, 48 channels"),
    Model("neuralmpm-wide-averaged", "NeuralMPM, 48 channels, mean over images"),
    Model("neuralmpm-of-mini", "NeuralMPM trained at mini"),
    Model("neuralmpm-of-mini-averaged", "NeuralMPM trained at mini, mean over images"),
    Model("mlp", "MLP", "#0072b2"),
    Model("lstm", "LSTM", "#009e73"),
    Model("lstm-mlp", "LSTM + MLP", "#d55e00"),
    Model("mlp-change", "MLP of changes", varied="mlp", recipe="change"),
    Model("lstm-change", "LSTM of changes", varied="lstm", recipe="change"),
    Model(
        "lstm-mlp-change", "LSTM + MLP of changes", varied="lstm-mlp", recipe="change"
    ),
    Model("var", "VAR(1)", "#7f7f7f"),
    Model("var-stable", "stable VAR", "#b0569a"),
)

# models by name
ROSTER: Mapping[str, Model] = MappingProxyType({model.name: model for model in _MODELS})

_EVERYWHERE = ("neuralmpm", *OPERATORS, *FRAME_MODELS, "var", "var-stable")
_ABLATIONS = ("supergat-unlinked", "supergat-unsummed", "gns-novorticity")
_STUDIES = ("gns-velocity", "gns-l1", "gns-tenfold", "gns-unrolled", "supergat-sd")

EXPECTED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "cavity": (*_EVERYWHERE, *_ABLATIONS),
        "curl-noise": (*_EVERYWHERE, *_ABLATIONS, *_STUDIES),
        "fluid": _EVERYWHERE,
        "multimaterial": _EVERYWHERE,
    }
)
"""Names by split, in the order in which they are trained; other variants are shown
where they are.

The studies of sections 5.6.2, 5.9.3 and 6.2 are rows of curl-noise, the split of
section 5.9.3.
"""


def label(name: str | None) -> str:
    """Return what tables call a model, its name where the roster has none; None is the
    truth.
    """
    if name is None:
        return "truth"
    return ROSTER[name].label if name in ROSTER else name


def colour(name: str) -> str:
    """Return a model's colour."""
    if name in ROSTER:
        return ROSTER[name].colour
    return MUTED


# scenes repeat with the id: four families, six pairs
_FAMILIES = {
    "fluid": 4,
    "multimaterial": 6,
}

_KEY_FRAMES = {"cavity": 54, "curl-noise": 40}
"""Frames at which the thesis compares models: 54; and 35 after the last of six given
ones.
"""


def scenario_of(size: Size, case: int) -> int | None:
    """Return the test scenario that stands for one of the thesis; None where there is
    none alike.

    In a full box cases are T0, T1, ...: ours in ascending order. On the free surface
    they are ids, for which our first test scenario of the same family or pair stands.
    """
    test = sorted(size.subsets["test"])
    families = _FAMILIES.get(size.split)
    if families is None:
        if case < len(test):
            return test[case]
        return None
    return next((i for i in test if i % families == case % families), None)


def key_frame(size: Size) -> int:
    """Return the frame of interest nearest to the one at which the thesis compares
    models.
    """
    frames = size.task.frames_of_interest
    wanted = _KEY_FRAMES.get(size.split, frames[0])
    return min(frames, key=lambda frame: (abs(frame - wanted), frame))


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many digits, a dash where there is none.

    >>> number(0.00012345), number(None), number(12345678.0)
    ('0.000123', '-', '1.23e+07')
    """
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.{digits}g}"


def interval(mean: float, bounds: tuple[float, float]) -> str:
    """Return a mean and its 95 % interval over scenarios, as in "0.12 (0.1 to
    0.15)".
    """
    low, high = bounds
    return number(mean) + (
        "" if math.isnan(low) else f" ({number(low)} to {number(high)})"
    )
