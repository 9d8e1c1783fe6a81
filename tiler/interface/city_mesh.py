"""A finished run as an object: tiles as arrays, buildings, proof, pictures, and files for other programs."""

import base64
import html
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import CityError, ConfigError
from tiler.export.export import export_run
from tiler.mesh_files.run_files import RUN_RECORD, find_files
from tiler.store.atomic import replacing

if TYPE_CHECKING:
    import meshio

    from tiler.check.check import CheckReport
    from tiler.mesh_files.mesh_pieces import MeshPiece, MeshPieces
    from tiler.store.edit_journal import Edit

MOST_CELLS = 5_000_000  # of a mesh that is put together in memory, some 0.5 GB
# Facets up to which a notebook shows the picture unasked: a few seconds, and less than a gigabyte.
MOST_SHOWN = 1_000_000
SHOWN_SIZE = (960, 600)  # pixels
JPEG_QUALITY = 85
MOST_TOLD = 10  # missing tiles, and failed items, that the table lists
NO_BUILDING = -1


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture; a notebook shows it."""

    png: bytes  #: the PNG file

    def __repr__(self) -> str:
        return f"<Picture, PNG of {len(self.png):,} bytes>"

    def _repr_png_(self) -> bytes:
        return self.png

    def save(self, path: Path | str) -> Path:
        """Write the PNG file, whole or not at all; returns its path."""
        with replacing(Path(path)) as part:
            part.write_bytes(self.png)
        return Path(path)


@dataclass(frozen=True, eq=False)
class VectorPicture:
    """A map; a notebook shows it."""

    svg: str  #: the SVG file

    def __repr__(self) -> str:
        return f"<VectorPicture, SVG of {len(self.svg):,} bytes>"

    def _repr_svg_(self) -> str:
        return self.svg

    def save(self, path: Path | str) -> Path:
        """Write the SVG file, whole or not at all; returns its path."""
        with replacing(Path(path)) as part:
            part.write_text(self.svg)
        return Path(path)


@dataclass(frozen=True, eq=False)
class Building:
    """A building of the simplified city model, or a part of one."""

    #: its id, and that of the house: the same where it has no parts
    id: str
    house: str
    number: int  #: what `MeshPiece.building` refers to
    #: absolute heights (m)
    ground: float
    roof: float
    footprint: Any  #: outline as it was meshed (m)
    #: all attributes of the city model: where the height is from, number of roof points, what was changed
    attributes: Mapping[str, Any]


class CityMesh:
    """The mesh of a finished run, read from its folder as it is needed.

    Parameters
    ----------
    folder : Path or str
        Folder of a run.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.

    Notes
    -----
    An object is of the run that was there when it was made: after another run into the same folder, open it again.
    One tile at a time is in memory. In a notebook it shows a table and a picture, which is drawn once.

    Examples
    --------
    >>> import tiler
    >>> city = tiler.open("out")  # doctest: +SKIP
    >>> for piece in city:  # doctest: +SKIP
    ...     print(piece.name, piece.points.shape, piece.cells.shape)
    """

    def __init__(self, folder: Path | str) -> None:
        self._files = find_files(Path(folder))
        self.folder = self._files.directory
        self.tiles: tuple[str, ...] = tuple(path.stem for path in self._files.volumes)
        self._shown = ""

    @cached_property
    def record(self) -> dict[str, Any]:
        """What ``run.json`` holds: parameters, versions, counts, quality, times, and all that was changed."""
        record: dict[str, Any] = json.loads((self.folder / RUN_RECORD).read_bytes())
        return record

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north border of the region (m)."""
        west, south, east, north = self.record["region"]["bounds"]
        return west, south, east, north

    @property
    def crs(self) -> str:
        """CRS of all coordinates."""
        return str(self.record["region"]["crs"])

    @property
    def missing(self) -> dict[str, str]:
        """Tiles that failed and were left out, and why; run again once the cause is mended."""
        return {tile: str(found["reason"]) for tile, found in self.record["missing"].items()}

    @property
    def failed(self) -> dict[str, str]:
        """Other items that failed, as ``"stage name"``, and why: stages of your own, say."""
        return {f"{found['stage']} {found['name']}": str(found["reason"]) for found in self.record["set_aside"]}

    def __len__(self) -> int:
        """Give the number of tiles."""
        return len(self.tiles)

    def __iter__(self) -> Iterator["MeshPiece"]:
        """Read the tiles one after the other, by name."""
        return map(self.read, self.tiles)

    def read(self, tile: str) -> "MeshPiece":
        """Read one tile.

        Parameters
        ----------
        tile : str
            Its name, one of `tiles`.

        Returns
        -------
        MeshPiece
            Points, cells, facets with markers and buildings, and numbers of the points over the whole region.

        Raises
        ------
        ValueError
            If the run has no such tile.
        InputError
            If a file of it is missing or damaged.
        """
        if tile not in self.tiles:
            raise ValueError(f"{self.folder}: no tile {tile!r}; there are {len(self)}: {_few(self.tiles)}")
        return self._pieces.read(self.tiles.index(tile))

    def check(self, *, workers: int = 0) -> "CheckReport":
        """Prove from the written files that the mesh is right: `citystitch check`.

        Parameters
        ----------
        workers : int
            Processes of this machine that look at pieces; with 0 this one does.

        Returns
        -------
        CheckReport
            ``ok``, and ``lines()`` with each claim and its faults.

        Raises
        ------
        InputError
            If a file is missing or cannot be read.
        """
        from tiler.check.check import check_run
        from tiler.store.results import StoredTerrain

        return check_run(self.folder, StoredTerrain, workers=workers)

    def export(self, name: str, path: Path | str, *, overwrite: bool = False, **options: Any) -> Path:
        """Write the mesh for other programs: `citystitch export`.

        Parameters
        ----------
        name : str
            Format: ``"xdmf"``, ``"openfoam"``, ``"msh"``, and all others of `citystitch export --help`.
        path : Path or str
            File or folder; it appears whole or not at all.
        overwrite : bool
            Whether one that exists may be replaced.
        **options
            What the format takes, as ``parts=4`` or ``buildings="patches"``.

        Returns
        -------
        Path
            The path.

        Raises
        ------
        ValueError
            If there is no such format.
        CityError
            If an option or the path cannot be taken, or the file cannot be written.
        """
        export_run(self.folder, Path(path), name=name, overwrite=overwrite, options=options)
        return Path(path)

    def render(
        self, what: str = "boundary", path: Path | str | None = None, *, size: tuple[int, int] | None = None
    ) -> Picture:
        """Draw a picture: `citystitch render`.

        Parameters
        ----------
        what : str
            ``"boundary"``, ``"mesh"``, ``"tiles"``, and all others of `citystitch render --help`.
        path : Path or str, optional
            PNG file to write it to.
        size : (int, int), optional
            Width and height (pixels).

        Returns
        -------
        Picture
            A notebook shows it.

        Raises
        ------
        ValueError
            If there is no such picture.
        CityError
            If pyvista is not installed, VTK finds no OpenGL, a file of the run is damaged, or the picture cannot
            be written.
        """
        from tiler.pictures.render import render_run

        with TemporaryDirectory() as place:
            target = Path(place) / "picture.png" if path is None else Path(path)
            render_run(self.folder, target, what=what, size=size)
            return Picture(target.read_bytes())

    def to_meshio(self, *, most_cells: int = MOST_CELLS) -> "meshio.Mesh":
        """Put the whole mesh together in memory, each point once.

        Parameters
        ----------
        most_cells : int
            Cells that there may be; some 100 bytes of memory each.

        Returns
        -------
        meshio.Mesh
            Block ``tetra`` with all cells, by tile, and ``triangle`` with the facets of the boundary. Cell data:
            ``marker`` (0 of cells), ``building`` (-1 where there is none), and with soil or solids ``region``.

        Raises
        ------
        ConfigError
            If there are more cells.
        InputError
            If a file is missing or damaged.
        """
        import meshio

        n_cells = int(self.record["counts"]["cells"])
        if n_cells > most_cells:
            raise ConfigError(
                f"{self.folder}: {n_cells:,} cells > {most_cells:,} of one mesh in memory; read tile by tile, "
                "export to a file, or raise most_cells"
            )
        parts = list(self)
        points = np.empty((self._pieces.n_points, 3))
        for part in parts:
            points[part.ids] = part.points
        cells = np.concatenate([part.ids[part.cells] for part in parts])
        facets = np.concatenate([part.ids[part.facets] for part in parts])
        marker = np.concatenate([part.marker for part in parts])
        building = np.concatenate([part.building for part in parts])
        data: dict[str, list[NDArray[Any]]] = {
            "marker": [np.zeros(len(cells), marker.dtype), marker],
            "building": [np.full(len(cells), NO_BUILDING, building.dtype), building],
        }
        if len(self._files.regions) > 1:
            regions = [part.region for part in parts if part.region is not None]
            data["region"] = [np.concatenate(regions), np.full(len(facets), -1, np.int8)]
        return meshio.Mesh(points, [("tetra", cells), ("triangle", facets)], cell_data=data)

    def replace(
        self,
        building: str,
        file: Path | str,
        *,
        position: Sequence[float] | None = None,
        date: str = "",
        base: int | None = None,
    ) -> "CityMesh":
        """Put the footprint of a vector file in the place of a building: `citystitch edit --replace`.

        Parameters
        ----------
        building : str
            Id of its footprint.
        file : Path or str
            Vector file with one footprint; CityJSON or GLB with one building.
        position : 3 floats, optional
            Easting, northing and height (m) of the origin of a GLB file.
        date : str
            Day from which on it holds, YYYY-MM-DD; today by default.
        base : int, optional
            Number of the last edit that is known: a later one of the same building is a conflict.

        Returns
        -------
        CityMesh
            The city after the edit; this object is of what was there before.

        Raises
        ------
        CityError
            If the edit is refused or fails; the city is as before.
        """
        return self._edit("replace", building, file, position, date=date, base=base)

    def remove(self, building: str, *, date: str = "", base: int | None = None) -> "CityMesh":
        """Take a building away: `citystitch edit --remove`; all else as for `replace`."""
        return self._edit("remove", building, None, date=date, base=base)

    def add(
        self,
        file: Path | str,
        *,
        position: Sequence[float] | None = None,
        date: str = "",
        base: int | None = None,
    ) -> "CityMesh":
        """Add the footprints of a vector file: `citystitch edit --add`; all else as for `replace`."""
        return self._edit("add", "", file, position, date=date, base=base)

    def at(self, date: str, out: Path | str) -> "CityMesh":
        """Make the city of a day in another folder: `citystitch edit --at`.

        Parameters
        ----------
        date : str
            YYYY-MM-DD: edits of a later date are left out.
        out : Path or str
            Folder on the same disk, which is not there; it shares what is the same by hard links.

        Returns
        -------
        CityMesh

        Raises
        ------
        CityError
            If there is such a folder, or the city cannot be made.
        """
        from tiler.editing.edit import city_at

        city_at(self.folder, date, Path(out))
        return CityMesh(out)

    def edits(self) -> "list[Edit]":
        """List the edits of the folder, by number: `citystitch edit --list`."""
        from tiler.editing.edit import list_edits

        return list_edits(self.folder)

    def _edit(
        self,
        action: str,
        building: str,
        file: Path | str | None,
        position: Sequence[float] | None = None,
        **given: Any,
    ) -> "CityMesh":
        from tiler.editing.edit import edit_city
        from tiler.editing.uploads import Upload

        upload = None if file is None else Upload(Path(file), position)
        edit_city(self.folder, action, building, upload, **given)
        return CityMesh(self.folder)

    def buildings(self) -> Iterator[Building]:
        """Read the simplified city model that was meshed, building by building.

        Yields
        ------
        Building
            In the order of the city model; a house of several heights comes as its parts.

        Raises
        ------
        InputError
            If the city model is missing or damaged.
        """
        from tiler.citymodels.building_index import copy_vertices, has_parts, read_building, read_objects
        from tiler.store.out_folder import CITY_MODEL

        model = self.folder / CITY_MODEL
        with TemporaryFile() as vertex_file:
            vertices = copy_vertices(model, vertex_file)
            for name, thing in read_objects(model):
                if has_parts(model, thing):
                    continue
                row = read_building(model, name, thing, vertices)
                house = thing["parents"][0] if thing.get("parents") else name
                yield Building(name, house, row.number, row.ground, row.roof, row.footprint, thing["attributes"])

    def __repr__(self) -> str:
        facts = [f"{number} {name}" for name, number in self._facts()]
        facts += [f"{len(self.missing):,} tiles missing"] if self.missing else []
        facts += [f"{len(self.failed):,} items failed"] if self.failed else []
        return f"CityMesh({str(self.folder)!r}): {', '.join(facts)}"

    def _repr_html_(self) -> str:
        """Show a picture and what there is, once."""
        if not self._shown:
            rows = "".join(f"<tr><th>{html.escape(a)}</th><td>{html.escape(b)}</td></tr>" for a, b in self._told())
            self._shown = f"<div>{self._draw()}<table>{rows}</table></div>"
        return self._shown

    @cached_property
    def _pieces(self) -> "MeshPieces":
        from tiler.mesh_files.mesh_pieces import open_pieces

        return open_pieces(self.folder)

    def _facts(self) -> list[tuple[str, str]]:
        """Names and numbers of what there is."""
        counts = self.record["counts"]
        return [(name, f"{counts[name]:,}") for name in ("cells", "points", "buildings", "tiles")]

    def _told(self) -> list[tuple[str, str]]:
        """Rows of the table."""
        ratio, angle = (self.record["quality"][name] for name in ("radius_ratio", "min_dihedral"))
        west, south, east, north = self.bounds
        rows = [
            ("folder", str(self.folder)),
            *self._facts(),
            ("region", f"{east - west:,.0f} x {north - south:,.0f} m, {self.crs}"),
            ("radius ratio", f"worst {ratio['0']:.2f}, median {ratio['50']:.2f}"),
            ("least dihedral angle", f"worst {angle['0']:.1f}°, median {angle['50']:.1f}°"),
            ("time", f"{self.record['seconds_total']:.1f} s"),
        ]
        changed = sum(group["count"] for group in self.record["notes"].values())
        rows += [("dropped, repaired, defaulted", f"{changed:,}; see record['notes']")] if changed else []
        rows += [("missing", f"tile {tile}: {reason}") for tile, reason in self.missing.items()][:MOST_TOLD]
        return rows + [("failed", f"{item}: {reason}") for item, reason in self.failed.items()][:MOST_TOLD]

    def _draw(self) -> str:
        """Give the picture as HTML, or say why there is none."""
        n_facets = int(self.record["counts"]["facets"])
        if n_facets > MOST_SHOWN:
            return _explain(f"{n_facets:,} facets > {MOST_SHOWN:,} that are drawn unasked; render() draws them")
        try:
            picture = self.render(size=SHOWN_SIZE)
        except ImportError as error:
            return _explain(f"{error}: pip install citystitch[pictures]")
        except CityError as error:
            return _explain(str(error))
        data = base64.b64encode(_shrink(picture.png)).decode()
        return f'<img alt="{html.escape(repr(self))}" style="max-width:100%" src="data:image/jpeg;base64,{data}">'


def _shrink(png: bytes) -> bytes:
    """Write a PNG file as JPEG: a notebook keeps what it shows, and this is far smaller."""
    from PIL import Image

    small = BytesIO()
    with Image.open(BytesIO(png)) as image:
        image.convert("RGB").save(small, format="jpeg", quality=JPEG_QUALITY, optimize=True)
    return small.getvalue()


def _explain(reason: str) -> str:
    return f"<p>No picture: {html.escape(reason)}</p>"


def _few(names: tuple[str, ...], most: int = 5) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")
