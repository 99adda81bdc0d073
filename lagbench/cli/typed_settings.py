"""What a user typed: settings and lists with blanks in them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence

from lagbench.errors import UsageError

NEGATIVE_NUMBER = re.compile(r"-[0-9.].*")
"""A word that begins as an option does, and is the value of a setting."""

LIST_FORMS = {
    "--scenarios": re.compile("[0-9,-]+"),
    "--bounds": re.compile("[0-9.e,+-]+"),
    "--periodic": re.compile("[xyz,]+"),
}
"""Options that take several numbers or axes in one word, and what may be in it."""

LIST_OPTIONS = ("--subset", *LIST_FORMS)
"""Options that take several values in one word."""

BENCH_OPTIONS = ("--size", "--frames")
"""Options of the command bench whose value is the next word, beside the split."""

TRAIN_OPTIONS = ("--output", "-o", "--recipe", "--start", "--root", "--split")
"""Options of the command train whose value may be called as a model is."""

MOST_LETTERS = 60
"""Letters of a word of the command line in a message."""


def shorten_word(word: str) -> str:
    """Return a word as messages show it, cut where it is long."""
    return word if len(word) <= MOST_LETTERS else f"{word[:MOST_LETTERS]}..."


def advise_on_settings(words: Sequence[str]) -> str | None:
    """Return how to write the settings of a command; None where that is no mistake.

    Settings are often written with blanks around the =, without it, or without --set
    before the second one.

    >>> advise_on_settings(["train", "--set", "training.steps", "=", "10"])
    'write settings with = and without blanks: --set training.steps=10'
    """
    words = _separate_options(words)
    settings: list[str] = []
    has_mistake = False
    is_setting = False
    for number, word in enumerate(words):
        following = "".join(words[number + 1 : number + 2])
        if word.startswith("-") and not NEGATIVE_NUMBER.fullmatch(word):
            is_setting = word == "--set"
        elif not is_setting:
            continue
        elif words[number - 1] == "--set":
            settings.append(word)
        elif settings[-1].endswith("=") or word.startswith("="):
            settings[-1] += word
            has_mistake = True
        elif "=" not in settings[-1]:
            settings[-1] += f"={word}"
            has_mistake = True
        elif "=" in word or following.startswith("="):
            settings.append(word)
            has_mistake = True
        else:
            is_setting = False
    if not has_mistake:
        return None
    if any(len(setting) > MOST_LETTERS for setting in settings):
        # half a setting cannot be typed
        return "write settings with = and without blanks: --set KEY=VALUE"
    options = " ".join(f"--set {shlex.quote(setting)}" for setting in settings)
    return f"write settings with = and without blanks: {options}"


def _separate_options(words: Sequence[str]) -> list[str]:
    """Return words in which a setting stands behind its option: --set=a is --set a."""
    separate = []
    for word in words:
        option, equals, setting = word.partition("=")
        if option == "--set" and equals:
            separate += [option, setting]
        else:
            separate.append(word)
    return separate


def advise_on_lists(words: Sequence[str]) -> str | None:
    """Return how to write a list that was typed with blanks; None where there is none.

    Where a word behind the option is no value of it, the words are no list.

    >>> advise_on_lists(["generate", "cavity", "--subset", "train", "valid"])
    'write several values with commas: --subset train,valid'
    >>> advise_on_lists(["generate", "cavity", "--scenarios", "1", ",", "2"])
    'write several values with commas: --scenarios 1,2'
    >>> advise_on_lists(["generate", "--subset", "train", "cavity", "tiny"])
    """
    for number, word in enumerate(words):
        if word not in LIST_OPTIONS:
            continue
        values = []
        for value in words[number + 1 :]:
            if value.startswith("-") and not NEGATIVE_NUMBER.fullmatch(value):
                break
            # a comma alone is a separator
            if value.strip(","):
                values.append(value.strip(","))
        if len(values) > 1 and all(_fits_option(value, word) for value in values):
            listing = shorten_word(",".join(values))
            return f"write several values with commas: {word} {listing}"
    return None


def _fits_option(value: str, option: str) -> bool:
    """Say whether a word may be a value of an option that takes lists."""
    # The help of a group shall load no other module.
    from lagbench.data.limits import SUBSETS

    if option == "--subset":
        return set(filter(None, value.split(","))) <= set(SUBSETS)
    return LIST_FORMS[option].fullmatch(value) is not None


def advise_on_baselines(words: Sequence[str]) -> str | None:
    """Return how to name the model of a training that was typed without its option.

    >>> advise_on_baselines(["lagbench", "train", "cavity", "gns"])
    'name the model by an option: --baseline gns'
    >>> advise_on_baselines(["lagbench", "train", "cavity", "tiny", "-o", "gns"])
    """
    # importlib.metadata takes half as long to import as the rest of lagbench.
    from importlib.metadata import entry_points

    is_named = any(word.startswith("--baseline") for word in words)
    if "train" not in words[1:2] or is_named:
        return None
    names = {point.name for point in entry_points(group="lagbench.baselines")}
    for number, word in enumerate(words[2:], start=2):
        is_value = words[number - 1] in TRAIN_OPTIONS
        if word in names and not is_value:
            return f"name the model by an option: --baseline {word}"
    return None


def advise_on_splits(words: Sequence[str]) -> str | None:
    """Return how to name the split of a bench that was typed without its option.

    >>> advise_on_splits(["lagbench", "bench", "solver", "cavity"])
    'name the split by an option: --split cavity'
    >>> advise_on_splits(["lagbench", "bench", "solver", "cavity", "--split", "fluid"])
    """
    if list(words[1:3]) != ["bench", "solver"]:
        return None
    is_named = any(word.startswith("--split") for word in words)
    if is_named:
        return None
    for number, word in enumerate(words[3:], start=3):
        is_value = words[number - 1] in BENCH_OPTIONS
        if word.startswith("-") or is_value:
            continue
        name = shlex.quote(shorten_word(word))
        return f"name the split by an option: --split {name}"
    return None


def check_typed_settings(words: Sequence[str]) -> None:
    """Refuse a setting without its =: its value was taken for the argument SPLIT.

    Raises:
        UsageError: there is one.
    """
    for number, word in enumerate(words[1:], start=1):
        is_setting = words[number - 1] == "--set"
        if is_setting and "=" not in word and not word.startswith("-"):
            following = " ".join(words[number + 1 : number + 2])
            advice = f"write its value behind a =: --set {shorten_word(word)}=VALUE"
            key, colon, value = word.partition(":")
            if colon and value and len(word) <= MOST_LETTERS:
                advice = f"write = for the colon: --set {shlex.quote(f'{key}={value}')}"
            elif len(word) > MOST_LETTERS:
                advice = "write its value behind a =: --set KEY=VALUE"
            raise UsageError(
                "a setting has no =",
                where="--set",
                expected="--set KEY=VALUE",
                got=f"--set {shorten_word(word)} {shorten_word(following)}".rstrip(),
                fix=advise_on_settings(words) or advice,
            )
