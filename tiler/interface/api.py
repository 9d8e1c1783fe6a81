"""The Python interface, as `import tiler` gives it: the command line calls the same functions."""

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.data.errors import ConfigError
from tiler.config.config import Config, make_config
from tiler.config.config_file import PARAMETERS, POSITIONAL, with_file
from tiler.objects.places import refuse_bucket

if TYPE_CHECKING:
    from tiler.engine.stage import Stage
    from tiler.interface.city_mesh import CityMesh
    from tiler.interface.plan_view import RunPlan
    from tiler.interface.synth import SynthFiles

Source = str | Path


def mesh(
    pointcloud: Source | Sequence[Source],
    footprints: Source = "",
    *,
    progress: bool = True,
    stages: "Sequence[Stage]" = (),
    stage_parameters: Mapping[str, Any] | None = None,
    **parameters: Any,
) -> "CityMesh":
    """Mesh a region: `citystitch run`.

    Parameters
    ----------
    pointcloud : path, or sequence of paths
        LAS, LAZ or COPC files, globs or folders with such files; or one configuration file, ``"x.toml"``.
    footprints : path
        SHP, GPKG, GeoJSON or GeoParquet file of building footprints; without it, terrain only.
    progress : bool
        Whether to tell how far it is: a bar that moves in a notebook, elsewhere what the command shows.
    stages : sequence of Stage
        Stages of your own, run after ours.
    stage_parameters : mapping
        Parameters that these declare.
    **parameters
        All parameters of a run, as `citystitch config` lists them: ``out="out"``, ``mesh_size=10``,
        ``tile_size=600``, ``workers=2``. They win over those of a configuration file.

    Returns
    -------
    CityMesh
        The mesh in the output folder. Tiles that failed are in its ``missing``; the rest is meshed.

    Raises
    ------
    TypeError
        If a parameter is unknown.
    ConfigError
        If a value is of the wrong type or out of bounds; if a script asks for workers and does not
        keep its calls below ``if __name__ == "__main__":``.
    CityError
        If nothing could be made of the input.

    Notes
    -----
    A folder that holds an earlier run, finished or not, is brought up to date: only what has changed is computed,
    and the files are those of a run into an empty folder, byte for byte. Stop a run once (Ctrl-C, or the square of
    the notebook), and what runs is finished; call it again, and it goes on.

    Examples
    --------
    >>> import tiler
    >>> city = tiler.mesh("tiles/*.laz", "buildings.gpkg", mesh_size=10, out="out")  # doctest: +SKIP
    >>> city.check().ok  # doctest: +SKIP
    True
    """
    from tiler.interface.city_mesh import CityMesh
    from tiler.workflow.run import run

    config = _configure(pointcloud, footprints, parameters)
    refuse_bucket(config.out, "a mesh in Python")
    _check_script(config.workers)
    run(config, stages=stages, parameters=stage_parameters, **_show(progress))
    return CityMesh(config.out)


def plan(pointcloud: Source | Sequence[Source], footprints: Source = "", **parameters: Any) -> "RunPlan":
    """Forecast what a run would do and take, from headers alone: `citystitch plan`.

    Parameters
    ----------
    pointcloud, footprints, **parameters
        As for `mesh`.

    Returns
    -------
    RunPlan
        Its numbers in ``facts``; a notebook shows them as text.

    Raises
    ------
    TypeError, CityError
        As `mesh`.

    Examples
    --------
    >>> import tiler
    >>> tiler.plan("tiles/*.laz", "buildings.gpkg", tile_size=600, workers=4)  # doctest: +SKIP
    """
    from tiler.interface.plan_view import plan_config

    return plan_config(_configure(pointcloud, footprints, parameters))


def open_folder(folder: Source) -> "CityMesh":
    """Open the mesh of a finished run.

    Parameters
    ----------
    folder : path
        Folder of the run, ``out`` of `mesh` or of the command line.

    Raises
    ------
    InputError
        If it holds no finished run, or a file of it is missing or damaged.
    """
    from tiler.interface.city_mesh import CityMesh

    return CityMesh(folder)


def write_city(folder: Source, *, size: float = 1000.0, buildings: int = 500, **options: Any) -> "SynthFiles":
    """Write a synthetic city: `citystitch synth`. The same parameters give the same bytes.

    Parameters
    ----------
    folder : path
        Folder to write to; made if it is missing.
    size : float
        Side of the city (m).
    buildings : int
        Their number.
    **options
        ``density`` (points/m²), ``relief`` (height of the hills, m), ``seed``, ``roofs`` ("flat", or "mixed" for
        sloped ones too): see `tiler.interface.synth.write_city`.

    Returns
    -------
    SynthFiles
        Paths of the ``clouds``, the ``footprints`` as GPKG, and others.

    Raises
    ------
    ConfigError
        If a parameter is out of range, or the folder cannot be written.
    """
    from tiler.interface.synth import write_city as write

    return write(Path(folder), size=size, buildings=buildings, **options)


def convert_models(
    models: Source | Sequence[Source],
    output: Source,
    format: str,
    *,
    lod: str = "auto",
    crs: str = "",
    axis_order: str = "",
    tile_size: float = 0.0,
    overwrite: bool = False,
) -> list[str]:
    """Write city models, or that of a run, as another format: `citystitch convert`.

    Parameters
    ----------
    models : path, or sequence of paths
        CityJSON, CityJSONSeq, CityGML or GeoPackage files of one CRS; or the folder of a run.
    output : path
        File to write, or with `tile_size` a folder; it appears whole or not at all.
    format : str
        ``"cityjson"``, ``"cityjsonseq"``, ``"citygml2"``, ``"citygml3"``, ``"gpkg"``, ``"obj"`` or ``"glb"``.
    lod : str
        Level of detail in an OBJ or GLB: ``"auto"``, ``"1.2"``, ``"1.3"`` or ``"2.2"``; others have all.
    crs : str
        CRS of the output; ``""`` for that of the files. Heights stay.
    axis_order : str
        ``"xy"`` or ``"yx"``, against what the files show.
    tile_size : float
        Side of tiles with a file each (m); 0 for one file.
    overwrite : bool
        Whether to replace what is there.

    Returns
    -------
    list of str
        What must be known of the result, a line each: what was left out, changed or assumed, and how often.

    Raises
    ------
    CityError
        If an option or the output does not fit, or a file cannot be read or written.

    Examples
    --------
    >>> import tiler
    >>> tiler.convert_models("city.gml", "city.city.json", "cityjson")  # doctest: +SKIP
    """
    from tiler.convert.convert import Asked
    from tiler.convert.convert import convert_models as convert

    asked = Asked(format, lod, crs, axis_order, tile_size, overwrite)
    return convert(_paths(models), Path(output), asked)


def generalise_models(
    models: Source | Sequence[Source], output: Source, *, workers: int = 0, overwrite: bool = False, **options: Any
) -> list[str]:
    """Make blocks of buildings between streets, in three levels below LoD1: `citystitch generalise`.

    Parameters
    ----------
    models : path, or sequence of paths
        City models, or the folder of a run; ``()`` with `footprints`.
    output : path
        GeoPackage to write; its CityJSON and its table of levels go beside it.
    workers : int
        Processes; 0 for this one. The bytes are the same.
    overwrite : bool
        Whether to replace what is there.
    **options
        As of the command: ``footprints="buildings.gpkg"``, ``roads=["roads.gpkg"]``, ``yard_width=40.0``,
        ``landmark_height=30.0``.

    Returns
    -------
    list of str
        The table of levels, then what was left out, changed or assumed, a line each.

    Raises
    ------
    TypeError
        If an option is unknown.
    CityError
        If options do not go together, or a file cannot be read or written.

    Examples
    --------
    >>> import tiler
    >>> tiler.generalise_models("out", "blocks.gpkg", yard_width=40.0)  # doctest: +SKIP
    """
    from tiler.generalisation.generalise import generalise
    from tiler.generalisation.options import OPTIONS, read_options

    _refuse_unknown(options, OPTIONS, "citystitch generalise --help")
    given = {**options, "models": _paths(models)}
    given |= {name: _paths(given[name]) for name in ("roads", "railways", "water", "others") if name in given}
    given |= {"footprints": Path(given["footprints"])} if given.get("footprints") else {}
    inputs, asked = read_options(given)
    return generalise(inputs, Path(output), asked, workers=workers, overwrite=overwrite)


def detail_models(
    models: Source | Sequence[Source],
    output: Source,
    *,
    viewpoint: Sequence[float] = (),
    distance: Sequence[float] = (),
    keep: Mapping[str, int] | None = None,
    **options: Any,
) -> list[str]:
    """Put windows, doors and balconies on the walls of city models by rules: `citystitch detail`.

    Parameters
    ----------
    models, output
        As for `convert_models`; the file ends with ``.glb``, ``.json`` (CityJSON) or ``.jsonl`` (CityJSONSeq).
    viewpoint : (x, y, z)
        Viewpoint in the CRS of the output (m); ``()`` for full detail.
    distance : (full, reduced)
        Distances (m) up to which assets are full, and from which on they are flat.
    keep : mapping of str to int
        The least share of polygons (per cent) by semantics, such as ``{"door": 40}``.
    **options
        As of the command: ``rules="apartments"``, ``facing=90.0``, ``overwrite=True``, and ``lod``, ``crs`` and
        ``axis_order`` as of `convert_models`.

    Returns
    -------
    list of str
        What must be known of the result, then the table of polygons by criterion, a line each.

    Raises
    ------
    TypeError
        If an option is unknown.
    CityError
        If an option or a rule does not fit, or a file cannot be read or written.

    Examples
    --------
    >>> import tiler
    >>> tiler.detail_models("city.city.json", "city.glb", viewpoint=(78640, 457940, 20))  # doctest: +SKIP
    """
    from tiler.detail.detail import DetailAsked
    from tiler.detail.detail import detail_models as detail

    _refuse_unknown(options, [one.name for one in fields(DetailAsked)], "citystitch detail --help")
    words: dict[str, Any] = {"viewpoint": ",".join(map(str, viewpoint)), "distance": ",".join(map(str, distance))}
    words["keep"] = ",".join(f"{label}={percent}" for label, percent in (keep or {}).items())
    return detail(_paths(models), Path(output), DetailAsked(**words, **options))


def _paths(several: Source | Sequence[Source]) -> list[Path]:
    return [Path(one) for one in ([several] if isinstance(several, (str, Path)) else several)]


def _check_script(workers: int) -> None:
    """Refuse a script that its own workers would run again: they are processes that import it."""
    path = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    if workers and path.suffix == ".py" and path.is_file() and "__name__" not in path.read_text(errors="replace"):
        raise ConfigError(
            f"workers = {workers}: each imports {path}, which would mesh again; put its calls below "
            'if __name__ == "__main__":, or give workers=0'
        )


def _show(progress: bool) -> dict[str, Any]:
    """Choose the watcher that shows the progress of a run."""
    from tiler.interface.notebook_progress import NotebookProgress, in_notebook

    if not progress:
        return {}
    if in_notebook():
        return {"watchers": [NotebookProgress()]}
    from tiler.monitoring.terminal import make_view

    return {"watchers": [make_view()]}


def _configure(pointcloud: Source | Sequence[Source], footprints: Source, parameters: Mapping[str, Any]) -> Config:
    _refuse_unknown(parameters, PARAMETERS)
    sources = [pointcloud] if isinstance(pointcloud, (str, Path)) else pointcloud
    values = {name: _as_text(value) for name, value in parameters.items()}
    values |= {"footprints": str(footprints)} if footprints else {}
    return make_config(with_file({POSITIONAL: list(map(str, sources)), **values}))


def _refuse_unknown(names: Iterable[str], known: Collection[str], command: str = "citystitch config") -> None:
    for name in names:
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"{command} lists all"
            raise TypeError(f"unknown parameter {name!r}; {hint}")


def _as_text(value: Any) -> Any:
    """Paths as texts, alone or in a list."""
    if isinstance(value, (list, tuple)):
        return [_as_text(one) for one in value]
    return str(value) if isinstance(value, Path) else value
