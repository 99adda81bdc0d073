"""What is attacked: valid files, the mutations of each, and the commands that read it.

The valid files are made by the shipped command line in a folder, once.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from lagbench.board.folder import (
    GATES,
    SCORES,
    SHIFT,
    VERIFIED,
    WEIGHTS,
)
from lagbench.data.registry import load
from lagbench.models.onnx_model import LOAD_SECONDS, SECONDS_PER_CALL
from lagbench.scoring.boards import SUBMISSIONS

from .arrays import (
    ARRAYS,
    WALLED_ARRAYS,
    write_gns,
    write_trajectories,
    write_walled_trajectories,
)
from .models import ONNX, extreme_tensor, write_straight_on
from .models import WEIGHTS as WEIGHT_MUTATIONS
from .modules import GRAPH_SETTINGS, MODULES, SETTINGS
from .mutations import (
    BYTES,
    PLACES,
    PREDICTIONS,
    SCORE_FILE,
    YAML,
    Mutation,
    copy_tree,
)
from .obstacles import OBSTACLES, write_scenario
from .running import run_command
from .safetensors_files import SAFETENSORS, write_small_network

SPLITS = ("decaying-vortices", "curl-noise-3d", "curl-noise", "multimaterial")
"""Splits of which ``tiny`` is generated below the root where it is missing."""

COMMITTED_ENTRIES = ("gns", "hybrid-projection")
"""Entries of the committed leaderboard, cavity mini, whose records are attacked."""

EXAMPLE = Path(__file__).parents[2] / "docs/examples/dam_break"
"""A split of a user's own."""

KINDS = ("all", "speed", "vorticity", "streamlines", "front", "above")
"""Pictures of a cube."""

GRAPH_WORDS = ("--set", "training.steps=1", "--set", "model.noise_spread=true")

SETTING_WORDS = ("--set", "training.seed=1", "--set", "model.evaluations=5")

PLACE = Path("cavity/mini")
RECIPE = """format: 1
recipes:
  curl-noise/tiny:
    model: {scenarios: 2, frames: 5, evaluations: 5}
    training: {seed: 0}
"""
DESCRIPTION = """title: A box
licence: CC-BY-4.0
bounds: [[0, 1], [0, 1]]
periodic: [x, y]
radius: 0.1
frame_interval: 0.1
full_box: true
input_frames: 4
cells: 8
"""
META = "name: Straight on\nauthors: [A. Author]\ncommand: make\n"

Check = Callable[[Path, Path, str], str | None]
"""From the valid folder, the attacked one and the output: what was accepted wrongly."""


@dataclass(frozen=True)
class Target:
    """A valid file, what is done to it, and the commands that then read it."""

    name: str  # kind of the table
    source: str  # folder of the valid files that is copied
    victim: str  # the file that is mutated, relative to the copy
    mutations: Sequence[Mutation]
    commands: Sequence[Sequence[str]]  # words after lagbench, run in the copy
    weight: int = 1  # cases of this target in a round
    model_seconds: float = 0.0  # processor time that a model may take [s]
    # whether a file of other bytes must be refused
    is_hashed: bool = False
    check: Check | None = None  # what a success must fulfil
    # whether the victim holds more words of the command, a line for each
    has_words: bool = False
    # whether packages in the working folder count as installed
    is_installed: bool = False

    def read_words(self, folder: Path) -> list[str]:
        """Return the words of the command that the victim holds."""
        if not self.has_words:
            return []
        return (folder / self.victim).read_text().split("\n")


# --- checks of what was accepted ------------------------------------------------------


def find_wrong_score(valid: Path, attacked: Path, output: str) -> str | None:
    """Tell whether predictions of another motion have the old scores."""
    try:
        new = _positions(attacked / "p.nc")
        old = _positions(valid / "p.nc")
    except (OSError, KeyError, TypeError):
        return "predictions that cannot be read have scores"
    scores = json.loads(output)
    old_scores = json.loads((valid / "scores.json").read_text())
    counted = _counted_frames(valid / "p.nc", old_scores["diverged_at"])
    has_old_motion = new.shape == old.shape and bool(
        np.all(_is_near(new, old)[counted])
    )
    has_old_scores = scores["rows"] == old_scores["rows"]
    if has_old_scores and not has_old_motion:
        return "a changed prediction has the old scores"
    return None


def _counted_frames(path: Path, diverged_at: dict[str, int]) -> NDArray[np.bool_]:
    """Tell which frames count, shape [scenario, frame]: those before a blow-up."""
    with h5py.File(path) as file:
        frames = file["frame"][...]
        scenarios = file["scenario"][...]
    rows = []
    for scenario in scenarios:
        rows.append(frames < diverged_at.get(str(scenario), np.inf))
    return np.stack(rows)


def _is_near(new: NDArray[Any], old: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which positions are the same modulo the periods of the unit box."""
    difference = new.astype(np.float64) - old
    near: NDArray[np.bool_] = np.abs(difference - np.round(difference)) < 1e-7
    return near


def _positions(path: Path) -> NDArray[Any]:
    with h5py.File(path) as file:
        position: NDArray[Any] = file["position"][...]
    return position


def find_wrong_values(valid: Path, attacked: Path, output: str) -> str | None:
    """Tell whether an adopted or imported split has positions outside its box."""
    description = yaml.safe_load((attacked / "own/split.yaml").read_text())
    bounds = np.array(description["splits"]["own"]["sizes"]["full"]["bounds"], float)
    for path in sorted((attacked / "own").rglob("*.nc")):
        with h5py.File(path) as file:
            position = file["position"][...]
        if not np.isfinite(position).all():
            return "positions that are no numbers were accepted"
        margin = 0.2
        low = position >= bounds[:, 0] - margin
        high = position <= bounds[:, 1] + margin
        if not (low & high).all():
            return "positions outside the box were accepted"
    return None


# --- valid files ----------------------------------------------------------------------


def make_valid_files(folder: Path, root: Path, leaderboard: Path) -> None:
    """Write the valid files of all targets; what is there already is kept.

    Args:
        folder: where they are written.
        root: folder of all data sets, where ``tiny`` of these splits is generated.
        leaderboard: the committed leaderboard, of which some entries are copied.

    Raises:
        RuntimeError: a command refuses valid files.
    """
    if (folder / "complete").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)

    def run(*words: str, at: str = ".") -> str:
        outcome = run_command(words, folder / at, folder)
        if outcome.code != 0:
            raise RuntimeError(f"{words}: {outcome.output}{outcome.errors}")
        return outcome.output

    for split in SPLITS:
        run("generate", "--split", split, "--size", "tiny", "--root", str(root), "-q")

    models = folder / "models"
    models.mkdir()
    write_straight_on(models / "model.onnx")
    write_small_network(models / "model.safetensors", root)
    quick_fit = ("--set", "model.scenarios=1", "--set", "model.evaluations=1")
    for baseline, split, name, settings in (
        ("hybrid-projection", "curl-noise", "weights.pt", ()),
        ("hybrid-coarse", "multimaterial", "coarse.pt", quick_fit),
    ):
        run(
            *("train", "--baseline", baseline, "--split", split, "--size", "tiny"),
            *("-o", "run", "--device", "cpu", "-q", *settings),
            at="models",
        )
        shutil.copy(models / "run/weights.pt", models / name)
        shutil.rmtree(models / "run")
    (models / "recipe.yaml").write_text(RECIPE)

    for split in ("decaying-vortices", "curl-noise-3d"):
        (folder / split).mkdir()
        run(
            *("predict", "../models/model.onnx", "--split", split, "--size", "tiny"),
            *("-o", "p.nc", "--method", "straight", "--no-bench", "-q"),
            at=split,
        )
        scores = run("score", "p.nc", "-o", f"../scored-{split}", "--json", at=split)
        (folder / split / "scores.json").write_text(scores)

    _make_board(folder, run)
    _copy_records(folder / "records", leaderboard)

    for dimension in (2, 3):
        write_trajectories(folder / f"arrays-{dimension}/runs", dimension)
        write_gns(folder / f"gns-{dimension}/data", dimension)
        write_walled_trajectories(folder / f"walls-{dimension}/runs", dimension)
    (folder / "arrays-2/describe.yaml").write_text(DESCRIPTION)
    _make_falling_split(folder, run)
    _install_own_split(folder / "own-split")
    (folder / "obstacle").mkdir()
    size = load().size("curl-noise-3d", "tiny")
    scenario = size.path(root, size.subsets["test"][0])
    write_scenario(scenario, folder / "obstacle/ball.nc")
    (folder / "models/settings.txt").write_text("\n".join(SETTING_WORDS))
    (folder / "models/graph.txt").write_text("\n".join(GRAPH_WORDS))
    for path in folder.glob("scored-*"):
        shutil.rmtree(path)
    (folder / "complete").touch()


def _make_board(folder: Path, run: Callable[..., str]) -> None:
    """Make a leaderboard of an entry with a model."""
    board = folder / "board"
    board.mkdir()
    (board / "meta.yaml").write_text(META)
    shutil.copy(folder / "models/model.onnx", board / "model.onnx")
    shutil.copy(folder / "decaying-vortices/p.nc", board / "p.nc")
    run(
        *("submit", "p.nc", "--from", "meta.yaml", "--weights", "model.onnx"),
        *("--board", "b", "--new-board", "-q"),
        at="board",
    )


def _copy_records(folder: Path, leaderboard: Path) -> None:
    """Copy some entries of the committed leaderboard with all their records."""
    names = []
    for method in COMMITTED_ENTRIES:
        for room in (SUBMISSIONS, SCORES, WEIGHTS):
            for path in (leaderboard / room / PLACE).glob(f"{method}[._]*"):
                target = folder / "b" / path.relative_to(leaderboard)
                copy_tree(path, target)
        names.append(f"submissions/{PLACE}/{method}.yaml")
    for record in (SHIFT, VERIFIED):
        content = yaml.safe_load((leaderboard / record).read_text())
        kept = {name: content[name] for name in names if name in content}
        (folder / "b" / record).write_text(yaml.safe_dump(kept))
    shutil.copy(leaderboard / GATES, folder / "b" / GATES)


def _make_falling_split(folder: Path, run: Callable[..., str]) -> None:
    """Adopt falling particles, whose naive predictors look up train."""
    runs = folder / "analogs/runs"
    runs.mkdir(parents=True)
    rng = np.random.Generator(np.random.PCG64(5))
    for number in range(6):
        block = 0.1 + 0.2 * rng.random() + 0.3 * rng.random((100, 2))
        frames = []
        for frame in range(24):
            fallen = block - [0, 2e-3 * frame**2]
            frames.append(np.maximum(fallen, [0, 0.05]))
        position = np.asarray(frames, np.float32)
        np.savez(runs / f"{number}.npz", position=position)
    run(
        *("adopt", "runs", "-o", "own", "--radius", "0.1", "--frame-interval", "0.1"),
        *("--bounds", "0,1,0,1", "-q"),
        at="analogs",
    )
    run("template", "own/", "-o", "p.nc", "-q", at="analogs")
    shutil.rmtree(runs)


def _install_own_split(folder: Path) -> None:
    """Copy the example of a split of a user's own, as a package in a folder."""
    copy_tree(EXAMPLE / "dam_break", folder / "dam_break")
    about = folder / "dam_break-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: dam_break\nVersion: 1\n"
    )
    (about / "entry_points.txt").write_text(
        "[lagbench.generators]\ndam-break = dam_break\n"
    )


# --- targets --------------------------------------------------------------------------


def list_targets(folder: Path) -> list[Target]:
    """Return all targets; the valid files lie in a folder."""
    predict_model = ("predict", "model.onnx", "--split", "decaying-vortices")
    predict_weights = ("predict", "weights.pt", "-o", "p.nc", "--no-bench", "-q")
    predict_coarse = ("predict", "coarse.pt", *predict_weights[2:])
    predict_network = ("predict", "model.safetensors", *predict_weights[2:])
    train = ("train", "--baseline", "hybrid-projection", "--split", "curl-noise")
    targets = [
        Target(
            name="ONNX model",
            source="models",
            victim="model.onnx",
            mutations=(*ONNX, *BYTES, *ONNX, *PLACES),
            commands=[
                (*predict_model, "--size", "tiny", "-o", "p.nc", "--no-bench", "-q")
            ],
            weight=12,
            model_seconds=_seconds_of_rollout(),
        ),
        Target(
            name="hybrid-projection: weights",
            source="models",
            victim="weights.pt",
            mutations=(*WEIGHT_MUTATIONS, *BYTES, *WEIGHT_MUTATIONS, *PLACES),
            commands=[predict_weights],
            weight=12,
        ),
        Target(
            name="hybrid-coarse: weights",
            source="models",
            victim="coarse.pt",
            mutations=(
                *WEIGHT_MUTATIONS,
                *BYTES,
                *[extreme_tensor] * 4,
                *WEIGHT_MUTATIONS,
                *PLACES,
            ),
            commands=[predict_coarse],
            weight=12,
        ),
        Target(
            name="safetensors model",
            source="models",
            victim="model.safetensors",
            mutations=(*SAFETENSORS, *BYTES, *SAFETENSORS, *PLACES),
            commands=[predict_network],
            weight=12,
        ),
        Target(
            name="hybrid-projection: recipe",
            source="models",
            victim="recipe.yaml",
            mutations=(*YAML, *BYTES, *YAML, *PLACES),
            commands=[
                (*train, "--size", "tiny", "--recipe", "recipe.yaml", "-o", "r", "-q")
            ],
            weight=2,
        ),
    ]
    for split in ("decaying-vortices", "curl-noise-3d"):
        target = Target(
            name=f"predictions: {split}",
            source=split,
            victim="p.nc",
            mutations=(*PREDICTIONS, *PREDICTIONS, *BYTES, *PLACES),
            commands=[("score", "p.nc", "-o", "scores", "--json")],
            weight=7,
            check=find_wrong_score,
        )
        targets.append(target)
    return [
        *targets,
        *_board_targets(folder),
        *_array_targets(),
        *_walled_targets(),
        *_typed_targets(),
    ]


def _seconds_of_rollout() -> float:
    """Return the processor time that an ONNX model is granted for one rollout [s]."""
    horizon = load().size("decaying-vortices", "tiny").task.horizon
    return LOAD_SECONDS + SECONDS_PER_CALL * (horizon + 1)


def _board_targets(folder: Path) -> list[Target]:
    """Return the targets on leaderboards."""
    return [*_entry_targets(), *_record_targets(folder)]


BOARD = ("--board", "b")
CHECK = ("leaderboard", "check", *BOARD)
SHOW = ("leaderboard", "show", "--json", *BOARD)
BUILD = ("leaderboard", "build", *BOARD)
# Checking all of a board takes ten times as long as showing it.
BOARD_READERS = [CHECK, *[SHOW] * 6, *[BUILD] * 3]
BOARD_TEXT = (*YAML, *YAML, *BYTES, *PLACES)
HASHED_FILE = (*BYTES, *PLACES[:7])


def _entry_targets() -> list[Target]:
    """Return the targets on an entry with a model, and on the lock of its board."""
    vortices = "decaying-vortices/tiny/straight"
    reproduce = ("leaderboard", "reproduce", "--all", *BOARD, "-q")
    submit = (
        *("submit", "p.nc", "--from", "meta.yaml", "--weights", "model.onnx"),
        *("--replace", *BOARD, "-q"),
    )
    return [
        Target(
            name="ONNX model on a board",
            source="board",
            victim=f"b/{WEIGHTS}/{vortices}_0.onnx",
            mutations=HASHED_FILE,
            commands=[CHECK, reproduce],
            weight=4,
            is_hashed=True,
        ),
        Target(
            name="entry with a model",
            source="board",
            victim=f"b/{SUBMISSIONS}/{vortices}.yaml",
            mutations=BOARD_TEXT,
            commands=BOARD_READERS,
            weight=6,
        ),
        Target(
            name="lock of a board",
            source="board",
            victim="b/.lock",
            mutations=(*PLACES, empty_and_locked),
            commands=[submit, BUILD],
            weight=3,
        ),
    ]


def _record_targets(folder: Path) -> list[Target]:
    """Return the targets on the records of a board, and on a score file."""
    targets = []
    records = (
        (SHIFT, "shift record"),
        (VERIFIED, "record of costs"),
        (GATES, "record of gates"),
    )
    for victim, name in records:
        target = Target(
            name=name,
            source="records",
            victim=f"b/{victim}",
            mutations=BOARD_TEXT,
            commands=BOARD_READERS,
            weight=8,
        )
        targets.append(target)
    score_files = sorted((folder / f"records/b/{SCORES}" / PLACE).glob("*.nc"))
    score_file = score_files[0].relative_to(folder / "records")
    target = Target(
        name="score file",
        source="records",
        victim=score_file.as_posix(),
        mutations=HASHED_FILE,
        commands=[CHECK],
        weight=2,
        is_hashed=True,
    )
    # the page and the table read score files without a look at their hashes
    drawn_target = Target(
        name="score file: page",
        source="records",
        victim=score_file.as_posix(),
        mutations=SCORE_FILE,
        commands=[SHOW, BUILD],
        weight=8,
    )
    return [*targets, target, drawn_target]


def empty_and_locked(path: Path, rng: np.random.Generator) -> None:
    """Hold bytes that no lock holds."""
    path.write_bytes(rng.bytes(100))


def _array_targets() -> list[Target]:
    """Return the targets that make or read local splits."""
    size = load().size("decaying-vortices", "tiny")
    frames = str(size.task.input_frames)
    adopt = (
        *("adopt", "runs", "-o", "own", "--radius", "0.1", "--frame-interval", "0.1"),
        *("--input-frames", frames, "-q"),
    )
    boxes = {2: "0,1,0,1", 3: "0,1,0,1,0,1"}
    axes = {2: "x,y", 3: "x,y,z"}
    targets = []
    for dimension in (2, 3):
        periodic = ("--periodic", axes[dimension], "--bounds", boxes[dimension])
        imported = ("import", "data", "--format", "gns-npz", "-o", "own")
        targets += [
            Target(
                name=f"adopt --periodic, {dimension}-D",
                source=f"arrays-{dimension}",
                victim="runs/1.npz",
                mutations=(*ARRAYS, *ARRAYS, *BYTES, *PLACES),
                commands=[(*adopt, *periodic)],
                weight=8,
                check=find_wrong_values,
            ),
            Target(
                name=f"import --periodic, {dimension}-D: metadata",
                source=f"gns-{dimension}",
                victim="data/metadata.json",
                mutations=(*YAML, *YAML, *BYTES, *PLACES),
                commands=[(*imported, "--input-frames", frames, "-q")],
                weight=4,
                check=find_wrong_values,
            ),
            Target(
                name=f"import --periodic, {dimension}-D: arrays",
                source=f"gns-{dimension}",
                victim="data/train.npz",
                mutations=(*BYTES, *PLACES),
                commands=[(*imported, *periodic, "--input-frames", frames, "-q")],
                weight=3,
                check=find_wrong_values,
            ),
        ]
    return [
        *targets,
        Target(
            name="description of a Box",
            source="arrays-2",
            victim="describe.yaml",
            mutations=(*YAML, *YAML, *BYTES, *PLACES),
            commands=[("adopt", "runs", "-o", "own", "--describe", "describe.yaml")],
            weight=6,
            check=find_wrong_values,
        ),
        Target(
            name="analog: train",
            source="analogs",
            victim="own/full/v1/train/0000.nc",
            mutations=(*BYTES, *PLACES),
            commands=[
                ("compare", "p.nc", "analog", "--root", ".", "-q"),
                ("score", "p.nc", "--split", "own/", "-o", "scores", "-q"),
            ],
            weight=2,
        ),
        Target(
            name="split.yaml of a Box",
            source="analogs",
            victim="own/split.yaml",
            mutations=(*YAML, *YAML, *BYTES, *PLACES),
            commands=[("score", "p.nc", "--split", "own/", "-o", "scores", "-q")],
            weight=5,
        ),
    ]


def _walled_targets() -> list[Target]:
    """Return the targets on trajectories between walls, with unequal numbers."""
    targets = []
    boxes = {2: "0,1,0,1", 3: "0,1,0,1,0,1"}
    for dimension in (2, 3):
        command = (
            *("adopt", "runs", "-o", "own", "--radius", "0.1", "-q"),
            *("--frame-interval", "0.1", "--bounds", boxes[dimension]),
        )
        target = Target(
            name=f"adopt: walls and varying numbers, {dimension}-D",
            source=f"walls-{dimension}",
            victim="runs/1.npz",
            mutations=(*ARRAYS, *WALLED_ARRAYS, *WALLED_ARRAYS, *BYTES, *PLACES),
            commands=[command],
            weight=8,
            check=find_wrong_values,
        )
        targets.append(target)
    return targets


def _typed_targets() -> list[Target]:
    """Return the targets on what a user types: settings, and a split of their own."""
    train = (
        *("train", "--baseline", "hybrid-projection", "--split", "curl-noise"),
        *("--size", "tiny", "--recipe", "recipe.yaml", "-o", "r", "-q"),
    )
    generate = ("generate", "dam-break", "--size", "tiny", "--root", "data")
    submit = (
        *("submit", "p.nc", "--from", "meta.yaml", "--weights", "model.onnx"),
        *("--replace", *BOARD, "-q"),
    )
    return [
        Target(
            name="settings",
            source="models",
            victim="settings.txt",
            mutations=SETTINGS,
            commands=[train],
            weight=12,
            has_words=True,
        ),
        Target(
            name="settings of a graph network",
            source="models",
            victim="graph.txt",
            mutations=GRAPH_SETTINGS,
            commands=[
                (
                    *("train", "--baseline", "gns", "--split", "curl-noise"),
                    *("--size", "tiny", "--device", "cpu", "-o", "r", "-q"),
                )
            ],
            weight=8,
            has_words=True,
        ),
        Target(
            name="pictures of an obstacle in a cube",
            source="obstacle",
            victim="ball.nc",
            mutations=(*OBSTACLES, *OBSTACLES, *BYTES, *PLACES),
            commands=[
                *[("plot", "ball.nc", "--kind", kind, "-o", "a.png") for kind in KINDS],
                ("animate", "ball.nc", "--every", "12", "-o", "a.gif"),
            ],
            weight=8,
        ),
        Target(
            name="module of a split",
            source="own-split",
            victim="dam_break/__init__.py",
            mutations=(*MODULES, *MODULES, *BYTES, *PLACES),
            commands=[(*generate, "--dry-run"), ("list", "dam-break")],
            weight=10,
            is_installed=True,
        ),
        Target(
            name="registry file of a split",
            source="own-split",
            victim="dam_break/dam_break.yaml",
            mutations=BOARD_TEXT,
            commands=[(*generate, "--dry-run"), ("list", "dam-break")],
            weight=8,
            is_installed=True,
        ),
        Target(
            name="ONNX model of a new entry",
            source="board",
            victim="model.onnx",
            mutations=(*ONNX, *BYTES, *PLACES),
            commands=[submit],
            weight=6,
            model_seconds=_seconds_of_rollout(),
        ),
    ]
