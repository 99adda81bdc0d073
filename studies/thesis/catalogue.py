"""The catalogue of reproduced tables, sections and figures, chapter by chapter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from . import figures, tables, var_protocol
from .items import ThesisItem
from .published import FRAME_MODELS, OPERATORS

# templates that several items share; a row of the catalogue states the differences
_STUDY = ThesisItem(title="", draw=tables.studies, needs={"fluid": ()})
_LOSSES = replace(_STUDY, draw=tables.study_losses)
_ROLLOUTS = ThesisItem(
    title="Rollouts, scene by scene",
    draw=tables.rollouts,
    needs={"fluid": FRAME_MODELS},
)
_PARTICLES = ThesisItem(
    title="Particles of rollouts",
    draw=figures.panels,
    needs={"multimaterial": ("lstm-mlp",)},
    whole=True,
    panels=("material",),
    metrics=("mse_avg", "mse_end", "position_rmse", "shape_error", "connectivity"),
)
_STATISTICS = ThesisItem(
    title="Statistics of train",
    draw=tables.statistics,
    remark="The velocities are scaled so that their deviation at size full is within "
    "5 % of the thesis's. Means are 0 in a full box. Accelerations are reported, not "
    "tuned.",
)
_VORTICITY = ThesisItem(
    title="Vorticity errors at frame 54",
    draw=tables.vorticity,
    needs={"cavity": OPERATORS},
    remark="The flow is not the thesis's own. Vorticity is per frame; we assume the "
    "same unit in the thesis.",
)
_BARS = replace(
    _VORTICITY, draw=tables.vorticity_bars, needs={"cavity": OPERATORS}, remark=""
)
_HISTOGRAMS = replace(
    _BARS,
    title="Histograms of vorticity",
    draw=figures.histograms,
    metrics=("vorticity_kl_hist",),
    remark="Thesis: SuperGAT's histogram follows the truth's best, PointNet's is "
    "broadest.",
)
_RESIDUALS = replace(
    _BARS,
    title="Residuals of vorticity",
    draw=figures.residuals,
    metrics=tuple(
        f"vorticity_residual_{m}" for m in ("mean", "std", "max", "p05", "p95", "slope")
    ),
    remark="Thesis: SuperGAT's residuals are the smallest and spread evenly about "
    "zero.",
)
_MAPS = replace(
    _BARS,
    title="Maps of vorticity and velocity",
    draw=figures.panels,
    metrics=("vorticity_pearson",),
)
_CURVES = replace(
    _BARS,
    title="Vorticity error over frames",
    draw=figures.model_curves,
    metrics=("vorticity_mse",),
)
_ENERGY = replace(_CURVES, title="Kinetic energy over frames")
_FLOW = ThesisItem(
    title="Quiver and streamlines of rollouts",
    draw=figures.panels,
    needs={"curl-noise": ("supergat",)},
    # 1, 5, 10, 20, 30 and 40 after the last given frame, as the thesis counts
    frames=(6, 10, 15, 25, 35, 45),
    metrics=("velocity_rmse",),
    remark="Thesis: predictions follow the truth closely, with deviations late and "
    "near the walls.",
)

_ITEMS = {
    "table_3_1": ThesisItem(
        title="Solver time over the quality factor; Fig. 3.1",
        draw=tables.times,
        remark="For rows 1-9 add `--device cuda`.",
    ),
    "section_3_2_2": ThesisItem(
        title="Model time over the number of particles",
        draw=tables.times,
        remark="Thesis: the time of a surrogate should grow linearly, that of the "
        "solver faster.",
    ),
    "table_4_2": replace(_STUDY, title="Activations of an MLP", studies="table_4_2"),
    "table_4_3": replace(_STUDY, title="Widths of an MLP", studies="table_4_3"),
    "table_4_4": replace(
        _STUDY,
        title="Depths of an MLP",
        studies="table_4_4",
        needs={"multimaterial": ()},
    ),
    "table_4_5": replace(
        _STUDY,
        title="MLPs on more data",
        studies="table_4_5",
        needs={"multimaterial": ()},
    ),
    "table_4_7": replace(
        _ROLLOUTS,
        remark="Table 4.7 prints MLP and LSTM + MLP with average and end swapped "
        "against Table 4.8. We use Table 4.8: a growing error has an average below its "
        "end.",
    ),
    "table_4_8": replace(
        _ROLLOUTS,
        needs={"fluid": FRAME_MODELS, "multimaterial": FRAME_MODELS},
        remark="Error of Eq. 4.16 over (x, y, u, v), each standardised by the "
        "statistics of train; average over the rollout (Eq. 4.17) and at its last "
        "frame (Eq. 4.18). A cell is ours / the thesis's.",
    ),
    "section_4_8_3": ThesisItem(
        title="VAR(1) on whole frames", draw=var_protocol.draw, needs={"fluid": ()}
    ),
    "fig_4_4": replace(
        _LOSSES,
        title="Training loss by activation",
        studies="table_4_2",
        remark="Thesis: ELU falls lowest within 500 epochs, ReLU close behind.",
    ),
    "fig_4_5": replace(
        _LOSSES,
        title="Training and validation by activation",
        studies="table_4_2",
        remark="Thesis: the gap between training and validation is small for every "
        "activation.",
    ),
    "fig_4_6": replace(
        _LOSSES,
        title="Training loss and error by width",
        studies="table_4_3",
        remark="Thesis: more neurons, lower error; 3 x 1600 becomes unstable after 96 "
        "epochs.",
    ),
    "fig_4_8": ThesisItem(
        title="Training loss of the chosen MLP",
        draw=figures.losses,
        needs={"fluid": ("mlp",), "multimaterial": ("mlp",)},
    ),
    "fig_4_11": replace(
        _PARTICLES,
        needs={"fluid": ("lstm-mlp", "mlp", "lstm")},
        cases=(26,),
        remark="Thesis: LSTM + MLP keeps trajectory and shape; MLP drifts to a wrong "
        "state at the end; LSTM keeps the trajectory and loses the shape.",
    ),
    "fig_4_12": replace(
        _PARTICLES,
        cases=(54,),
        remark="Thesis: deformation of liquid and snow is kept; small surface waves "
        "end slightly too soon.",
    ),
    "fig_4_13": replace(
        _PARTICLES,
        cases=(57, 56, 58),
        remark="Thesis: snow and snow accurate; the rope in liquid keeps its coarse "
        "shape and comes apart in places; the jelly ball bounces rightly and disperses "
        "while it moves fast.",
    ),
    "table_5_1": replace(_STATISTICS, needs={"curl-noise": ()}),
    "table_5_3": replace(_STATISTICS, needs={"cavity": ()}),
    "table_5_4": replace(_VORTICITY, metrics=("mae", "mse", "rmse")),
    "table_5_5": replace(_VORTICITY, metrics=("mae", "mse", "rmse", "kl")),
    "fig_5_5": replace(
        _MAPS,
        needs={"cavity": ("gns-novorticity", "gns")},
        panels=("vorticity", "streamlines"),
        remark="Thesis: without the vorticity loss GNS develops fewer or weaker "
        "vortices than the truth; with it they align significantly better. Ours: one "
        "model, one budget, weight 0 and 0.1.",
    ),
    "fig_5_10": replace(
        _CURVES,
        draw=figures.case_curves,
        needs={"cavity": ("supergat",)},
        remark="Thesis: six test cases, below 0.0002 for the first 40 frames and "
        "below 0.0004 up to frame 80, growing almost linearly.",
    ),
    "fig_5_11": replace(
        _CURVES,
        remark="Thesis: SuperGAT lowest in nearly every frame of T0, GNS second with "
        "occasional spikes.",
    ),
    "fig_5_12": replace(
        _HISTOGRAMS,
    ),
    "fig_5_13": replace(
        _BARS, title="Correlation at frame 54", metrics=("vorticity_pearson",)
    ),
    "fig_5_14": replace(_RESIDUALS, panels=("truth",)),
    "fig_5_15": replace(_RESIDUALS, panels=("nodes",)),
    "fig_5_16": replace(
        _BARS, title="KL divergence at frame 54", metrics=("vorticity_kl",)
    ),
    "fig_5_17": replace(
        _MAPS,
        panels=("vorticity", "speed"),
        remark="Thesis: SuperGAT has the lowest error in vorticity and velocity.",
    ),
    "fig_5_18": replace(_HISTOGRAMS, frames=(6, 9, 18, 21, 48, 51)),
    "fig_5_19": replace(
        _ENERGY,
        metrics=("energy_retention", "energy_retention_true", "energy_error"),
        remark="Thesis: SuperGAT keeps most energy, then GNS; PointNet and the graph "
        "transformer least (of checkpoints of unequal budgets). More energy than the "
        "truth is an error too: see the column beside.",
    ),
    "fig_5_21": ThesisItem(
        title="Training loss on curl noise, the weighted sum that is learned from",
        draw=figures.losses,
        needs={"curl-noise": OPERATORS},
        remark="Thesis: the sum of six terms, without weights, is 0.302 at step 507 "
        "and 0.644 at the end: it rises, so it cannot rank models.",
    ),
    "fig_5_22": replace(_FLOW, panels=("quiver",)),
    "fig_5_23": replace(_FLOW, cases=(0, 3), panels=("streamlines",)),
    "fig_5_24": replace(
        _MAPS,
        needs=_FLOW.needs,
        panels=("speed", "streamlines"),
        remark="Thesis: SuperGAT's rollout, 35 frames after the last given one.",
    ),
    "fig_5_25": replace(
        _MAPS,
        needs=_FLOW.needs,
        frames=_FLOW.frames[:-1],
        panels=("vorticity",),
        remark="Thesis: close 1 and 5 frames after the last given one; from 10 to 30 "
        "magnitudes and places of vortices differ more and more.",
    ),
    "fig_5_26": replace(_FLOW, cases=(1, 2), panels=("quiver", "streamlines")),
    "fig_5_27": replace(_FLOW, cases=(3, 4), panels=("quiver", "streamlines")),
    "fig_5_28": replace(
        _ENERGY,
        needs={"curl-noise": OPERATORS},
        metrics=("energy_predicted", "energy_true", "energy_error"),
        remark="Thesis: SuperGAT keeps most energy, then GAT, GATv2, GNS, and the "
        "graph transformer least.",
    ),
}

ITEMS: Mapping[str, ThesisItem] = MappingProxyType(
    {name: replace(item, name=name) for name, item in _ITEMS.items()}
)
"""Tables, sections and figures by name."""
