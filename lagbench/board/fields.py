"""Types of the fields of an entry: their lengths, ranges and patterns.

Strangers write entries, so every text has a length, every number has a range, and links
are http(s) and nothing else.
"""

from __future__ import annotations

import datetime
import ipaddress
import unicodedata
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import AfterValidator, BeforeValidator, Field, StringConstraints

ID = r"^[a-z0-9]+(-[a-z0-9]+)*$"
PLACE = r"^[a-z0-9]+(-[a-z0-9]+)*(/[a-z0-9]+(-[a-z0-9]+)*){2}$"  # cavity/mini/gns
# nothing that could end an HTML attribute
WEB = r"^https?://[A-Za-z0-9][!#-&(-;=?-\[\]_a-z~]*$"
SHA256 = r"^[0-9a-f]{64}$"
RELEASE = r"^[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}$"
LABEL = r"^[a-z0-9_]+$"

LONGEST_ID = 60
LONGEST_TEXT = 1000
MOST_SEEDS = 20
MOST_BYTES = 2**40

# Combining marks on one letter. No script needs more; piles of marks cover the
# neighbours.
MOST_MARKS = 3

BLANKS = frozenset("\u115f\u1160\u2800\u3164\uffa0")
"""Letters and symbols that show nothing, though Unicode counts them as printable."""


def latest_date() -> datetime.date:
    """Return the latest date of an entry: somewhere on Earth it is tomorrow."""
    today = datetime.datetime.now(datetime.UTC).date()
    return today + datetime.timedelta(days=1)


def _check_line(text: str) -> str:
    """Refuse a line that a page or terminal cannot show."""
    mark_count = 0
    for letter in unicodedata.normalize("NFC", text):
        if unicodedata.category(letter).startswith("M"):
            mark_count += 1
        else:
            mark_count = 0
        if mark_count > MOST_MARKS:
            raise ValueError("holds letters under piles of marks")

    if not text.isprintable() or BLANKS.intersection(text):
        raise ValueError("holds characters that cannot be printed, such as line breaks")
    return text


def _check_lines(text: str) -> str:
    _check_line(text.replace("\n", ""))
    return text


def _check_not_blank(text: str) -> str:
    if text and not text.strip():
        raise ValueError("holds blanks only")
    return text


def _check_visible(text: str) -> str:
    has_letter = any(letter.isalnum() for letter in text)
    if text != text.strip() or not has_letter:
        raise ValueError("holds no letter or digit, or begins or ends with a blank")
    return text


def _check_host(address: str) -> str:
    """Refuse hosts that read as another one, and hosts without a public name."""
    try:
        host = urlsplit(address).hostname or ""
    except ValueError:
        host = ""
    labels = host.split(".")
    has_punycode = any(label.startswith("xn--") for label in labels)
    if (
        "@" in address
        or len(labels) < 2
        or "" in labels[:-1]
        or has_punycode
        or _is_ip_address(host)
    ):
        raise ValueError(
            "is not the address of a named host, without user and punycode"
        )
    return address


def _is_ip_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def _check_inner_path(path: str) -> str:
    parts = path.split("/")
    leads_out = any(part in ("", ".", "..") for part in parts)
    if path.startswith("/") or "\\" in path or leads_out:
        raise ValueError(
            "is no path inside the leaderboard's folder: relative, without '..', "
            "parted by '/'"
        )
    return path


def _parse_date(value: object) -> object:
    if isinstance(value, str):
        return datetime.date.fromisoformat(value)
    return value


Name = Annotated[str, StringConstraints(pattern=ID, max_length=LONGEST_ID)]
PlaceName = Annotated[
    str, StringConstraints(pattern=PLACE, max_length=3 * LONGEST_ID + 2)
]
Label = Annotated[str, StringConstraints(pattern=LABEL, max_length=LONGEST_ID)]
Short = Annotated[
    str,
    StringConstraints(min_length=1, max_length=100),
    AfterValidator(_check_line),
    AfterValidator(_check_visible),
]
Line = Annotated[str, StringConstraints(max_length=200), AfterValidator(_check_line)]
Long = Annotated[
    str, StringConstraints(max_length=LONGEST_TEXT), AfterValidator(_check_lines)
]
Command = Annotated[Long, AfterValidator(_check_not_blank)]
Link = Annotated[
    str, StringConstraints(pattern=WEB, max_length=300), AfterValidator(_check_host)
]
InnerPath = Annotated[
    str,
    StringConstraints(min_length=1, max_length=200),
    AfterValidator(_check_line),
    AfterValidator(_check_inner_path),
]
Hash = Annotated[str, StringConstraints(pattern=SHA256)]
Version = Annotated[str, StringConstraints(pattern=RELEASE)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Seconds = Annotated[float, Field(ge=1e-7, lt=1e9, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
# value of a metric that ranks: an error, whose fourth power is a number too
RankingValue = Annotated[float, Field(ge=0.0, le=1e75, allow_inf_nan=False)]
Date = Annotated[datetime.date, BeforeValidator(_parse_date)]
