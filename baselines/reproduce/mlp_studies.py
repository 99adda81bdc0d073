"""Tables 4.2 to 4.5: activations, widths, depths and more data for an MLP from frame to frame.

Errors are Eq. 4.16 after one step from true frames, over train and over valid. At size ``full`` every
row has its own recipe, with the thesis's epochs and batch; smaller sizes take a share of the epochs,
and batches that leave some steps in an epoch, the same for all rows of a table. More data (``extra``,
Table 4.5) exist at full only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.scoring.tables import Table

from .evidence import RECORD_NAME, read_json
from .runs import Plan, budget, check_training, make_training
from .sheet import Figure, Sheet, number
from .thesis import STUDIES, Model, Study

__all__ = ["TABLES", "draw", "make_studies", "study_folder", "study_rows"]

TABLES: Mapping[str, tuple[str, str]] = {
    "table_4_2": ("4.2", "fluid"),
    "table_4_3": ("4.3", "fluid"),
    "table_4_4": ("4.4", "multimaterial"),
    "table_4_5": ("4.5", "multimaterial"),
}
"""Number of the table in the thesis, and the split it is made on."""

SHARES: Mapping[str, tuple[float, int]] = {"mini": (0.1, 16), "tiny": (0.01, 64)}
"""Share of the thesis's epochs, and what its batch is divided by, by size."""

WINDOWS = 4096
"""Most windows of a subset that an error is measured over, evenly spaced."""

FILE = "errors.json"


def study_model(plan: Plan, study: Study) -> Model:
    """Return what to train for a row: at ``full`` its own recipe, else the size's recipe with changes."""
    name = f"mlp-{study.table.replace('.', '-')}-{study.row}"
    unvalidated = "training.validate_every=0"
    if plan.size == "full":
        # what tells a row's recipe from the others of its table
        ends = {"4.2": study.activation, "4.3": study.widths[0], "4.4": len(study.widths), "4.5": study.row}
        variant = f"table-{study.table}-{ends[study.table]}"
        return Model(name, name, varied="mlp", settings=(unvalidated,), recipe=variant)
    share, divisor = SHARES[plan.size]
    settings = (
        unvalidated,
        f"model.widths={list(study.widths)}",
        f"model.activation={study.activation}",
        *("model.target=state", "model.noise_std=0", "model.material=false"),
        f"training.epochs={max(1.0, share * study.epochs):g}",
        f"training.batch={study.batch // divisor}",
        *("training.learning_rate=0.001", "training.schedule=constant"),
    )
    return Model(name, name, varied="mlp", settings=settings)


def study_rows(name: str) -> tuple[Study, ...]:
    """Return the rows of a table."""
    return tuple(study for study in STUDIES if study.table == TABLES[name][0])


def study_folder(plan: Plan, name: str, study: Study) -> Path:
    """Return the folder of a row's training; it lies apart from the runs that are scored."""
    return plan.home(TABLES[name][1]) / "studies" / f"{study_model(plan, study).name}-{plan.seeds[0]}"


def make_studies(plan: Plan, name: str) -> None:
    """Train the rows of a table and measure their errors, unless that was done."""
    split = TABLES[name][1]
    for study in study_rows(name):
        folder, model = study_folder(plan, name, study), study_model(plan, study)
        check_training(plan, split, model, plan.seeds[0], folder=folder)
        if not (folder / FILE).is_file():
            make_training(plan, split, model, plan.seeds[0], folder=folder)
            found = {subset: one_step_error(plan, split, folder, subset) for subset in ("train", "valid")}
            write_atomically(folder / FILE, json.dumps(found).encode())


def one_step_error(plan: Plan, split: str, folder: Path, subset: str) -> float:
    """Return the mean of Eq. 4.16 over the windows of a subset [standardised^2]."""
    import torch

    from lagbench.baselines.checkpoint import load, restore
    from lagbench.torch import WindowDataset, collate

    model = restore(load(folder / "weights.pt")).eval()
    data = WindowDataset(
        split, subset=subset, size=plan.size, root=plan.root, history=model.history, registry=plan.registry
    )
    count = min(len(data), WINDOWS)
    chosen = [i * len(data) // count for i in range(count)]
    total = 0.0
    with torch.no_grad():
        for first in range(0, count, 128):
            windows = [data[i] for i in chosen[first : first + 128]]
            terms = model(collate(windows))
            total += len(windows) * float(terms["position"] + terms["velocity"]) / 2.0
    return total / count


def draw(plan: Plan, figure: Figure) -> Sheet:
    """Return a table with ours beside it."""
    (printed, split), rows = TABLES[figure.studies], []
    for study in study_rows(figure.studies):
        folder = study_folder(plan, figure.studies, study)
        errors, record = read_json(folder / FILE), read_json(folder / RECORD_NAME)
        rows.append(
            (
                str(study.row),
                " x ".join(map(str, study.widths)),
                study.activation,
                f"{study.parameters:,}",
                f"{record['parameters']:,}" if record else "-",
                f"{study.epochs} x {study.batch}" if study.table != "4.2" else f"{study.epochs}",
                budget(record),
                number(record["cpu_seconds"] / 3600.0 if record else None),
                number(study.train, 4),
                number(errors.get("train")),
                number(study.valid, 4),
                number(errors.get("valid")),
            )
        )
    heads = (
        *("no", "hidden layers", "activation", "parameters at full, thesis", "parameters, ours"),
        *("epochs x batch, thesis", "steps x batch, ours", "CPU hours"),
        *("train, thesis", "train, ours", "valid, thesis", "valid, ours"),
    )
    share, _ = SHARES.get(plan.size, (1.0, 1))
    note = (
        f"Table {printed} on {split} {plan.size}: mean squared error of one step [standardised^2]; {share:g}"
        " of the thesis's epochs, constant rate 1e-3. Standardisation and data differ from the thesis's:"
        " compare orders."
    )
    return Sheet(notes=(note,), tables=(Table("", heads, tuple(rows)),))
