"""Errors cross process borders, carry an exit code, and fit on one or two lines."""

from __future__ import annotations

import pickle

import pytest

from lagbench import errors
from lagbench.errors import LagbenchError, NotInstalledError, UsageError

EXIT_CODES = {
    errors.ChecksFailedError: 1,
    errors.UsageError: 2,
    errors.UnreadableFileError: 3,
    errors.DataError: 4,
    errors.WorkFailedError: 5,
}


@pytest.mark.parametrize(("kind", "exit_code"), EXIT_CODES.items())
def test_an_error_crosses_process_borders(
    kind: type[LagbenchError], exit_code: int
) -> None:
    """Class, place and value are what programs read, so they come along."""
    error = kind("no such thing; name another", where="--size", got="huge")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert str(copy) == str(error) == "--size: no such thing; name another"
    assert (copy.where, copy.got, copy.exit_code) == ("--size", "huge", exit_code)


def test_python_catches_our_errors_by_its_own_classes() -> None:
    with pytest.raises(ImportError):
        errors.require("no_such_package_at_all", extra="plots")
    assert issubclass(NotInstalledError, UsageError)


def test_a_hint_names_the_nearest_word_and_lists_few() -> None:
    hint = errors.suggest_name("cavty", ["cavity", "fluid"])
    assert hint.startswith("did you mean 'cavity'?")
    assert len(errors.suggest_name("x", [f"name{n}" for n in range(999)])) < 500
