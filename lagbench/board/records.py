"""Files of the board that say something of entries: verified.yaml and shift.yaml.

They lie apart from the entries, so that no submitter can claim what they say. A record
holds while its entry has the very score files and models that the record names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

from pydantic import RootModel

from lagbench.atomic import write_atomically
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import LagbenchError

from .entry import Entry, Strict, validate, yaml_bytes
from .folder import Folder


class Record(Strict):
    """What a file says of an entry."""

    def is_of(self, entry: Entry) -> bool:
        """Return whether the record is of the scores and models of an entry."""
        raise NotImplementedError


R = TypeVar("R", bound=Record)


def record_of(entry: Entry, records: Mapping[str, R]) -> R | None:
    """Return the record of an entry; None without one, or of an earlier entry."""
    record = records.get(entry.yaml_path.as_posix())
    return record if record is not None and record.is_of(entry) else None


@dataclass(frozen=True)
class RecordFile(Generic[R]):
    """A YAML file with the records of entries by their paths."""

    name: str
    kind: type[R]

    def read(self, folder: Folder) -> dict[str, R]:
        """Return the records by path of the entry; empty without the file.

        Raises:
            UnreadableFileError: the file cannot be read.
            ChecksFailedError: it holds something else.
        """
        path = folder.path / self.name
        content = read_yaml(path) if path.exists() else None
        form = RootModel[dict[str, self.kind]]  # type: ignore[name-defined]
        records: dict[str, R] = validate(form, content or {}, path).root
        return records

    @contextmanager
    def changing(self, folder: Folder) -> Iterator[dict[str, R]]:
        """Yield the records, and write them as they are at the end."""
        with folder.lock():
            records = self.read(folder)
            yield records
            self._write(folder, records)

    def remove_stale(self, folder: Folder, entry: Entry) -> bool:
        """Remove the record of an earlier entry; return whether there was one."""
        records = self.read(folder)
        name = entry.yaml_path.as_posix()
        if name not in records or records[name].is_of(entry):
            return False
        del records[name]
        self._write(folder, records)
        return True

    def find_stale(self, folder: Folder, entries: Mapping[str, Entry]) -> Iterator[str]:
        """Yield the records that belong to none of the readable entries, by path."""
        try:
            records = self.read(folder)
        except LagbenchError as error:
            yield str(error)
            return
        for name in records:
            entry = entries.get(name)
            if entry is None or record_of(entry, records) is None:
                yield (
                    f"{self.name}, {name}: a record of other scores, models or data, "
                    "or of no entry; remove it"
                )

    def _write(self, folder: Folder, records: Mapping[str, R]) -> None:
        lines = {}
        for name, record in sorted(records.items()):
            lines[name] = record.model_dump(exclude_defaults=True)
        write_atomically(folder.path / self.name, yaml_bytes(lines), option="--board")
