"""Record what a generated data set measures: its hashes, statistics and twin floor.

usage: python -m lagbench.generators.record --split cavity --size tiny [--root FOLDER]
           [--registry datasets.yaml] [--released tests/data/released_hashes.json]
           [--allow-change]

Reads the manifest of a complete data set, checks its files against it, computes the
statistics of train anew, and writes the block ``measured`` of datasets.yaml; what
stands above that block is not touched. Also keeps the list of released hashes, by which
a test notices bits that change without their version. A recorded hash of the same MAJOR
version is only replaced with --allow-change.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import dataset_folder
from lagbench.data.local import resolve_root
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Measured, Size, default_path, load
from lagbench.data.statistics import file_statistics
from lagbench.errors import DataError, LagbenchError

MARKER = "\nmeasured:"  # where the generated part of datasets.yaml begins
_NOTICE = (
    "# Written by `python -m lagbench.generators.record`; do not edit below this line."
)
_SHORT = 16
# numbers of a list in a line of at most 110 characters
_PER_LINE = (110 - 10) // len("-1.00000000e-05, ")


def measured_values(manifest: Manifest) -> Measured:
    """Return what datasets.yaml shall say about a complete data set."""
    twins = [entry.twin_floor for entry in manifest.files if entry.subset == "test"]
    if not manifest.complete or manifest.dataset_sha256 is None or not all(twins):
        raise DataError(
            "the data set is incomplete",
            where=f"{manifest.split} {manifest.size}",
            expected="all scenarios of train, valid and test, and twins of test",
            fix=f"lagbench generate --split {manifest.split} --size {manifest.size}",
        )
    return Measured(
        dataset_sha256=manifest.dataset_sha256,
        subset_sha256=manifest.subset_sha256,
        scenario_sha256={
            entry.scenario: entry.content_sha256[:_SHORT] for entry in manifest.files
        },
        statistics=manifest.statistics,
        twin_floor=manifest.mean_twin_floor(),
    )


def render(measured: Mapping[str, Mapping[str, Measured]]) -> str:
    """Return the measured block as YAML 1.1 text, the same text for the same values."""
    lines = [_NOTICE, "measured:"]
    for split, sizes in sorted(measured.items()):
        lines.append(f"  {split}:")
        for size, values in sorted(sizes.items()):
            lines += [
                f"    {size}:",
                f'      dataset_sha256: "{values.dataset_sha256}"',
            ]
            lines.append("      subset_sha256:")
            lines += [
                f'        {subset}: "{digest}"'
                for subset, digest in values.subset_sha256.items()
            ]
            lines.append("      scenario_sha256:")
            lines += [
                f'        {i}: "{digest}"'
                for i, digest in sorted(values.scenario_sha256.items())
            ]
            lines.append("      statistics:")
            for name, row in values.statistics.items():
                lines.append(f"        {name}: [{', '.join(map(_number, row))}]")
            numbers = [_number(value) for value in values.twin_floor]
            rows = [
                ", ".join(numbers[k : k + _PER_LINE])
                for k in range(0, len(numbers), _PER_LINE)
            ]
            lines += [
                "      twin_floor:",
                "        [" + ",\n         ".join(rows) + "]",
            ]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """Return nine digits in the one form that YAML 1.1 reads as a float."""
    return f"{value:.8e}"


def replace_measured(text: str, measured: Mapping[str, Mapping[str, Measured]]) -> str:
    """Return the text of a datasets.yaml with another measured block."""
    by_hand = text.split(MARKER)[0].replace(_NOTICE, "").rstrip("\n")
    return f"{by_hand}\n\n{render(measured)}"


def released_name(size: Size) -> str:
    """Return what names a size in the list of released hashes: its bits, not its
    text.
    """
    return f"{size.split}/{size.name}/v{size.major}"


def record(
    size: Size,
    manifest: Manifest,
    *,
    registry: Path,
    released: Path | None,
    allow: bool,
) -> Measured:
    """Write what a manifest measures to datasets.yaml and to the list of released
    hashes.
    """
    values = measured_values(manifest)
    hashes = (
        json.loads(released.read_text())
        if released is not None and released.exists()
        else {}
    )
    before = hashes.get(released_name(size)) or (
        size.measured.dataset_sha256 if size.measured else None
    )
    if before not in (None, values.dataset_sha256) and not allow:
        raise DataError(
            "the bits changed and MAJOR did not",
            where=f"{registry}, {size.split} {size.name} {size.version}",
            expected=before,
            got=values.dataset_sha256,
            fix="raise MAJOR of the split, or pass --allow-change before a release",
        )
    known = load(registry).measured
    sizes = {**known.get(size.split, {}), size.name: values}
    text = replace_measured(
        registry.read_text(encoding="utf-8"), {**known, size.split: sizes}
    )
    write_atomically(registry, text.encode())
    if released is not None:
        hashes[released_name(size)] = values.dataset_sha256
        write_atomically(
            released, (json.dumps(hashes, indent=1, sort_keys=True) + "\n").encode()
        )
    return values


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split", required=True)
    parser.add_argument("--size", required=True)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--registry", type=Path, default=default_path().resolve())
    parser.add_argument("--released", type=Path)
    parser.add_argument("--allow-change", action="store_true")
    options = parser.parse_args(arguments)
    root = resolve_root(options.root)
    try:
        size = load(options.registry).size(options.split, options.size)
        folder = dataset_folder(root, size.split, size.name, size.major)
        manifest = read_manifest(root, size.split, size.name, size.major)
        if manifest is None:
            raise DataError("the data set has no manifest", where=str(folder))
        for entry in manifest.files:
            path = folder / entry.path
            if not path.is_file() or file_sha256(path) != entry.file_sha256:
                raise DataError(
                    "a file is not the one that the manifest describes",
                    where=str(path),
                    fix=f"lagbench generate --split {manifest.split} --size "
                    f"{manifest.size}",
                )
        released = options.released
        checkout = options.registry.parent / "tests"
        if released is None and checkout.is_dir():
            released = checkout / "data" / "released_hashes.json"
        # what the manifest says of train is not taken on trust
        train = [
            folder / entry.path for entry in manifest.files if entry.subset == "train"
        ]
        manifest = manifest.model_copy(update={"statistics": file_statistics(train)})
        allow = options.allow_change
        values = record(
            size, manifest, registry=options.registry, released=released, allow=allow
        )
    except LagbenchError as error:
        sys.stderr.write(f"record: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{size.split} {size.name}: {values.dataset_sha256}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
