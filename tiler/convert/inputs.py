"""What is converted: buildings of city models or of a run, one at a time, in one CRS with the easting first."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.cityinput.faces import Faces, ModelBuilding
from tiler.cityinput.sources import MODEL, frame_of, kind_of, read_model_header, scan_model
from tiler.formats.cityjsonseq import write_cityjsonseq
from tiler.georeference.crs import box_around, box_words, crs_name, parse_crs, same_crs
from tiler.georeference.frame import Frame, box_to_region, to_region
from tiler.mesh_files.run_files import RUN_RECORD
from tiler.pointclouds.clouds import CloudHeader
from tiler.store.out_folder import CITY_MODEL
from tiler.store.run_folder import read_crs

METRIC_STEP, DEGREE_STEP = 0.001, 1e-9  # of coordinates in plan, in metres and in degrees
HEIGHT_STEP = 0.001  # m


@dataclass(frozen=True, eq=False)
class ModelSource:
    """City models that are read as often as a writer needs."""

    files: tuple[tuple[Path, Frame], ...]  # the files, and how the coordinates of each become those of the output
    crs: pyproj.CRS | None  # CRS of the output, with heights where one names them; None where none is known
    # (3,): box around all vertices, easting first
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    notes: tuple[str, ...]  # what must be known of the files
    told: Counter[str]  # what was left out or changed, by what it is; each reading counts anew
    # Whether storeys of buildings, roads, plant cover and trees are there.
    around: bool = field(default=False, kw_only=True)

    @property
    def in_degrees(self) -> bool:
        """Whether coordinates in plan are degrees."""
        return self.crs is not None and self.crs.is_geographic

    @property
    def step(self) -> NDArray[np.float64]:
        """Coordinates are whole multiples of this, float64 (3,)."""
        plan = DEGREE_STEP if self.in_degrees else METRIC_STEP
        return np.array([plan, plan, HEIGHT_STEP])

    def buildings(self) -> Iterator[ModelBuilding]:
        """Give each building, in the order of the files."""
        self.told.clear()
        for path, frame in self.files:
            for each in scan_model(path, attributes=True, around=self.around):
                if isinstance(each, ModelBuilding):
                    self.told["what cannot be read"] += len(each.faults)
                    self.told["buildings without surfaces"] += not each.shapes
                    yield _place(each, frame)
                elif isinstance(each, Counter):
                    self.told.update({f"objects of type {kind}, left out": n for kind, n in each.items()})
                elif not isinstance(each, str):
                    self.told["surfaces of terrain, left out"] += 1


@contextmanager
def open_source(
    paths: Sequence[Path], *, crs: str = "", axis_order: str = "", around: bool = False
) -> Iterator[ModelSource]:
    """Open city models, or the city model of a run.

    Parameters
    ----------
    paths : sequence of Path
        Files of one CRS, or the folder of a run.
    crs : str
        CRS of the output; ``""`` for that of the files.
    axis_order : str
        ``"xy"`` or ``"yx"``, against what the files show.
    around : bool
        As of `ModelSource`.

    Raises
    ------
    InputError
        If a file is no city model or damaged, or the files differ in their CRSs.
    ConfigError
        If `crs` is given for files that have none, or is unknown.

    Notes
    -----
    Every file is read once for its extent, its CRS and the order of its axes. The model of a run waits as a
    sequence in a temporary folder, as a document would be read as a whole.
    """
    with TemporaryDirectory() as folder:
        copies = (Path(folder) / f"{k}.jsonl" for k in range(len(paths)))
        headers = [_read_header(*each, axis_order, around=around) for each in zip(paths, copies, strict=True)]
        own = headers[0].crs
        for other in headers[1:]:
            if (own is None) != (other.crs is None) or (own and other.crs and not same_crs(own, other.crs)):
                names = [crs_name(one.crs) if one.crs else "no CRS" for one in (headers[0], other)]
                raise InputError(
                    f"{other.path}: {names[1]}; {headers[0].path}: {names[0]}; convert them one by one, with --crs"
                )
        frames = [frame_of(header, crs) for header in headers]
        # The box of a header has the easting first already.
        straight = [Frame(source=frame.source, target=frame.target) for frame in frames]
        boxes = [box_to_region(one, header.bounds[:4]) for one, header in zip(straight, headers, strict=True)]
        xmin, ymin, xmax, ymax = box_around(boxes)
        yield ModelSource(
            tuple((header.path, frame) for header, frame in zip(headers, frames, strict=True)),
            parse_crs(crs) if crs else own,
            np.array([xmin, ymin, min(header.bounds[4] for header in headers)]),
            np.array([xmax, ymax, max(header.bounds[5] for header in headers)]),
            tuple(f"{one.path}: {note}" for one in headers for note in (one.unread, _axes_note(one)) if note),
            Counter(),
            around=around,
        )


def _axes_note(header: CloudHeader) -> str:
    first = "northing" if header.swapped else "easting"
    return f"the {first} comes first: {header.axes}" if header.axes else ""


def _read_header(path: Path, sequence: Path, axis_order: str, *, around: bool) -> CloudHeader:
    known = None
    if path.is_dir():
        if not (path / CITY_MODEL).is_file():
            raise InputError(f"{path}: holds no {CITY_MODEL}; give the folder of a finished run, or files")
        write_cityjsonseq(sequence, path / CITY_MODEL)
        known, path = parse_crs(read_crs(path / RUN_RECORD)), sequence
    if kind_of(path) != MODEL:
        raise InputError(f"{path}: is no city model; mesh a point cloud first, then convert the folder of the run")
    header = read_model_header(path, axis_order, around=around)
    if known is not None:  # of a run: the easting comes first, without a word
        header = replace(header, axes="")
    if not header.n_points:
        raise InputError(f"{path}: has no building with a surface; give another file")
    return replace(header, crs=known) if known is not None else header


def _place(building: ModelBuilding, frame: Frame) -> ModelBuilding:
    if not frame.changes_plan:
        return building
    shapes = []
    for shape in building.shapes:
        xy = to_region(frame, shape.faces.xyz[:, :2])
        if not np.isfinite(xy).all():
            box = box_words((*shape.faces.xyz.min(axis=0)[:2], *shape.faces.xyz.max(axis=0)[:2]))
            raise InputError(f"building {building.id}: {box} has no place in {frame.target}; give another --crs")
        xyz = np.column_stack((xy, shape.faces.xyz[:, 2]))
        faces = Faces(xyz, shape.faces.ring_start, shape.faces.face_start, shape.faces.kind)
        shapes.append(replace(shape, faces=faces))
    return replace(building, shapes=tuple(shapes))
