"""One line that says what a window or a batch of windows holds."""

from __future__ import annotations

from collections.abc import Mapping


def summarise_arrays(title: str, fields: Mapping[str, object]) -> str:
    """Return a line with the shapes of arrays and the values of numbers.

    Fields that are None are left out.

    >>> summarise_arrays("Window", {"scenario": 3, "frame": 4, "origin": None})
    '<Window: scenario 3, frame 4>'
    """
    parts = []
    for name, value in fields.items():
        if value is None:
            continue
        shape = getattr(value, "shape", None)
        content = value if shape is None else list(shape)
        parts.append(f"{name} {content}")
    return f"<{title}: {', '.join(parts)}>"
