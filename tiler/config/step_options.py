"""From the parameters of a run to the options of the steps, and which parameters each of these needs."""

from collections.abc import Sequence
from typing import Any, Literal

import shapely

from pipeline.city_model.city import CityOptions
from pipeline.columns.adaptive import AdaptiveOptions
from pipeline.columns.growth import Growth, count_steps
from pipeline.columns.layered import LayeredOptions
from pipeline.columns.spacing import SpacingLimits
from pipeline.columns.underground import SoilOptions
from pipeline.data.roofs import Weld
from pipeline.plane_mesh.sizes import Finer, SizeRule
from tiler.config.config import Config
from tiler.config.declared import Declared
from tiler.config.domain_height import Domain

# Plane meshes: the paper's, and ours, which Triangle refines again and vertices are moved in.
PAPER_ANGLE = 25.0  # degrees
ADAPTIVE_ANGLE = 28.0  # degrees
ADAPTIVE_REFINEMENTS = 1
ADAPTIVE_PASSES = 4

# Parameters of the city model; two are raised by what the mesh needs, see `derived_parameters`.
CITY_PARAMETERS = (
    *("min_building_area", "vertex_tolerance", "ground_margin", "ground_percentile", "roof_height"),
    *("roof_percentile", "default_height", "roof_clearance_or_spacing", "border", "simplify", "clearance"),
    *(
        "clearance_floor",
        "min_courtyard_area",
        "roofs_or_flat",
        "roof_price",
        "split_levels",
        "roof_group_or_spacing",
        "manifold",
    ),
)
# Further one of the city model where roofs of a model are meshed as they are.
FINER_PARAMETERS = ("finer_clearance",)
# Parameters of seams and plane meshes.
PLANE_PARAMETERS = ("mesh_size", "min_angle", "mesher")
# Further ones of both where sizes are graded.
SIZE_PARAMETERS = ("open_size", "grading")
# Further ones of both where walls or areas are finer than the rest.
REFINE_PARAMETERS = ("wall_size", "wall_growth", "refinements", "refine_growth")
# Further ones of the city model where zones have levels of detail.
ZONE_PARAMETERS = ("zones",)
# Further one where blocks stand for the buildings of some zones.
BLOCK_PARAMETERS = ("blocks_given",)
# Further ones of both where there is a pad; the first also of what reads its terrain.
PAD_PARAMETERS = ("core_bounds", "graded_size")
# Further ones of both where there is land cover: of a run, and what follows from it for its stages.
COVER_PARAMETERS = ("covered", "clearance", "cover_table", "cover_reach")
# Parameters of the columns.
LAYER_PARAMETERS = (
    *("mesh_size", "mesher", "domain_height", "least_spacing", "most_spacing", "stagger", "improve_passes"),
    *("layer_height", "layer_height_or_default", "smoother", "smoothing_tolerance", "fem_tolerance"),
)
# Parameters of the soil, which counts only where it is asked for.
SOIL_PARAMETERS = ("underground", "mesh_size", "least_spacing", "most_spacing", "stagger")


def derived_parameters(config: Config) -> dict[str, float | str | bool]:
    """Parameters that follow from others, by name: a stage that declares one does not depend on the others.

    ``graded_size`` is the largest target edge length of region and pad, ``tile_size_or_default`` the side of a
    tile (m).
    ``roof_clearance_or_spacing`` and ``roof_group_or_spacing`` (m) are at least the least vertical spacing of the
    adaptive mesher, with zones that of the finest: heights closer than that cannot both be exact in a column.
    ``roofs_or_flat`` is "flat" where the mesher or the way to simplify knows no sloped roofs. ``points_of_models``
    says whether points are made on the roofs of city models, ``ground_of_models`` whether they give the ground,
    too: where nothing else does.
    """
    spacing = config.least_spacing * config.finest_size if config.mesher == "adaptive" else 0.0
    return {
        "roofs_or_flat": config.roofs if config.has_sloped_roofs else "flat",
        "layer_height_or_default": config.layer_height_or_default,
        "graded_size": config.graded_size,
        "tile_size_or_default": config.tile_size_or_default,
        "roof_clearance_or_spacing": max(config.roof_clearance, spacing),
        "roof_group_or_spacing": max(config.roof_group, spacing),
        "covered": config.covered,
        "trees_given": bool(config.trees),
        "buildings_given": bool(config.buildings),
        "blocks_given": config.has_blocks,
        "terrain_given": bool(config.terrain),
        "points_of_models": not config.pointcloud,
        "ground_of_models": not config.pointcloud and not config.terrain,
    }


def needs_region(config: Config) -> bool:
    """Whether height, top or pad of the domain follow from what the whole region holds."""
    return config.padded or config.top == "flat" or isinstance(config.domain_height, str)


def layer_parameters(config: Config) -> tuple[str, ...]:
    """Parameters of the columns: those of features only where these are used, so that keys stay without them."""
    growth = ("first_layer", "layer_growth") if config.first_layer else ()
    roofs = ("roofs_or_flat", "roof_clearance_or_spacing") if config.has_sloped_roofs else ()
    top = ("top_elevation",) if config.top == "flat" else ()
    return (*LAYER_PARAMETERS, *growth, *roofs, *top, *(("solids",) if config.solids else ()))


def expected_levels(config: Config, spacing: float) -> float:
    """Number of levels of a column over flat ground, for forecasts, with this spacing without growth (m)."""
    if not config.first_layer:
        return config.expected_height / spacing
    return float(count_steps(config.expected_height, spacing, config.first_layer, config.layer_growth))


def city_options(given: Any) -> CityOptions:
    """Options of steps 1.4 to 2.3; `given` has the parameters as attributes."""
    return CityOptions(
        min_building_area=given.min_building_area,
        vertex_tolerance=given.vertex_tolerance,
        ground_margin=given.ground_margin,
        ground_percentile=given.ground_percentile,
        roof_percentile=given.roof_percentile if given.roof_height == "percentile" else 50.0,
        default_height=given.default_height,
        roof_clearance=given.roof_clearance_or_spacing,
        border="clip" if given.border == "clip" else "drop",
        simplify="paper" if given.simplify == "paper" else "clearance",
        clearance=given.clearance,
        finer_clearance=_optional(given, "finer_clearance", 0.0),
        clearance_floor=given.clearance_floor,
        min_courtyard_area=given.min_courtyard_area,
        roofs=_roofs(given.roofs_or_flat),
        roof_price=given.roof_price,
        split_levels=given.split_levels,
        roof_group=given.roof_group_or_spacing,
        manifold=given.manifold,
    )


def _roofs(name: str) -> Literal["planes", "skeleton", "flat"]:
    return "planes" if name == "planes" else "skeleton" if name == "skeleton" else "flat"


def mesh_options(given: Any, domain: Domain | None = None) -> LayeredOptions | AdaptiveOptions:
    """Options of steps 3.2 to 3.5, of the mesher that is chosen; with a domain, its height and top."""
    if domain is None:
        domain = Domain(given.domain_height, _optional(given, "top_elevation", None))
    first = _optional(given, "first_layer", 0.0)
    growth = Growth(first, given.layer_growth) if first else None
    if given.mesher == "adaptive":
        sloped = _optional(given, "roofs_or_flat", "flat") != "flat"
        return AdaptiveOptions(
            mesh_size=given.mesh_size,
            domain_height=domain.height,
            limits=SpacingLimits(given.least_spacing, given.most_spacing),
            stagger=given.stagger,
            passes=given.improve_passes,
            growth=growth,
            top=domain.top,
            weld=Weld(clearance=given.roof_clearance_or_spacing) if sloped else None,
            solids=_optional(given, "solids", False),
        )
    return LayeredOptions(
        mesh_size=given.mesh_size,
        layer_height=given.layer_height_or_default,
        domain_height=domain.height,
        smoother="fem" if given.smoother == "fem" else "columns",
        tolerance=given.smoothing_tolerance,
        fem_tolerance=given.fem_tolerance,
        growth=growth,
        top=domain.top,
        solids=_optional(given, "solids", False),
    )


def size_rule(given: Any, largest: float) -> SizeRule:
    """Rule of the sizes in the plane, with the largest one (m), 0 where only walls or areas are finer."""
    wall = _optional(given, "wall_size", 0.0)
    growth = given.wall_growth - 1 if wall else 0.0
    return SizeRule(given.mesh_size, largest or given.mesh_size, given.grading, wall, growth)


def is_refined(given: Any) -> bool:
    """Whether walls or areas are finer than the rest; of a run as asked for, before its areas are read, too."""
    if isinstance(given, Config):
        return given.refined
    return bool(_optional(given, "wall_size", 0.0) or _optional(given, "refinements", ()))


def refined_areas(given: Any) -> list[Finer]:
    """Areas that are finer than the rest, those of one size together."""
    areas = _optional(given, "refinements", ())
    return make_finer(areas, given.refine_growth) if areas else []


def make_finer(areas: Sequence[tuple[float, str]], growth: float) -> list[Finer]:
    """Put areas of one size together: size (m) and well-known binary in hexadecimal digits of each."""
    sizes = sorted({size for size, _ in areas})
    shapes = {size: shapely.from_wkb([text for other, text in areas if other == size]) for size in sizes}
    return [Finer(size, growth - 1, shapely.STRtree(shapes[size])) for size in sizes]


def is_covered(given: Any) -> bool:
    """Whether there is land cover."""
    return bool(_optional(given, "covered", False))


def soil_options(given: Any) -> SoilOptions | None:
    """Options of the soil, the same with both meshers; None without soil."""
    if not _optional(given, "underground", 0.0):
        return None
    limits = SpacingLimits(given.least_spacing, given.most_spacing)
    return SoilOptions(given.underground, given.mesh_size, limits, given.stagger)


def plane_options(given: Any) -> dict[str, Any]:
    """Options of step 3.1: ``min_angle``, ``refinements`` and ``passes``."""
    adaptive = given.mesher == "adaptive"
    return {
        "min_angle": given.min_angle or (ADAPTIVE_ANGLE if adaptive else PAPER_ANGLE),
        "refinements": ADAPTIVE_REFINEMENTS if adaptive else 0,
        "passes": ADAPTIVE_PASSES if adaptive else 0,
    }


def _optional(given: Any, name: str, default: Any) -> Any:
    """Value of a parameter that a stage declares only where it counts."""
    return given.get(name, default) if isinstance(given, Declared) else getattr(given, name, default)
