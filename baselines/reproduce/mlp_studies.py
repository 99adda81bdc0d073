"""Tables 4.2 to 4.5: activations, widths, depths and more data for an MLP from frame to frame.

Errors are Eq. 4.16 after one step from true frames, over train and over valid. At size ``full`` every
row has its own recipe, with the thesis's epochs and batch; smaller sizes take a share of the epochs,
and batches that leave some steps in an epoch, the same for all rows of a table. More data (``extra``,
Table 4.5) exist at full only.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.scoring.tables import Table
from lagbench.work.progress import Progress

from .evidence import read_json
from .making import check_training, make_training
from .plan import Plan
from .roster import Model
from .sheet import Sheet
from .thesis import STUDIES, Study
from .wording import number

__all__ = ["TABLES", "make_studies", "study_folder", "study_rows", "tables"]

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
    settings = ["training.validate_every=0"]
    if plan.size == "full":
        variant = f"table-{study.table}-{_variant(study)}"
        return Model(name=name, baseline="mlp", label=name, settings=tuple(settings), recipe=variant)
    share, divisor = SHARES[plan.size]
    settings += [
        f"model.widths={list(study.widths)}",
        f"model.activation={study.activation}",
        *("model.target=state", "model.noise_std=0", "model.material=false"),
        f"training.epochs={max(1.0, share * study.epochs):g}",
        f"training.batch={study.batch // divisor}",
        *("training.learning_rate=0.001", "training.schedule=constant"),
    ]
    return Model(name=name, baseline="mlp", label=name, settings=tuple(settings))


def _variant(study: Study) -> str:
    """Return what ends the name of a row's recipe."""
    ends = {"4.2": study.activation, "4.3": str(study.widths[0]), "4.4": str(len(study.widths))}
    return ends.get(study.table, str(study.row))


def study_rows(name: str) -> tuple[Study, ...]:
    """Return the rows of a table."""
    return tuple(study for study in STUDIES if study.table == TABLES[name][0])


def study_folder(plan: Plan, name: str, study: Study) -> Path:
    """Return the folder of a row's training; it lies apart from the runs that are scored."""
    return plan.home(TABLES[name][1]) / "studies" / f"{study_model(plan, study).name}-{plan.seeds[0]}"


def make_studies(plan: Plan, name: str, progress: Callable[[Progress], None] | None = None) -> None:
    """Train the rows of a table and measure their errors, unless that was done."""
    split = TABLES[name][1]
    for study in study_rows(name):
        folder, model = study_folder(plan, name, study), study_model(plan, study)
        check_training(plan, split, model, plan.seeds[0], folder=folder)
        if not (folder / FILE).is_file():
            make_training(plan, split, model, plan.seeds[0], folder=folder, progress=progress)
            found = {subset: one_step_error(plan, split, folder, subset) for subset in ("train", "valid")}
            write_atomically(folder / FILE, json.dumps(found).encode())


def one_step_error(plan: Plan, split: str, folder: Path, subset: str) -> float:
    """Return the mean of Eq. 4.16 over the windows of a subset [standardised^2]."""
    import torch

    from lagbench.baselines.checkpoint import load, restore
    from lagbench.baselines.windows import WindowDataset, collate

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


def tables(plan: Plan, name: str) -> Sheet:
    """Return a table with ours beside it."""
    number_, split = TABLES[name]
    rows = [_row(plan, name, study) for study in study_rows(name)]
    heads = (
        *("no", "hidden layers", "activation", "parameters at full, thesis", "parameters, ours"),
        *("epochs x batch, thesis", "steps x batch, ours", "CPU hours"),
        *("train, thesis", "train, ours", "valid, thesis", "valid, ours"),
    )
    share, _ = SHARES.get(plan.size, (1.0, 1))
    note = (
        f"Table {number_} on {split} {plan.size}: mean squared error of one step [standardised^2]; {share:g}"
        " of the thesis's epochs, constant rate 1e-3. Standardisation and data differ from the thesis's:"
        " compare orders."
    )
    return Sheet(notes=(note,), tables=(Table("", heads, tuple(rows)),))


def _row(plan: Plan, name: str, study: Study) -> tuple[str, ...]:
    folder = study_folder(plan, name, study)
    errors, record = read_json(folder / FILE), read_json(folder / "training.json")
    steps = f"{record['step']:,} x {record['recipe']['training']['batch']}" if "step" in record else "-"
    return (
        str(study.row),
        " x ".join(map(str, study.widths)),
        study.activation,
        f"{study.parameters:,}",
        f"{record['parameters']:,}" if "parameters" in record else "-",
        f"{study.epochs} x {study.batch}" if study.table != "4.2" else f"{study.epochs}",
        steps,
        number(record["cpu_seconds"] / 3600.0) if "cpu_seconds" in record else "-",
        number(study.train, 4),
        number(errors.get("train")),
        number(study.valid, 4),
        number(errors.get("valid")),
    )
