"""Record what a generated data set measures: hashes, statistics, predictability limit.

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
_SHORT = 16  # digits of a scenario's hash that datasets.yaml holds
# numbers of a list in a line of at most 110 characters
_PER_LINE = (110 - 10) // len("-1.00000000e-05, ")


def measured_values(manifest: Manifest) -> Measured:
    """Return what datasets.yaml shall say about a complete data set.

    Raises:
        DataError: a scenario, or the predictability limit of one of test, is missing.
    """
    limits = []
    for entry in manifest.files:
        if entry.subset == "test":
            limits.append(entry.twin_floor)
    dataset_hash = manifest.dataset_sha256
    if not manifest.complete or dataset_hash is None or not all(limits):
        raise DataError(
            f"the data set is incomplete: got {len(manifest.files)} scenarios; "
            f"perturbed runs of {sum(bool(limit) for limit in limits)} of test, "
            "expected all scenarios of train, valid and test, and perturbed runs of "
            f"test; lagbench generate --split {manifest.split} --size {manifest.size}",
            where=f"{manifest.split} {manifest.size}",
        )
    hashes: dict[int, str] = {}
    for entry in manifest.files:
        content_hash = entry.content_sha256
        hashes[entry.scenario] = content_hash[:_SHORT]
    return Measured(
        dataset_sha256=dataset_hash,
        subset_sha256=manifest.subset_sha256,
        scenario_sha256=hashes,
        statistics=manifest.statistics,
        twin_floor=manifest.mean_twin_floor(),
    )


def render(measured: Mapping[str, Mapping[str, Measured]]) -> str:
    """Return the measured block as YAML 1.1 text, the same text for the same values."""
    lines = [_NOTICE, "measured:"]
    for split, sizes in sorted(measured.items()):
        lines.append(f"  {split}:")
        for size, values in sorted(sizes.items()):
            lines.append(f"    {size}:")
            lines += _render_size(values)
    text = "\n".join(lines)
    return f"{text}\n"


def _render_size(values: Measured) -> list[str]:
    lines = [f'      dataset_sha256: "{values.dataset_sha256}"']
    if values.truth_error is not None:
        lines.append(f"      truth_error: {_format_number(values.truth_error)}")

    lines.append("      subset_sha256:")
    for subset, digest in values.subset_sha256.items():
        lines.append(f'        {subset}: "{digest}"')

    lines.append("      scenario_sha256:")
    for scenario, digest in sorted(values.scenario_sha256.items()):
        lines.append(f'        {scenario}: "{digest}"')

    lines.append("      statistics:")
    for name, row in values.statistics.items():
        texts = map(_format_number, row)
        numbers = ", ".join(texts)
        lines.append(f"        {name}: [{numbers}]")

    limits = [_format_number(value) for value in values.twin_floor]
    rows = []
    for start in range(0, len(limits), _PER_LINE):
        end = start + _PER_LINE
        line = ", ".join(limits[start:end])
        rows.append(line)
    listing = ",\n         ".join(rows)
    lines.append("      twin_floor:")
    lines.append(f"        [{listing}]")
    return lines


def _format_number(value: float) -> str:
    """Return nine digits in the one form that YAML 1.1 reads as a float."""
    return f"{value:.8e}"


def replace_measured(text: str, measured: Mapping[str, Mapping[str, Measured]]) -> str:
    """Return the text of a datasets.yaml with another measured block."""
    by_hand, _, _ = text.partition(MARKER)
    by_hand = by_hand.replace(_NOTICE, "")
    by_hand = by_hand.rstrip("\n")
    block = render(measured)
    return f"{by_hand}\n\n{block}"


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

    Args:
        size: size that the manifest belongs to.
        manifest: manifest of a complete data set.
        registry: the datasets.yaml to write.
        released: the list of released hashes; None for no list.
        allow: whether a hash of the same MAJOR version may change.

    Raises:
        DataError: the data set is incomplete, or a hash would change.
    """
    values = measured_values(manifest)
    released_hashes = {}
    if released is not None and released.exists():
        released_hashes = json.loads(released.read_text())

    name = released_name(size)
    old_hash = released_hashes.get(name)
    if not old_hash and size.measured:
        old_hash = size.measured.dataset_sha256
    if old_hash not in (None, values.dataset_sha256) and not allow:
        raise DataError(
            f"the bits changed and MAJOR did not: got {values.dataset_sha256}, "
            f"expected {old_hash}; raise MAJOR of the split, or pass --allow-change "
            "before a release",
            where=f"{registry}, {size.split} {size.name} {size.version}",
        )

    if old_hash == values.dataset_sha256 and size.measured is not None:
        kept = {"truth_error": size.measured.truth_error}
        values = values.model_copy(update=kept)
    old_measured = load(registry).measured
    old_sizes = old_measured.get(size.split, {})
    sizes = {**old_sizes, size.name: values}
    measured = {**old_measured, size.split: sizes}
    old_text = registry.read_text(encoding="utf-8")
    text = replace_measured(old_text, measured)
    write_atomically(registry, text.encode())
    if released is not None:
        released_hashes[name] = values.dataset_sha256
        listing = json.dumps(released_hashes, indent=1, sort_keys=True)
        text = f"{listing}\n"
        write_atomically(released, text.encode())
    return values


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    options = _parse(arguments)
    try:
        registry = load(options.registry)
        size = registry.size(options.split, options.size)
        root = resolve_root(options.root)
        manifest = _checked_manifest(size, root)
        released = options.released
        checkout = options.registry.parent / "tests"
        if released is None and checkout.is_dir():
            released = checkout / "data" / "released_hashes.json"
        values = record(
            size,
            manifest,
            registry=options.registry,
            released=released,
            allow=options.allow_change,
        )
    except LagbenchError as error:
        sys.stderr.write(f"record: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{size.split} {size.name}: {values.dataset_sha256}\n")
    return 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split", required=True)
    parser.add_argument("--size", required=True)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--registry", type=Path, default=default_path().resolve())
    parser.add_argument("--released", type=Path)
    parser.add_argument("--allow-change", action="store_true")
    return parser.parse_args(arguments)


def _checked_manifest(size: Size, root: Path) -> Manifest:
    """Return a manifest whose files are those on disk, with statistics computed anew.

    What the manifest says of train is not taken on trust.
    """
    folder = dataset_folder(root, size.split, size.name, size.major)
    manifest = read_manifest(root, size.split, size.name, size.major)
    if manifest is None:
        raise DataError(
            "the data set has no manifest: got none, expected a manifest of generated "
            "data; generate it first: lagbench generate",
            where=str(folder),
        )

    train_paths = []
    for entry in manifest.files:
        path = folder / entry.path
        if not path.is_file() or file_sha256(path) != entry.file_sha256:
            options = f"--split {manifest.split} --size {manifest.size}"
            raise DataError(
                "a file is not the one that the manifest describes: got another file, "
                "or none, expected the file of the manifest; lagbench generate "
                f"{options}",
                where=str(path),
            )
        if entry.subset == "train":
            train_paths.append(path)
    statistics = file_statistics(train_paths, size.box)
    return manifest.model_copy(update={"statistics": statistics})


if __name__ == "__main__":
    raise SystemExit(main())
