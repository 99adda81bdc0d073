"""Files appear whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from lagbench.atomic import (
    atomic_path,
    check_output_file,
    check_writable,
    checked_path,
    move_together,
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


def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    """Nor is a device: a rename by the superuser would take its place."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(WorkFailedError):
        write_atomically(pipe, b"new")
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_a_folder_is_tried_before_the_work(tmp_path: Path) -> None:
    """A usable folder is neither made nor changed. The error for an unusable one names
    its option, before the work and during it.
    """
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
        tmp_path / ("x" * 300),
        Path("/proc/self"),
    ):
        with pytest.raises(WorkFailedError) as caught:
            check_writable(folder, option="--output")
        assert caught.value.where.startswith(str(folder.parent))
        assert "--output" in caught.value.fix
    with pytest.raises(WorkFailedError) as caught:
        write_atomically(file / "in-the-way", b"")
    assert caught.value.where.endswith("file/in-the-way")


@pytest.mark.parametrize(
    ("code", "hint"),
    [
        (errno.ENOSPC, "free disk space"),
        (errno.EACCES, "owns"),
        (errno.EROFS, "can be written to"),
        (errno.ENOENT, "can be written to"),
        (errno.EIO, "can be written to"),
        (errno.EFBIG, "ulimit -f"),
        (errno.EMFILE, "ulimit -n"),
    ],
)
def test_a_full_disk_and_a_vanished_one_have_their_own_advice(
    code: int, hint: str, tmp_path: Path
) -> None:
    with (
        pytest.raises(WorkFailedError) as caught,
        atomic_path(tmp_path / "file", option="--output"),
    ):
        raise OSError(code, os.strerror(code))
    assert hint in caught.value.fix
    assert "--output" in caught.value.fix
    assert list(tmp_path.iterdir()) == []


def test_a_file_may_have_the_longest_name(tmp_path: Path) -> None:
    """The temporary name is no longer than the system allows. Two long names that begin
    alike do not meet.
    """
    first = tmp_path / ("a" * 252 + ".nc")
    second = tmp_path / ("a" * 251 + "b.nc")
    with atomic_path(first) as one, atomic_path(second) as two:
        one.write_text("one")
        two.write_text("two")
    assert first.read_text() == "one"
    assert second.read_text() == "two"
    assert set(tmp_path.iterdir()) == {first, second}


def test_files_move_together_or_not_at_all(tmp_path: Path) -> None:
    """A folder at one of the places is met before the first file moves; a link to one
    is replaced.
    """
    sources = [tmp_path / "new-a", tmp_path / "new-b"]
    for path in sources:
        path.write_text(path.name)
    places = [tmp_path / "a", tmp_path / "deep" / "b"]
    places[1].mkdir(parents=True)
    with pytest.raises(IsADirectoryError):
        move_together(list(zip(sources, places, strict=True)))
    assert not places[0].exists()
    places[1].rename(tmp_path / "elsewhere")
    places[1].symlink_to(tmp_path / "elsewhere")
    move_together(list(zip(sources, places, strict=True)))
    assert [path.read_text() for path in places] == ["new-a", "new-b"]
    assert (tmp_path / "elsewhere").is_dir()


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    """Only temporary names go, in subfolders too."""
    (tmp_path / "test").mkdir()
    kept = tmp_path / "test" / "0003.nc"
    left = tmp_path / "test" / ".0004.nc.77.partial"
    kept.touch()
    left.touch()
    assert remove_leftovers(tmp_path) == [left]
    assert list((tmp_path / "test").iterdir()) == [kept]


def test_a_folder_with_a_temporary_name_stays(tmp_path: Path) -> None:
    """No writer made it, and it stops nobody."""
    folder = tmp_path / ".own.partial"
    folder.mkdir()
    left = folder / ".0004.nc.77.partial"
    left.touch()
    assert remove_leftovers(tmp_path) == [left]
    assert folder.is_dir()


def test_a_file_of_another_kind_is_never_replaced(tmp_path: Path) -> None:
    """One of the kind is, on request; what is empty or not there is free to take."""
    signs = (b"first", b"second")
    path = tmp_path / "file"
    check_output_file(path, overwrite=False, signs=signs)
    path.write_bytes(b"first only")
    for overwrite in (False, True):
        with pytest.raises(UsageError, match="something else"):
            check_output_file(path, overwrite=overwrite, signs=signs)
    for content in (b"second and first", b""):
        path.write_bytes(content)
        check_output_file(path, overwrite=True, signs=signs)
        with pytest.raises(UsageError, match="already"):
            check_output_file(path, overwrite=False, signs=signs)
    with pytest.raises(UsageError):
        check_output_file(tmp_path, overwrite=True, signs=signs)


def test_an_error_of_a_check_names_the_file_that_was_asked_for(tmp_path: Path) -> None:
    """The file that was checked lies in a folder which is gone afterwards."""
    target = tmp_path / "model.onnx"
    with (
        pytest.raises(DataError) as caught,
        checked_path(target, option="path") as unchecked,
    ):
        raise DataError("damaged", where=str(unchecked))
    assert str(target) in str(caught.value.where)
    assert list(tmp_path.iterdir()) == []
