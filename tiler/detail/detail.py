"""`citystitch detail`: façades of city models by rules, with as much detail as criteria keep."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile

from pipeline.data.errors import ConfigError
from pipeline.facades.criteria import Criteria
from pipeline.facades.graph import LABELS
from tiler.cityinput.levels import CHOICES
from tiler.convert.cityjson_files import page_name, write_document, write_sequence
from tiler.convert.convert import refuse_output
from tiler.convert.glb_files import picture_colours, write_glb
from tiler.convert.inputs import open_source
from tiler.convert.picture_pages import Pages
from tiler.detail.detailed_source import DetailedSource, detail_source
from tiler.detail.rule_files import load_graph
from tiler.detail.table import make_table, table_lines
from tiler.store.atomic import replacing, replacing_folder

SUFFIXES = (".glb", ".json", ".jsonl")


@dataclass(frozen=True)
class DetailAsked:
    """What is asked of detail by rules, as the command line has it."""

    rules: str = "residential"
    viewpoint: str = ""
    distance: str = ""
    facing: float | None = None
    keep: str = ""
    lod: str = "auto"
    crs: str = ""
    axis_order: str = ""
    json_file: Path | None = None
    overwrite: bool = False


def detail_models(inputs: Sequence[Path], output: Path, asked: DetailAsked) -> list[str]:
    """Write city models with façades by rules, at level of detail 3, a building and a façade at a time.

    Gives what must be known of the file, and the table of polygons, a line each.

    Parameters
    ----------
    inputs : sequence of Path
        As of `tiler.convert.convert.convert_models`.
    output : Path
        A file ``.glb``, ``.json`` (CityJSON) or ``.jsonl`` (CityJSONSeq); it appears whole or not at all. Textures
        of CityJSON are in the folder ``NAME-pictures`` beside it.
    asked : DetailAsked
        What is asked.

    Raises
    ------
    ConfigError
        If an option or a rule is wrong, the file exists, or coordinates are degrees.
    InputError
        If an input cannot be read.
    OutputError
        If a file cannot be written.
    """
    if output.suffix not in SUFFIXES:
        raise ConfigError(f"{output}: ends with none of {', '.join(SUFFIXES)}; rename --output")
    if asked.lod not in CHOICES:
        raise ConfigError(f"lod {asked.lod!r}: must be one of {', '.join(CHOICES)}")
    refuse_output(output, inputs, overwrite=asked.overwrite)
    pictures = output.with_name(f"{output.name.removesuffix(output.suffix).removesuffix('.city')}-pictures")
    if output.suffix != ".glb":
        refuse_output(pictures, inputs, overwrite=asked.overwrite and _holds_pages(pictures))
    if asked.json_file is not None:
        refuse_output(asked.json_file, [*inputs, output], overwrite=asked.overwrite)
    graph, criteria = load_graph(asked.rules), make_criteria(asked)
    with open_source(inputs, crs=asked.crs, axis_order=asked.axis_order) as plain:
        if plain.in_degrees:
            raise ConfigError("coordinates are degrees, and rules in metres; give --crs EPSG:NNNN")
        source = detail_source(plain, graph, tuple(criteria.values()), lod=asked.lod)
        with replacing(output) as part:
            if output.suffix == ".glb":
                write_glb(part, source, "auto", detailed=True)
            else:
                _write_cityjson(part, output.suffix, source, pictures)
        table = make_table(source.counts, tuple(criteria))
        if asked.json_file is not None:
            with replacing(asked.json_file) as part:
                part.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        told = [f"{number} {what}" for what, number in source.told.items() if number]
        return [*source.notes, *told, *table_lines(table)]


def _holds_pages(folder: Path) -> bool:
    return folder.is_dir() and all(path.suffix == ".png" for path in folder.iterdir())


def _write_cityjson(path: Path, suffix: str, source: DetailedSource, pictures: Path) -> None:
    """Write CityJSON or CityJSONSeq, and the pages of its textures, if there are any, in a folder beside it."""
    with TemporaryFile() as file:
        pages = Pages(picture_colours(), file)
        (write_document if suffix == ".json" else write_sequence)(path, source, pages, pictures.name)
        pages.close()
        file.seek(0)
        if pages.sizes:
            with replacing_folder(pictures) as folder:
                for k, size in enumerate(pages.sizes):
                    (folder / page_name(k)).write_bytes(file.read(size).rstrip(b"\0"))


def make_criteria(asked: DetailAsked) -> dict[str, Criteria]:
    """Make the criteria of the table by name: all kept, those asked for together, and each of several alone.

    ConfigError if an option is no number or out of range, or needs another one.
    """
    seen = _numbers("viewpoint", asked.viewpoint, 3)
    far = _numbers("distance", asked.distance, 2)
    keep = dict(_keep(one) for one in asked.keep.split(",")) if asked.keep else {}
    if seen is None:
        if far or asked.facing is not None:
            raise ConfigError("--distance and --facing: are seen from a point; give --viewpoint X,Y,Z")
        together = Criteria(keep=keep)
        return {"full model": Criteria(), "frame": together}
    if far is not None and not 0 <= far[0] < far[1]:
        raise ConfigError(
            f"--distance {asked.distance}: FULL is not from 0 on and below REDUCED; give both in metres"
        )
    if asked.facing is not None and not 0 < asked.facing <= 180:
        raise ConfigError(f"--facing {asked.facing:g}: an angle above 0 and up to 180 degrees")
    full, reduced = far or (None, None)
    if far is None and asked.facing is None:
        full, reduced = 50.0, 200.0
    place = (seen[0], seen[1], seen[2])
    together = Criteria(place, full, reduced, asked.facing, keep)
    alone = {
        "distance alone": replace(together, facing=None, keep={}) if full is not None else None,
        "facing alone": replace(together, full=None, reduced=None, keep={}) if asked.facing is not None else None,
        "semantics alone": Criteria(keep=keep) if keep else None,
    }
    several = {name: one for name, one in alone.items() if one is not None}
    return {"full model": Criteria(), "frame": together} | (several if len(several) > 1 else {})


def _numbers(name: str, text: str, n: int) -> list[float] | None:
    if not text:
        return None
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    if len(found) != n or not all(map(math.isfinite, found)):
        raise ConfigError(f"--{name} {text}: are not {n} numbers with commas between them")
    return found


def _keep(text: str) -> tuple[str, int]:
    label, _, value = text.partition("=")
    number = int(value) if value.isdecimal() and len(value) < 4 else -1
    if label not in LABELS or not 0 <= number <= 100:
        raise ConfigError(f"--keep {text}: is not LABEL=PERCENT with a label of {', '.join(LABELS)} and 0 to 100")
    return label, number
