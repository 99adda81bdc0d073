"""Mutations of what a user writes: settings of a recipe, the module of a split."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .mutations import Mutation

# --- settings -------------------------------------------------------------------------

KEYS = (
    "training.seed",
    "training.steps",
    "training.rate",
    "training.windows",
    "training",
    "model",
    "model.evaluations",
    "model.scenarios",
    "model.frames",
    "model.",
    ".",
    "",
    "model.evaluations.more",
    "evaluations",
    "__class__",
    "model.__init__",
    "\u202emodel.frames",
    "x" * 10_000,
)
"""Names of settings, some of which a recipe has."""

VALUES = (
    "",
    "0",
    "-1",
    "1.5",
    "1e400",
    "-.inf",
    ".nan",
    "1" + "0" * 40,
    "9" * 5_000,
    "0x10",
    "1_000",
    "017",
    "true",
    "null",
    "~",
    "[]",
    "{}",
    "[1, 2",
    "{a: 1, a: 2}",
    "[" * 5_000,
    "*a",
    "&a [*a]",
    "!!python/object/apply:os.mkdir ['hostile-setting-ran']",
    "!!binary gIGC",
    "2026-01-01",
    "../../x",
    "\u202egnp",
    "=",
    "a=b",
    "\ttab",
    "a: b: c",
    "x" * 50_000,
    "'",
    "|",
    "%",
)
"""Values of settings as they are typed; some are no YAML."""


def _choose(rng: np.random.Generator, choices: tuple[str, ...]) -> str:
    return choices[rng.integers(len(choices))]


def other_value(path: Path, rng: np.random.Generator) -> None:
    """Give a setting of the recipe another value."""
    key = _choose(rng, KEYS[:9])
    path.write_text(f"--set\n{key}={_choose(rng, VALUES)}")


def other_key(path: Path, rng: np.random.Generator) -> None:
    """Give a setting another name."""
    path.write_text(f"--set\n{_choose(rng, KEYS)}=3")


def other_form(path: Path, rng: np.random.Generator) -> None:
    """Write a setting with blanks, twice, without its =, or without --set."""
    forms = (
        ("--set", "training.seed", "3"),
        ("--set", "training.seed", "=", "3"),
        ("--set", "training.seed="),
        ("--set", "=3"),
        ("--set", "training.seed:3"),
        ("--set", "training.seed=1", "training.seed=2"),
        ("--set", "training.seed=1", "--set", "training.seed=-2"),
        ("--set",),
        ("--set="),
        ("--set=training.seed=3", "--set", "model.frames=0"),
        ("training.seed=3",),
        ("--set", "-1"),
        ("--set", "--set"),
        ("--set", "model.frames=2", "-5"),
    )
    form = forms[rng.integers(len(forms))]
    path.write_text("\n".join(form))


SETTINGS: tuple[Mutation, ...] = (other_value, other_value, other_key, other_form)


GRAPH_KEYS = (
    "model.compression",
    "model.compresion",
    "model.noise_spread",
    "model.noise_std",
    "model.recovery",
    "model.radius",
    "model.pushforward",
    "training.compression",
    "noise_spread",
)
"""Names of settings of graph networks, some of them misspelt."""

GRAPH_VALUES = ("0.5", "1", "2", "8", "yes", "50%", "0,5", "5e-4m", *VALUES)


def other_graph_setting(path: Path, rng: np.random.Generator) -> None:
    """Change one or two settings of a small graph network."""
    words = ["--set", "training.steps=1"]
    for _ in range(int(rng.integers(1, 3))):
        key = _choose(rng, GRAPH_KEYS)
        words += ["--set", f"{key}={_choose(rng, GRAPH_VALUES)}"]
    path.write_text("\n".join(words))


GRAPH_SETTINGS: tuple[Mutation, ...] = (other_graph_setting,)


# --- modules --------------------------------------------------------------------------

NUMBER = re.compile(r"\b\d+(?:\.\d+)?\b")

NUMBERS = (
    "0",
    "-1",
    "1e9",
    "10**400",
    "float('nan')",
    "float('inf')",
    "'text'",
    "None",
    "[]",
    "True",
    "1j",
)
"""What stands in the place of a number of a module."""

STATEMENTS = (
    "1 / 0",
    "raise SystemExit(0)",
    "raise KeyboardInterrupt",
    "raise Exception('\\x1b[2J \\u202e')",
    "undefined_name",
    "import no_such_module",
    "return None",
    "return 3",
    "return {}",
    "yield",
    "del rng",
    "width, height = 0, 0",
    "(lambda again: again(again))(lambda again: again(again))",
    "bytearray(10**15)",
    "__import__('warnings').warn('a warning')",
    "print('a line of a module')",
)
"""What a user may have written by mistake."""


def other_number_in_module(path: Path, rng: np.random.Generator) -> None:
    """Write another value in the place of a number."""
    text = path.read_text()
    matches = list(NUMBER.finditer(text))
    match = matches[rng.integers(len(matches))]
    value = _choose(rng, NUMBERS)
    path.write_text(text[: match.start()] + value + text[match.end() :])


def insert_a_statement(path: Path, rng: np.random.Generator) -> None:
    """Insert a faulty statement behind a line, as deep as it."""
    lines = path.read_text().split("\n")
    number = int(rng.integers(len(lines)))
    depth = len(lines[number]) - len(lines[number].lstrip())
    lines.insert(number + 1, " " * depth + _choose(rng, STATEMENTS))
    path.write_text("\n".join(lines))


def remove_a_line(path: Path, rng: np.random.Generator) -> None:
    """Remove a line."""
    lines = path.read_text().split("\n")
    del lines[rng.integers(len(lines))]
    path.write_text("\n".join(lines))


def other_shape_of_state(path: Path, rng: np.random.Generator) -> None:
    """Draw an initial state of other shapes or types."""
    text = path.read_text()
    changes = (
        ("(size.particles, 2)", "(size.particles, 3)"),
        ("(size.particles, 2)", "(7, 2)"),
        ("np.int8", "np.float64"),
        ("np.int8", "object"),
        ("sample_points(rng, column, size.particles)", "[[0.5, 0.5]] * size.particles"),
        ("sample_points(rng, column, size.particles)", "None"),
        (
            "sample_points(rng, column, size.particles)",
            "np.full((size.particles, 2), 9.0)",
        ),
        ("area=width * height", "area=-1.0"),
        ("area=width * height", "area=np.nan"),
        ('{"width": width, "height": height}', '{"\\u202e": width, 3: height}'),
        ('{"width": width, "height": height}', '{"width": [width]}'),
        ('{"width": width, "height": height}', "None"),
        ("return constants(FreeSurfaceParameters, size)", "return {}"),
        ("def initial_state", "def start"),
        ("def solver_parameters", "solver_parameters = 3\n\n\ndef other"),
    )
    old, new = changes[rng.integers(len(changes))]
    path.write_text(text.replace(old, new))


MODULES: tuple[Mutation, ...] = (
    other_number_in_module,
    insert_a_statement,
    insert_a_statement,
    remove_a_line,
    other_shape_of_state,
)
