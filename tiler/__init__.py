"""Everything with a clock, a disk or a process: region, files, runs, the command line, and the Python interface.

    import tiler

    city = tiler.mesh("tiles/*.laz", "buildings.gpkg", out="out")

What stands in ``__all__`` is the interface. It is loaded when it is first used, so that the import is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.data.errors import CityError
    from tiler.interface.api import convert_models, detail_models, generalise_models, mesh, plan, write_city
    from tiler.interface.api import open_folder as open
    from tiler.interface.city_mesh import Building, CityMesh, Picture
    from tiler.interface.plan_view import RunPlan
    from tiler.mesh_files.mesh_pieces import MeshPiece

__all__ = [
    "Building",
    "CityError",
    "CityMesh",
    "MeshPiece",
    "Picture",
    "RunPlan",
    "convert_models",
    "detail_models",
    "generalise_models",
    "mesh",
    "open",
    "plan",
    "write_city",
]

# Where each name is, and what it is called there. None may be that of a module of this package: importing the
# module would take its place.
_PLACES = {
    "Building": ("tiler.interface.city_mesh", "Building"),
    "CityError": ("pipeline.data.errors", "CityError"),
    "CityMesh": ("tiler.interface.city_mesh", "CityMesh"),
    "MeshPiece": ("tiler.mesh_files.mesh_pieces", "MeshPiece"),
    "Picture": ("tiler.interface.city_mesh", "Picture"),
    "RunPlan": ("tiler.interface.plan_view", "RunPlan"),
    "convert_models": ("tiler.interface.api", "convert_models"),
    "detail_models": ("tiler.interface.api", "detail_models"),
    "generalise_models": ("tiler.interface.api", "generalise_models"),
    "mesh": ("tiler.interface.api", "mesh"),
    "open": ("tiler.interface.api", "open_folder"),
    "plan": ("tiler.interface.api", "plan"),
    "write_city": ("tiler.interface.api", "write_city"),
}


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module 'tiler' has no attribute {name!r}")
    place, there = _PLACES[name]
    globals()[name] = value = getattr(import_module(place), there)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
