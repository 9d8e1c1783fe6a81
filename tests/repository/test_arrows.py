"""The import arrows of the house: pipeline <- stitch <- tiler, Dask and zarr only where they live."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# What each package may import of ours.
ALLOWED = {"pipeline": {"pipeline"}, "stitch": {"stitch", "pipeline"}, "tiler": {"tiler", "stitch", "pipeline"}}
# The steps of the pipeline that stitch may not see: it takes data rooms and steps, never the composition.
COMPOSING = {"pipeline.city_model.city_steps", "pipeline.simplification.simplify"}
# Libraries with a clock, a disk or a process, and the only places that may import them.
HOMES = {
    "dask": ("tiler/",),
    "distributed": ("tiler/",),
    "zarr": ("tiler/store/",),
    "h5py": ("tiler/formats/xdmf.py", "tiler/formats/cgns.py", "tiler/formats/vtkhdf.py"),
    "laspy": ("tiler/",),
    "lxml": ("tiler/cityinput/citygml.py", "tiler/towns/parameter_files.py"),
    "rasterio": ("tiler/cityinput/rasters.py", "tiler/wind/geotiff.py"),
    "pyogrio": ("tiler/",),
    "meshio": ("tiler/",),
    "rich": ("tiler/",),
    "triangle": ("pipeline/plane_mesh/plane.py",),
    "numba": ("pipeline/data/kernel.py", "tiler/executors/kernels.py"),
}


def sources() -> list[Path]:
    return sorted(path for package in ALLOWED for path in (ROOT / package).rglob("*.py"))


def imports(path: Path, *, at_import: bool = False) -> Iterator[str]:
    """Names of the modules that a file imports; `at_import`: not those of its functions and of types alone."""
    tree = parse(path)
    for node in tree.body if at_import else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def find_wrong_imports(path: Path) -> Iterator[str]:
    """Tell each import that the arrows or the homes of libraries do not allow."""
    place = path.relative_to(ROOT).as_posix()
    package = place.split("/")[0]
    for name in imports(path):
        top = name.split(".")[0]
        composed = package == "stitch" and name in COMPOSING
        if top in ALLOWED and (top not in ALLOWED[package] or composed):
            yield f"{place} imports {name}"
        if top in HOMES and not place.startswith(HOMES[top]):
            yield f"{place} imports {name}"


def test_imports_follow_the_arrows() -> None:
    assert [fault for path in sources() for fault in find_wrong_imports(path)] == []


# Packages in order: each imports only those before it.
ORDER = {
    "tiler": [
        "words", "objects", "config", "store", "georeference", "engine", "monitoring", "vectors",
        "pointclouds", "footprints", "cityinput", "citymodels", "mesh_files", "stages", "landcover", "planning",
        "dashboard", "executors", "jobs", "pictures", "report", "workflow", "editing", "export", "tiles3d",
        "serving", "wind", "formats", "check", "convert", "towns", "generalisation", "textures", "detail",
        "interface", "cli",
    ],
    "pipeline": [
        "data", "geometry", "points_terrain", "generalisation", "skeletons", "architecture", "facades", "roofs",
        "city_model",
        "simplification", "plane_mesh", "quality", "smoothing", "columns",
    ],
    "stitch": ["tiling", "seams", "pieces"],
}  # fmt: skip


@pytest.mark.parametrize("top", sorted(ALLOWED))
def test_a_package_is_a_few_files_and_says_what_it_is(top: str) -> None:
    for package in (path.parent for path in (ROOT / top).glob("*/__init__.py")):
        modules = [path for path in package.glob("*.py") if path.name != "__init__.py"]
        assert 4 <= len(modules) <= 15, package
        assert ast.get_docstring(parse(package / "__init__.py")), package


@pytest.mark.parametrize("top", sorted(ALLOWED))
def test_no_module_lies_beside_the_packages(top: str) -> None:
    assert [path.name for path in (ROOT / top).glob("*.py")] == ["__init__.py"]


@pytest.mark.parametrize("top", sorted(ORDER))
def test_imports_between_packages_go_one_way(top: str) -> None:
    assert sorted(ORDER[top]) == sorted(path.parent.name for path in (ROOT / top).glob("*/__init__.py"))
    for path in (ROOT / top).glob("*/*.py"):
        mine = ORDER[top].index(path.parent.name)
        others = {name.split(".")[1] for name in imports(path) if name.startswith(f"{top}.")}
        assert others <= set(ORDER[top][: mine + 1]), path


@pytest.mark.parametrize("top", sorted(ORDER))
def test_no_modules_import_each_other_in_a_circle(top: str) -> None:
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in (ROOT / top).glob("*/*.py")
    }
    needs = {
        name: (set(imports(path, at_import=True)) & modules.keys()) - {name} for name, path in modules.items()
    }
    assert len(list(TopologicalSorter(needs).static_order())) == len(modules)
