"""Every table and figure that is reproduced: what it shows, what it needs, what makes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from . import (
    distributions,
    flow_panels,
    frame_curves,
    learning_curves,
    maps,
    mlp_studies,
    particle_strips,
    residuals,
    section_4_8_3,
    statistics_tables,
    table_3_1,
    table_4_8,
    table_5_4,
)
from .plan import Plan
from .sheet import Sheet
from .thesis import FRAME_MODELS, OPERATORS

__all__ = ["ITEMS", "Item"]

Needs = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True, kw_only=True)
class Item:
    """A table or figure."""

    name: str  # as in table_5_4
    title: str  # what the thesis shows there
    make: Callable[[Plan], Sheet]  # returns it
    needs: Needs  # models whose scored runs it needs, by split
    studies: tuple[str, ...]  # tables of MLPs whose trainings it needs
    splits: tuple[str, ...]  # splits that it is about


def _item(
    name: str,
    title: str,
    make: Callable[[Plan, str], Sheet],
    needs: Needs | None = None,
    *,
    studies: tuple[str, ...] = (),
    splits: tuple[str, ...] = (),
) -> Item:
    needed = needs or {}
    about = (*needed, *splits, *(mlp_studies.TABLES[study][1] for study in studies))
    return Item(
        name=name,
        title=title,
        make=lambda plan: make(plan, name),
        needs=needed,
        studies=studies,
        splits=tuple(dict.fromkeys(about)),
    )


CAVITY: Needs = {"cavity": OPERATORS}
CURL: Needs = {"curl-noise": OPERATORS}
OURS: Needs = {"curl-noise": ("supergat",)}
FRAMES: Needs = {"fluid": FRAME_MODELS, "multimaterial": FRAME_MODELS}


def _items() -> Iterator[Item]:
    yield _item("table_3_1", "Solver time over the quality factor; Fig. 3.1", table_3_1.pointed)
    studies = {
        "table_4_2": "Activations of an MLP",
        "table_4_3": "Widths of an MLP",
        "table_4_4": "Depths of an MLP",
        "table_4_5": "MLPs on more data",
    }
    for name, title in studies.items():
        yield _item(name, title, mlp_studies.tables, studies=(name,))
    for name, source, title in (
        ("fig_4_4", "table_4_2", "Training loss by activation"),
        ("fig_4_5", "table_4_2", "Training and validation by activation"),
        ("fig_4_6", "table_4_3", "Training loss and error by width"),
    ):
        yield _item(name, title, learning_curves.draw_figure, studies=(source,))
    mlp = {"fluid": ("mlp",), "multimaterial": ("mlp",)}
    yield _item("fig_4_8", "Training loss of the chosen MLP", learning_curves.draw_figure, mlp)
    yield _item("table_4_7", "Rollouts on liquid", table_4_8.tables, {"fluid": FRAME_MODELS})
    yield _item("table_4_8", "Rollouts, scene by scene", table_4_8.tables, FRAMES)
    yield _item("section_4_8_3", "VAR(1) on whole frames", section_4_8_3.measured, splits=("fluid",))
    for name, figure in particle_strips.FIGURES.items():
        needs = {figure.split: figure.models}
        yield _item(name, "Particles of rollouts", particle_strips.draw_figure, needs)
    for name, split in statistics_tables.SPLITS.items():
        yield _item(name, "Statistics of train", statistics_tables.table, splits=(split,))
    yield from _vorticity()


def _vorticity() -> Iterator[Item]:
    link = {"cavity": (*OPERATORS, "supergat-link")}
    yield _item("table_5_4", "Vorticity errors at frame 54", table_5_4.tables, link)
    yield _item("table_5_5", "Vorticity errors and KL divergence at frame 54", table_5_4.tables, link)
    for name, held in maps.FIGURES.items():
        yield _item(name, "Maps of vorticity and velocity", maps.draw_figure, {held.split: held.models})
    for name, curves in frame_curves.FIGURES.items():
        needs = {curves.split: curves.models}
        yield _item(name, f"{curves.metric} over frames", frame_curves.draw_figure, needs)
    for name in distributions.FIGURES:
        yield _item(name, "Histograms of vorticity", distributions.draw_figure, CAVITY)
    for name, (measure, _) in table_5_4.BARS.items():
        yield _item(name, f"Vorticity at frame 54: {measure}", table_5_4.bars, CAVITY)
    for name in residuals.FIGURES:
        yield _item(name, "Residuals of vorticity", residuals.draw_figure, CAVITY)
    yield _item("fig_5_21", "Training loss on curl noise", learning_curves.draw_figure, CURL)
    for name in flow_panels.FIGURES:
        yield _item(name, "Quiver and streamlines of rollouts", flow_panels.draw_figure, OURS)


def _order(item: Item) -> tuple[str, int, int]:
    kind, *numbers = item.name.split("_")
    chapter, *rest = map(int, numbers)
    return (str(chapter), 0 if kind == "table" else 1 if kind == "section" else 2, rest[0])


ITEMS: Mapping[str, Item] = {item.name: item for item in sorted(_items(), key=_order)}
"""Tables, sections and figures by name, chapter by chapter."""
