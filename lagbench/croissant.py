"""Croissant 1.1 metadata: a data set described for search engines and loaders.

The document passes ``mlcroissant validate``. It names every file with its SHA-256 and lists
the scenarios as records. There is no date in it: the same manifest gives the same bytes.
Specification: https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .manifest import FileEntry, Manifest
    from .registry import Size, Split

__all__ = ["CONFORMS_TO", "croissant_json", "describe_dataset"]

CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
LICENCES = {"CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/"}
NETCDF = "application/x-netcdf"
KEYWORDS = ("particle simulation", "material point method", "surrogate model", "computational fluid dynamics")

_TERMS = (
    *("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field"),
    *("fileObject", "fileProperty", "fileSet", "format", "includes", "isArray", "isLiveDataset"),
    *("jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex", "repeated"),
    *("replace", "samplingRate", "separator", "source", "subField", "transform"),
)

_CONTEXT: Mapping[str, object] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    **{term: f"cr:{term}" for term in _TERMS},
}

_FIELDS: Mapping[str, tuple[str, str]] = {
    "scenario": ("sc:Integer", "id of the scenario"),
    "subset": ("sc:Text", "subset that holds the scenario"),
    "path": ("sc:Text", "file, relative to this document"),
    "frames": ("sc:Integer", "recorded frames"),
    "particles": ("sc:Integer", "particles in every frame"),
    "content_sha256": ("sc:Text", "content hash, the same on every machine"),
}


def croissant_json(size: Size, split: Split, manifest: Manifest) -> str:
    """Return the Croissant document of a data set folder.

    Args:
        size: tier of the split.
        split: the split itself.
        manifest: what the folder holds.
    """
    return json.dumps(describe_dataset(size, split, manifest), indent=1, ensure_ascii=False) + "\n"


def describe_dataset(size: Size, split: Split, manifest: Manifest) -> dict[str, object]:
    """Return the Croissant document as plain values."""
    return {
        "@context": dict(_CONTEXT),
        "@type": "sc:Dataset",
        "name": f"lagbench-{size.split}-{size.name}",
        "description": f"{split.title}, size {size.name}. {split.description}",
        "conformsTo": CONFORMS_TO,
        "citeAs": split.citation,
        "creator": {"@type": "sc:Organization", "name": "The lagbench authors"},
        "isLiveDataset": False,
        "keywords": list(KEYWORDS),
        "license": LICENCES.get(split.licence, split.licence),
        "version": manifest.version,
        "distribution": [_file_object(entry) for entry in manifest.files],
        "recordSet": [_scenarios(manifest.files)],
    }


def _file_object(entry: FileEntry) -> dict[str, object]:
    return {
        "@type": "cr:FileObject",
        "@id": entry.path,
        "name": entry.path,
        "description": f"scenario {entry.scenario} of {entry.subset}: {entry.frames} frames, netCDF4",
        "contentUrl": entry.path,
        "contentSize": f"{entry.bytes} B",
        "encodingFormat": NETCDF,
        "sha256": entry.file_sha256,
    }


def _scenarios(files: Sequence[FileEntry]) -> dict[str, object]:
    """Return the table of scenarios as a record set that holds its own data."""
    return {
        "@type": "cr:RecordSet",
        "@id": "scenarios",
        "name": "scenarios",
        "description": "One record per scenario file.",
        "key": {"@id": "scenarios/scenario"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"scenarios/{name}",
                "name": name,
                "description": description,
                "dataType": kind,
            }
            for name, (kind, description) in _FIELDS.items()
        ],
        "data": [{f"scenarios/{name}": getattr(entry, name) for name in _FIELDS} for entry in files],
    }
