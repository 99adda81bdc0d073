"""Files appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from lagbench.atomic import (
    atomic_path,
    check_output_file,
    check_writable,
    remove_leftovers,
    write_atomically,
)
from lagbench.errors import DataError, UsageError, WorkFailedError


def test_a_file_appears_only_on_the_clean_exit(tmp_path: Path) -> None:
    """Inside the block only the temporary name exists, afterwards only the target."""
    target = tmp_path / "deep" / "file"
    with atomic_path(target) as temporary:
        temporary.write_text("new")
        assert temporary.parent == target.parent
        assert not target.exists()
    assert target.read_text() == "new"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, DataError("what")])
def test_an_error_keeps_the_old_file(
    tmp_path: Path, error: type[BaseException] | BaseException
) -> None:
    """Whatever is raised passes through; the old file stays, the temporary one goes."""
    target = tmp_path / "file"
    write_atomically(target, b"old")

    def interrupted() -> None:
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises((KeyboardInterrupt, ValueError, DataError)):
        interrupted()
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_is_tried_before_the_work(tmp_path: Path) -> None:
    """A usable folder is neither made nor changed."""
    check_writable(tmp_path / "deep" / "folder")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    file = tmp_path / "file"
    lost = tmp_path / "lost"
    lost.symlink_to(tmp_path / "nowhere")
    for folder in (
        file,
        file / "below",
        lost,
        Path("/proc/self"),
    ):
        with pytest.raises(WorkFailedError) as caught:
            check_writable(folder, option="--output")
        assert caught.value.where == str(folder)
    with pytest.raises(WorkFailedError) as caught:
        write_atomically(file / "in-the-way", b"")
    assert caught.value.where.endswith("file/in-the-way")


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    """Only temporary names go, in subfolders too."""
    (tmp_path / "test").mkdir()
    kept = tmp_path / "test" / "0003.nc"
    left = tmp_path / "test" / ".0004.nc.77.partial"
    kept.touch()
    left.touch()
    assert remove_leftovers(tmp_path) == [left]
    assert list((tmp_path / "test").iterdir()) == [kept]


def test_a_file_is_replaced_only_on_request(tmp_path: Path) -> None:
    path = tmp_path / "file"
    check_output_file(path, overwrite=False)
    path.touch()
    check_output_file(path, overwrite=True)
    with pytest.raises(UsageError):
        check_output_file(path, overwrite=False)
    with pytest.raises(UsageError):
        check_output_file(tmp_path, overwrite=True)
