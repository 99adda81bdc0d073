"""The models that the results speak of: baselines and variants, and the splits they are meant for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from .thesis import OPERATORS

__all__ = ["EXPECTED", "ROSTER", "SIZES", "Model", "label"]

SIZES = ("mini", "full")
"""Sizes that are reported; ``tiny`` is for tests."""


@dataclass(frozen=True, kw_only=True)
class Model:
    """A baseline, or a variant of one."""

    name: str  # as in gns-novorticity; it names folders of runs and entries of the board
    baseline: str  # what lagbench train --baseline is given
    label: str  # what tables call it
    settings: tuple[str, ...] = ()  # changes to the recipe, as in model.loss.vorticity=0
    recipe: str | None = None  # variant of the recipe, as in 'change'; None for the size's own


def _changing(name: str) -> Model:
    """Return a frame model that predicts the change per frame instead of the next state."""
    text = f"{_LABELS[name]} of changes"
    return Model(name=f"{name}-change", baseline=name, label=text, recipe="change")


_LABELS = {
    "supergat": "SuperGAT",
    "gat": "GAT",
    "pointnet": "PointNet",
    "gns": "GNS",
    "gatv2": "GATv2",
    "transformer": "graph transformer",
    "supergat-link": "SuperGAT with link loss",
    "mlp": "MLP",
    "lstm": "LSTM",
    "lstm-mlp": "LSTM + MLP",
    "var": "VAR(1)",
    "var-stable": "stable VAR",
}

ROSTER: Mapping[str, Model] = MappingProxyType(
    {name: Model(name=name, baseline=name, label=text) for name, text in _LABELS.items()}
    | {
        "gns-novorticity": Model(
            name="gns-novorticity",
            baseline="gns",
            label="GNS without vorticity loss",
            settings=("model.loss.vorticity=0",),
        ),
        "supergat-unlinked": Model(
            name="supergat-unlinked",
            baseline="supergat-link",
            label="SuperGAT with link loss of weight 0",
            settings=("model.link_weight=0",),
        ),
    }
    | {f"{name}-change": _changing(name) for name in ("mlp", "lstm", "lstm-mlp")}
)
"""Models by name."""

_GRAPHS = (*OPERATORS, "supergat-link", "supergat-unlinked", "gns-novorticity")
_FRAMES = ("mlp", "lstm", "lstm-mlp", "var", "var-stable")

EXPECTED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "cavity": (*_GRAPHS, "mlp", "lstm-mlp"),
        "curl-noise": (*_GRAPHS, "mlp", "lstm-mlp"),
        "fluid": _FRAMES,
        "multimaterial": _FRAMES,
    }
)
"""Names by split, in the order in which they are trained; other variants are shown where they are."""


def label(name: str) -> str:
    """Return what tables call a model; its name where the roster has none."""
    return ROSTER[name].label if name in ROSTER else name
