"""croissant.json: a data set as search engines and loaders read it.

The Croissant 1.1 document names every file with its SHA-256, lists the scenarios as
records and passes ``mlcroissant validate``. Specification:
https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files

from lagbench.data.manifest import FileEntry, Manifest
from lagbench.data.registry import Size, Split

LICENCES = {"CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/"}
KEYWORDS = (
    "particle simulation",
    "material point method",
    "surrogate model",
    "computational fluid dynamics",
)

# columns of the record set: name, and (type, description)
_FIELDS: Mapping[str, tuple[str, str]] = {
    "scenario": ("sc:Integer", "id of the scenario"),
    "subset": ("sc:Text", "subset that holds the scenario"),
    "path": ("sc:Text", "file, relative to this document"),
    "frames": ("sc:Integer", "recorded frames"),
    "particles": ("sc:Integer", "particles in every frame"),
    "content_sha256": ("sc:Text", "content hash, the same on every x86-64 Linux CPU"),
}


def croissant_json(size: Size, split: Split, manifest: Manifest) -> str:
    """Return the Croissant document of a data set folder."""
    # that of the specification
    context = files("lagbench.make") / "croissant_context.json"
    document = {
        "@context": json.loads(context.read_text("utf-8")),
        "@type": "sc:Dataset",
        "name": f"lagbench-{size.split}-{size.name}",
        "description": f"{split.title}, size {size.name}. {split.description}",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "citeAs": split.citation,
        "creator": {"@type": "sc:Organization", "name": "The lagbench authors"},
        "isLiveDataset": False,
        "keywords": list(KEYWORDS),
        "license": LICENCES.get(split.licence, split.licence),
        "version": manifest.version,
        "distribution": [_file_object(entry) for entry in manifest.files],
        "recordSet": [_record_set(manifest)],
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _file_object(entry: FileEntry) -> dict[str, str]:
    """Return what Croissant says of one file."""
    contents = f"{entry.frames} frames, netCDF4"
    return {
        "@type": "cr:FileObject",
        "@id": entry.path,
        "name": entry.path,
        "description": f"scenario {entry.scenario} of {entry.subset}: {contents}",
        "contentUrl": entry.path,
        "contentSize": f"{entry.bytes} B",
        "encodingFormat": "application/x-netcdf",
        "sha256": entry.file_sha256,
    }


def _record_set(manifest: Manifest) -> dict[str, object]:
    """Return the table of scenarios, which holds its own data."""
    fields = []
    for name, (data_type, description) in _FIELDS.items():
        field = {
            "@type": "cr:Field",
            "@id": f"scenarios/{name}",
            "name": name,
            "description": description,
            "dataType": data_type,
        }
        fields.append(field)

    records = []
    for entry in manifest.files:
        record = {}
        for name in _FIELDS:
            record[f"scenarios/{name}"] = getattr(entry, name)
        records.append(record)

    return {
        "@type": "cr:RecordSet",
        "@id": "scenarios",
        "name": "scenarios",
        "description": "One record per scenario file.",
        "key": {"@id": "scenarios/scenario"},
        "field": fields,
        "data": records,
    }
