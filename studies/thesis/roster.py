"""The models that the results speak of: their names, labels, colours and recipes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from lagbench.figures.colours import MUTED

from .published import FRAME_MODELS, OPERATORS

SIZES = ("mini", "full")
"""Sizes that are reported; ``tiny`` is for tests."""


@dataclass(frozen=True)
class RosterModel:
    """A reference model, or a variant of one, that the results speak of."""

    name: str  # names folders of runs and entries of the board: gns-novorticity
    label: str  # how tables show it
    colour: str = MUTED
    variant_of: str = ""  # the reference model that it varies; empty for itself
    settings: tuple[str, ...] = ()  # changed options: model.loss.vorticity=0
    recipe: str | None = None  # variant of the recipe; None for the size's own
    # model whose weights the entry uses with these settings; empty for its own weights
    weights_of: str = ""

    @property
    def baseline(self) -> str:
        """The argument of ``lagbench train --baseline``."""
        return self.variant_of or self.name


_MODELS = (
    # Okabe & Ito (2008) and shades of them; SuperGAT is red, as in the thesis
    RosterModel("supergat", "SuperGAT", "#d55e00"),
    RosterModel("gat", "GAT", "#56b4e9"),
    RosterModel("pointnet", "PointNet", "#009e73"),
    RosterModel("gns", "GNS", "#b0569a"),
    RosterModel("gatv2", "GATv2", "#0072b2"),
    RosterModel("transformer", "graph transformer", "#e69f00"),
    RosterModel(
        "supergat-unlinked",
        "SuperGAT without link loss",
        "#d9a46a",
        "supergat",
        ("model.link_weight=0",),
    ),
    RosterModel(
        "supergat-unsummed",
        "SuperGAT without summed messages",
        "#8c3b00",
        "supergat",
        ("model.sum_messages=false",),
    ),
    RosterModel("supergat-sd", "SuperGAT, scaled dot product"),
    RosterModel(
        "gns-novorticity",
        "GNS without vorticity loss",
        "#e3b4d6",
        "gns",
        ("model.loss.vorticity=0",),
    ),
    RosterModel(
        "gns-tenfold",
        "GNS, ten times the vorticity loss",
        variant_of="gns",
        settings=("model.loss.vorticity=10",),
    ),
    RosterModel(
        "gns-velocity",
        "GNS of velocities",
        variant_of="gns",
        settings=("model.target=velocity",),
    ),
    RosterModel(
        "gns-l1", "GNS, L1 loss", variant_of="gns", settings=("model.loss_norm=l1",)
    ),
    RosterModel(
        "gns-unrolled",
        "GNS, loss over three steps",
        variant_of="gns",
        recipe="unrolled",
    ),
    RosterModel(
        "gns-spread",
        "GNS, noise of all levels",
        variant_of="gns",
        settings=("model.noise_std=1e-3", "model.noise_spread=true"),
        recipe="pushforward",
    ),
    RosterModel("gns-free-flight", "GNS, free flight"),
    RosterModel("neuralmpm", "NeuralMPM", "#000000"),
    RosterModel(
        "neuralmpm-long",
        "NeuralMPM from its own rollouts",
        variant_of="neuralmpm",
        recipe="long",
    ),
    RosterModel(
        "neuralmpm-unmixed",
        "NeuralMPM, materials apart",
        variant_of="neuralmpm",
        settings=("model.mixture=false",),
    ),
    RosterModel(
        "neuralmpm-unrolled",
        "NeuralMPM, 16 frames unrolled",
        variant_of="neuralmpm",
        recipe="unrolled",
    ),
    RosterModel(
        "neuralmpm-averaged",
        "NeuralMPM, mirror-averaged",
        variant_of="neuralmpm",
        settings=("model.average=true",),
        weights_of="neuralmpm",
    ),
    RosterModel(
        "neuralmpm-long-averaged",
        "NeuralMPM from its own rollouts, mirror-averaged",
        variant_of="neuralmpm",
        settings=("model.average=true",),
        recipe="long",
        weights_of="neuralmpm-long",
    ),
    RosterModel(
        "neuralmpm-conserving",
        "NeuralMPM, momentum conserved",
        variant_of="neuralmpm",
        recipe="conserving",
    ),
    RosterModel(
        "neuralmpm-conserving-averaged",
        "NeuralMPM, momentum conserved, mirror-averaged",
    ),
    RosterModel(
        "neuralmpm-conserving-of-mini", "NeuralMPM, momentum conserved, trained at mini"
    ),
    RosterModel(
        "neuralmpm-projected",
        "NeuralMPM, shape matching",
        variant_of="neuralmpm",
        recipe="projected",
    ),
    RosterModel(
        "neuralmpm-projected-averaged", "NeuralMPM, shape matching, mirror-averaged"
    ),
    RosterModel(
        "neuralmpm-projected-of-mini", "NeuralMPM, shape matching, trained at mini"
    ),
    RosterModel(
        "neuralmpm-projected-started",
        "NeuralMPM, shape matching, started from another size",
    ),
    RosterModel(
        "neuralmpm-projected-started-averaged",
        "NeuralMPM, shape matching, started from another size, mirror-averaged",
    ),
    RosterModel(
        "neuralmpm-projected-finer",
        "NeuralMPM, shape matching on finer grids, started from another size",
    ),
    RosterModel(
        "neuralmpm-projected-finer-averaged",
        "NeuralMPM, shape matching on finer grids, started from another size, mirror-"
        "averaged",
    ),
    RosterModel("neuralmpm-longer", "NeuralMPM from its own rollouts, for longer"),
    RosterModel(
        "neuralmpm-longer-averaged",
        "NeuralMPM from its own rollouts, for longer, mirror-averaged",
    ),
    RosterModel("neuralmpm-started", "NeuralMPM, started from another size"),
    RosterModel(
        "neuralmpm-started-averaged",
        "NeuralMPM, started from another size, mirror-averaged",
    ),
    RosterModel("neuralmpm-wide", "NeuralMPM, 48 channels"),
    RosterModel("neuralmpm-wide-averaged", "NeuralMPM, 48 channels, mirror-averaged"),
    RosterModel("neuralmpm-of-mini", "NeuralMPM trained at mini"),
    RosterModel(
        "neuralmpm-of-mini-averaged", "NeuralMPM trained at mini, mirror-averaged"
    ),
    RosterModel("mlp", "MLP", "#0072b2"),
    RosterModel("lstm", "LSTM", "#009e73"),
    RosterModel("lstm-mlp", "LSTM + MLP", "#d55e00"),
    RosterModel("mlp-change", "MLP of changes", variant_of="mlp", recipe="change"),
    RosterModel("lstm-change", "LSTM of changes", variant_of="lstm", recipe="change"),
    RosterModel(
        "lstm-mlp-change",
        "LSTM + MLP of changes",
        variant_of="lstm-mlp",
        recipe="change",
    ),
    RosterModel("hybrid-projection", "hybrid projection solver"),
    RosterModel("hybrid-coarse", "hybrid coarse solver"),
    RosterModel("var", "VAR(1)", "#7f7f7f"),
    RosterModel("var-stable", "stable VAR", "#b0569a"),
)


def _with_pushforward(name: str) -> RosterModel:
    """Return the variant of an operator that is trained from states of rollouts."""
    plain = next(model for model in _MODELS if model.name == name)
    return RosterModel(
        f"{name}-{PUSHFORWARD}",
        f"{plain.label}, pushforward",
        plain.colour,
        variant_of=name,
        recipe=PUSHFORWARD,
    )


PUSHFORWARD = "pushforward"
"""Variant of the recipes that graph networks pass their gates with."""

ROSTER: Mapping[str, RosterModel] = MappingProxyType(
    {model.name: model for model in (*_MODELS, *map(_with_pushforward, OPERATORS))}
)
"""Models by name."""

WITHOUT_DRAWS = ("var", "var-stable", "hybrid-projection", "hybrid-coarse")
"""Models whose fit draws nothing: every seed gives the same weights."""

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
"""Names of the models that each split should have, in the order of training.

The splits are those of the thesis. Other variants are shown where they have scores. The
studies of sections 5.6.2, 5.9.3 and 6.2 belong to curl-noise, the split of section
5.9.3.
"""


NEWER_SPLITS = (
    "decaying-vortices",
    "poiseuille",
    "cylinder",
    "cavity-3d",
    "curl-noise-3d",
    "fluid-3d",
    "multimaterial-3d",
)
"""Splits with entries that the thesis does not have: no claim is tested on them."""


def label(name: str | None) -> str:
    """Return how tables show a model; None is the truth.

    A name that the roster does not have is shown as it is.
    """
    if name is None:
        return "truth"
    if name in ROSTER:
        return ROSTER[name].label
    return name


def colour(name: str) -> str:
    """Return the colour of a model."""
    if name in ROSTER:
        return ROSTER[name].colour
    return MUTED
