"""The Python of `python -m validation.emulation`, without an emulator.

A script stands for the emulator: it writes down its processor and starts the program.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from validation import emulation

FAKE_EMULATOR = """#!/bin/bash
test "$1 $3" = "-cpu -0" || exit 99
echo "$2" >> "{record}"
exec -a "$4" "${{@:5}}"
"""


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a fake emulator on the path; return the file with its processors."""
    record = tmp_path / "processors"
    program = tmp_path / emulation.EMULATOR
    program.write_text(FAKE_EMULATOR.format(record=record), encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    return record


def test_children_run_on_the_emulated_processor_with_the_same_packages(
    record: Path,
) -> None:
    """An emulator does not follow a program that starts the real Python."""
    child = "import numpy"
    program = (
        f"import subprocess, sys; subprocess.run([sys.executable, '-P', '-c', {child!r}"
        "], check=True)"
    )
    assert emulation.main(["--processor", "Nehalem", "--", "-c", program]) == 0
    assert record.read_text(encoding="utf-8").split() == ["Nehalem", "Nehalem"]


def test_the_exit_code_is_that_of_python(record: Path) -> None:
    program = "raise SystemExit(7)"
    assert emulation.main(["--processor", "Westmere", "--", "-c", program]) == 7
    assert record.read_text(encoding="utf-8").split() == ["Westmere"]


def test_a_missing_emulator_is_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert emulation.main(["--processor", "Nehalem", "--", "-V"]) == 2
    message = capsys.readouterr().err
    assert emulation.EMULATOR in message
