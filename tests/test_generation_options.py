"""What generation is told: worker counts, root folders, a registry of one's own."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import DRAW, SIZE, SPLIT

from lagbench.data.registry import Registry
from lagbench.errors import UsageError, WorkFailedError
from lagbench.make import cards
from lagbench.make.generate import generate


@pytest.mark.parametrize("dry_run", [True, False])
def test_a_root_that_is_a_file_is_refused_dry_or_not(
    dry_run: bool, tmp_path: Path, unmeasured: Registry
) -> None:
    """A dry run does not promise what the real one cannot do: the same error, the same exit code."""
    (tmp_path / "file").write_text("mine")
    for root in (tmp_path / "file", tmp_path / "file" / "data"):
        with pytest.raises(WorkFailedError, match="is a file") as caught:
            generate(SPLIT, SIZE, root=root, dry_run=dry_run, registry=unmeasured)
        assert str(tmp_path / "file") in str(caught.value)


@pytest.mark.parametrize("workers", [0, -1])
def test_fewer_than_one_worker_is_refused(workers: int, tmp_path: Path, unmeasured: Registry) -> None:
    """Neither an endless loop nor silently all cores, and no folder is made."""
    with pytest.raises(UsageError, match="without a worker"):
        generate(SPLIT, SIZE, root=tmp_path / "new", workers=workers, registry=unmeasured)
    assert not (tmp_path / "new").exists()


def test_a_registry_of_ones_own_is_all_that_counts(
    tmp_path: Path, unmeasured: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A split that only the given registry knows is generated, drawn and described with its own title."""
    monkeypatch.setattr(cards, "_draw", DRAW)
    described = unmeasured.split(SPLIT).model_copy(update={"title": "Noise of our own"})
    own = Registry({"own-noise": described}, {})
    result = generate("own-noise", SIZE, scenarios="3", root=tmp_path, workers=1, registry=own)
    assert "# Noise of our own" in (result.folder / "README.md").read_text()
    assert all((result.folder / name).stat().st_size > 1000 for name in cards.PICTURES)
