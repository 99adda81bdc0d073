"""docs/scoring.md agrees with the code that it describes."""

from __future__ import annotations

import re
from pathlib import Path

from typer.main import get_command

from lagbench.cli.app import app
from lagbench.metrics import METRICS
from lagbench.scoring import flags

TEXT = (Path(__file__).parent.parent / "docs" / "scoring.md").read_text()


def test_every_metric_stands_in_the_table() -> None:
    """The table of metrics is that of the code, line by line and in its order."""
    expected = [
        f"| `{m.name}` | {m.summary} | {m.unit} | {m.direction}"
        f"{'' if m.perfect is None else f', {m.perfect:g}'} | {m.source} |"
        for m in METRICS.values()
    ]
    table = TEXT[TEXT.index("## Metrics") :]
    assert re.findall(r"^\| `.*", table, re.MULTILINE) == expected


def test_thresholds_of_the_flags() -> None:
    """The thresholds in the text are those of the code."""
    assert f"is below {flags.AUTOCORRELATION:g};" in TEXT
    assert (flags.DROP, "less than half within one frame" in TEXT) == (0.5, True)
    assert (flags.SHIFT_GAIN, "less than a quarter of the error" in TEXT) == (0.25, True)
    assert (flags.GROWTH, "less than twice the first frame's" in TEXT) == (2.0, True)
    assert f"outside {flags.ENERGY[0]:g} to {flags.ENERGY[1]:g} times" in TEXT
    assert f"outside {flags.OCCUPANCY[0]:g} to {flags.OCCUPANCY[1]:g} times" in TEXT
    assert (flags.TWIN_REGULAR, "past a tenth of that of persistence" in TEXT) == (0.1, True)


def test_every_option_of_score_is_described() -> None:
    """The table of options holds all that `lagbench score` has, and none that it has not."""
    table = TEXT[TEXT.index("| option | does |") : TEXT.index("Several files are scored")]
    cells = "".join(line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    score = get_command(app).commands["score"]  # type: ignore[attr-defined]
    options = {name for p in score.params for name in p.opts if name.startswith("-")}
    assert set(re.findall(r"(?<![\w-])--?[a-z]+(?:-[a-z]+)*", cells)) == options - {"--help"}
