"""Read HTML strictly: every element closed in order, attributes once, ids unique."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"br", "col", "hr", "img", "link", "meta"}
CLOSED = {"circle", "line", "path", "rect", "stop", "use"}
"""Elements of SVG that end with a slash here."""


@dataclass
class Element:
    """One element: name, attributes, and the text in it and below."""

    name: str
    attributes: dict[str, str]
    text: str = ""


@dataclass
class Reading:
    """The elements of a page, and what is wrong with it."""

    elements: list[Element] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def named(self, name: str) -> list[Element]:
        """Return the elements of a name."""
        return [element for element in self.elements if element.name == name]

    @property
    def ids(self) -> list[str]:
        """All ids in order."""
        attributes = [element.attributes for element in self.elements]
        return [names["id"] for names in attributes if "id" in names]


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.reading = Reading()
        self.open: list[Element] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = self._add(tag, attrs)
        if tag not in VOID:
            self.open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._add(tag, attrs)
        if tag not in CLOSED:
            self.reading.faults.append(f"<{tag}/>")

    def handle_endtag(self, tag: str) -> None:
        innermost = "nothing"
        if self.open:
            innermost = self.open[-1].name
        if innermost == tag:
            self.open.pop()
        else:
            self.reading.faults.append(f"</{tag}> closes {innermost}")

    def handle_data(self, data: str) -> None:
        for element in self.open:
            element.text += data

    def _add(self, tag: str, attrs: list[tuple[str, str | None]]) -> Element:
        names = [name for name, _ in attrs]
        if len(set(names)) < len(names):
            self.reading.faults.append(f"<{tag}> has an attribute twice")
        element = Element(tag, {name: value or "" for name, value in attrs})
        self.reading.elements.append(element)
        return element


def read_html(text: str) -> Reading:
    """Read a page or a piece of one."""
    reader = _Reader()
    reader.feed(text)
    reader.close()
    reading = reader.reading
    for element in reader.open:
        reading.faults.append(f"<{element.name}> is never closed")
    for name, count in Counter(reading.ids).items():
        if count > 1:
            reading.faults.append(f"id {name} twice")
    return reading
