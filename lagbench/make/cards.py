"""Data set cards: README.md with pictures, and croissant.json, beside the manifest.

Both follow from the registry and the manifest alone and hold no date, so the same data
set gets the same bytes. Pictures are drawn where matplotlib is installed. The Croissant
1.1 document, for search engines and loaders, names every file with its SHA-256, lists
the scenarios as records and passes ``mlcroissant validate``. Specification:
https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.data.manifest import Manifest
from lagbench.data.registry import Registry, Size, Split, spell_ids
from lagbench.figures.tables import escape, markdown

LICENCES = {"CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/"}
KEYWORDS = (
    "particle simulation",
    "material point method",
    "surrogate model",
    "computational fluid dynamics",
)

_TERMS = (
    *(
        "arrayShape",
        "citeAs",
        "column",
        "containedIn",
        "equivalentProperty",
        "extract",
        "field",
    ),
    *(
        "fileObject",
        "fileProperty",
        "fileSet",
        "format",
        "includes",
        "isArray",
        "isLiveDataset",
    ),
    *(
        "jsonPath",
        "key",
        "md5",
        "parentField",
        "path",
        "recordSet",
        "references",
        "regex",
        "repeated",
    ),
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
    """Return the Croissant document of a data set folder."""
    scenarios = {  # a table that holds its own data
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
        "data": [
            {f"scenarios/{name}": getattr(entry, name) for name in _FIELDS}
            for entry in manifest.files
        ],
    }
    document = {
        "@context": dict(_CONTEXT),
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
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": entry.path,
                "name": entry.path,
                "description": f"scenario {entry.scenario} of {entry.subset}: "
                f"{entry.frames} frames, netCDF4",
                "contentUrl": entry.path,
                "contentSize": f"{entry.bytes} B",
                "encodingFormat": "application/x-netcdf",
                "sha256": entry.file_sha256,
            }
            for entry in manifest.files
        ],
        "recordSet": [scenarios],
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


CARD_NAME = "README.md"
CROISSANT_NAME = "croissant.json"

PICTURES: Mapping[str, str] = {  # path relative to the card, and what it shows
    "pictures/scenarios.png": "scenarios of this data set",
    "pictures/frame.png": "one frame of a test scenario",
}
NOTES: Mapping[
    str, str
] = {  # what a reader of one split's card must know beside its description
    "cavity": (
        "The wall velocities of all frames, those to be predicted included, are part "
        "of what is given: they "
        "are the forcing. `wall_velocity` at frame f is what acts from frame f-1 to f."
    ),
    "multimaterial": (
        "Pairs with snow come to rest first. `active_frames` of a file says for how "
        "many predicted frames "
        "its scenario moves: up to the last with at least 1 % of the greatest "
        "kinetic energy."
    ),
    "fluid": (
        "Scenarios of train differ in length: the longer ones are those that still "
        "move. `active_frames` of "
        "a file says for how many predicted frames it moves: up to the last with at "
        "least 1 % of the "
        "greatest kinetic energy."
    ),
    "curl-noise": (
        "Energy only decays: the higher the frequency, the faster. The equations have "
        "no viscosity, the grid "
        "has: benchmarks/effective_viscosity.py fits it to the decay of each size."
    ),
}
_WALLS = "closed box: what acts towards each frame; walls left, right, bottom, top"
VARIABLES = (
    (
        "`position`",
        "frame, particle, space",
        "float32",
        "length",
        "particle positions in the unit box",
    ),
    (
        "`velocity`",
        "frame, particle, space",
        "float32",
        "length/s",
        "particle velocities of the solver",
    ),
    ("`material`", "particle", "int8", "1", "0 liquid, 1 jelly, 2 snow, 3 rope"),
    ("`particle_mass`", "", "float64", "density x area", "mass of one particle"),
    ("`wall_velocity`", "frame, wall, space", "float32", "length/s", _WALLS),
    ("`time`", "frame", "float64", "s", "time since frame 0"),
)


def write_cards(root: Path, size: Size, split: Split, manifest: Manifest) -> list[Path]:
    """Write README.md, croissant.json and, with matplotlib, the pictures; return their
    paths.
    """
    folder = size.folder(root)
    texts = {
        folder / name: text for name, text in card_texts(size, split, manifest).items()
    }
    drawn = [folder / name for name in _pictures(manifest)]
    there = all(path.is_file() for path in (*texts, *drawn))
    # The card names every content hash: where its text stands already, the pictures are
    # of the same data.
    if not there or any(path.read_bytes() != text for path, text in texts.items()):
        if drawn:
            _draw(root, size, split, manifest)
        for path, text in texts.items():
            write_atomically(path, text)
    return [*texts, *drawn]


def card_texts(size: Size, split: Split, manifest: Manifest) -> dict[str, bytes]:
    """Return the texts of a data set's card by name, README.md first."""
    return {
        CARD_NAME: dataset_card(
            size, split, manifest, pictures=_pictures(manifest)
        ).encode(),
        CROISSANT_NAME: croissant_json(size, split, manifest).encode(),
    }


def _pictures(manifest: Manifest) -> list[str]:
    if manifest.files and importlib.util.find_spec("matplotlib"):
        return list(PICTURES)
    return []


def _draw(root: Path, size: Size, split: Split, manifest: Manifest) -> None:
    from lagbench.figures.plot import contact_sheet, plot_frame

    splits = Registry({size.split: split}, {})
    folder = size.folder(root)
    sheet, single = PICTURES
    contact_sheet(size.split, size.name, folder / sheet, root=root, registry=splits)
    shown = next((e for e in manifest.files if e.subset == "test"), manifest.files[0])
    frame = min(size.task.frames_of_interest[-1], shown.frames - 1)
    plot_frame(folder / shown.path, frame, folder / single, registry=splits)


def dataset_card(
    size: Size, split: Split, manifest: Manifest, *, pictures: list[str]
) -> str:
    """Return the card of a data set as Markdown with a YAML head."""
    head = {  # JSON strings and lists are YAML
        "pretty_name": f"{split.title} ({size.split} {size.name})",
        "license": split.licence.lower(),
        "tags": list(KEYWORDS),
        "size_categories": ["n<1K" if len(manifest.files) < 1000 else "1K<n<10K"],
        "version": manifest.version,
    }
    moments = [
        (name.replace("_", " "), *row) for name, row in manifest.statistics.items()
    ]
    statistics = (
        "## Statistics of train",
        "With the frame as unit of time: velocity is x(f) - x(f-1), acceleration its "
        "difference.",
        markdown(("", "x", "y"), moments),
    )
    parameters = [
        (
            f"`{name}`",
            f"{p.value:g}" if isinstance(p.value, float) else p.value,
            p.unit,
            p.description,
        )
        for name, p in size.parameters.items()
    ]
    subsets = []
    for name, ids in size.subsets.items():
        there = [entry for entry in manifest.files if entry.subset == name]
        sums = sum(entry.frames for entry in there), sum(entry.bytes for entry in there)
        if name in manifest.subset_sha256:
            digest = f"`{manifest.subset_sha256[name]}`"
        else:
            digest = "incomplete"
        subsets.append(
            (name, spell_ids(ids), f"{len(there)} of {len(ids)}", *sums, digest)
        )
    options = f"--split {size.split} --size {size.name}"
    parts = [
        "\n".join(
            [
                "---",
                *(f"{k}: {json.dumps(v, ensure_ascii=False)}" for k, v in head.items()),
                "---",
            ]
        ),
        f"# {escape(split.title)} · {size.split} {size.name}",
        escape(split.description),
        *([escape(NOTES[size.split])] if size.split in NOTES else []),
        *(f"![{PICTURES[name]}]({name})" for name in pictures),
        "## In short",
        _facts(size, manifest),
        "## Subsets",
        markdown(("subset", "ids", "scenarios", "frames", "bytes", "hash"), subsets),
        "## Reading",
        "One netCDF4 file per scenario, which `xarray.open_dataset` reads without "
        "lagbench. "
        "Lengths are in units of the unit box, time in seconds. Frame 0 is the state "
        "when recording starts.",
        "```python\n"
        "import lagbench\n\n"
        f'data = lagbench.open_split("{size.split}", subset="train", '
        f'size="{size.name}")\n'
        'position = data["position"]  # (scenario, frame, particle, space), read when '
        "computed\n"
        "```",
        markdown(("variable", "dimensions", "type", "unit", "meaning"), VARIABLES),
        "## Task",
        _task(size, manifest),
        *(statistics if manifest.statistics else ()),
        "## Parameters",
        markdown(("parameter", "value", "unit", "meaning"), parameters),
        "## Regenerate and verify",
        "The files hold the same bits on every x86-64 Linux machine, with any number "
        "of workers."
        if manifest.identity == "bitwise"
        else "Some files come from a device that does not promise equal bits: they "
        "agree to a tolerance.",
        "```sh\n"
        "pip install 'lagbench[generate]'\n"
        f"lagbench generate {options}\n"
        f"lagbench verify {options}                 # re-hash every file\n"
        f"lagbench verify {options} --regenerate 2  # simulate two scenarios again "
        f"and compare\n"
        "```",
        "## Scenarios",
        _scenarios(manifest),
        "## Licence and citation",
        f"{escape(split.licence)}. {escape(split.citation)}.",
    ]
    return "\n\n".join(parts) + "\n"


def _facts(size: Size, manifest: Manifest) -> str:
    frames = sorted({entry.frames for entry in manifest.files}) or [0]
    digest = manifest.dataset_sha256
    rows = [
        ("version", manifest.version),
        ("complete", manifest.complete),
        ("data set hash", f"`{digest}`" if digest else "none before it is complete"),
        ("identity", manifest.identity),
        ("scenarios", len(manifest.files)),
        (
            "frames per scenario",
            " to ".join(map(str, dict.fromkeys((frames[0], frames[-1])))),
        ),
        ("frames together", sum(entry.frames for entry in manifest.files)),
        ("particles", size.particles),
        ("frame interval", f"{size.frame_interval:.6g} s"),
        ("substep", f"{size.dt:.6g} s, {size.substeps_per_frame} per frame"),
        ("box", " x ".join(f"[{low:.9g}, {high:.9g}]" for low, high in size.bounds)),
        ("bytes", sum(entry.bytes for entry in manifest.files)),
    ]
    return markdown(("", ""), rows)


def _task(size: Size, manifest: Manifest) -> str:
    grid = size.task.score_grid
    task = size.task
    rows = [
        ("input frames", str(task.input_frames)),
        ("frames to predict", str(task.horizon)),
        ("frames of interest", ", ".join(map(str, task.frames_of_interest))),
        (
            "score grid",
            f"{grid.cells} cells a side, {grid.placement.replace('_', ' ')}",
        ),
        ("radius for graph models", f"{task.radius:g}"),
    ]
    floors = [entry.twin_floor for entry in manifest.files if entry.twin_floor]
    if floors:
        first, last = (sum(floor[i] for floor in floors) / len(floors) for i in (0, -1))
        text = f"position RMSE {first:.3g} at the first predicted frame, {last:.3g} at the last"
        rows.append(("twin that starts 2^-20 away", text))
    return markdown(("", ""), rows)


def _scenarios(manifest: Manifest) -> str:
    names = sorted({name for entry in manifest.files for name in entry.facts})
    rows = [
        (
            entry.scenario,
            f"`{entry.path}`",
            entry.frames,
            *(
                f"{entry.facts[name]:.6g}" if name in entry.facts else ""
                for name in names
            ),
            f"`{entry.content_sha256}`",
        )
        for entry in manifest.files
    ]
    head = (
        "id",
        "file",
        "frames",
        *(name.replace("_", " ") for name in names),
        "content hash",
    )
    listing = markdown(head, rows)
    return f"<details><summary>{len(rows)} files</summary>\n\n{listing}\n\n</details>"
