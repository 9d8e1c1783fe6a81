"""The wind case of OpenFOAM: steady flow of air at constant density (simpleFoam, k-epsilon) from any direction.

A logarithmic profile or a table at the sides that the wind enters, pressure at those that it leaves by, rough
ground, and a top that drives the flow by the shear of the profile.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tiler.export.foam_case import write_system
from tiler.export.foam_files import foam_header
from tiler.export.foam_part import leaves_beside
from tiler.export.foam_patches import interface_name
from tiler.export.pieces import ROWS
from tiler.export.wind_profile import (
    C_1,
    C_2,
    C_MU,
    PEDESTRIAN_HEIGHT,
    SIDES,
    SIGMA_EPSILON,
    Wind,
    WindTable,
    case_name,
    flow_of,
    split_sides,
)
from tiler.store.run_folder import LEAVES

Profile = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # values by height above ground (m)
AIR = 1.5e-5  # kinematic viscosity, m2/s
FLAT = 1e-3  # m; a top that is level within this moves with the wind
SOLID = ("walls", "roofs")
BUILDINGS = '"building_.*"'
PARTS = '"procBoundary.*"'
PEDESTRIAN = "pedestrian"  # function object, surface and results of it
OUTLET = "outlet"  # sampled by it, too: faces by which the wind leaves

CONDITIONS = """// Wind from {direction:g} degrees at {sides}: change it here, for all parts.
Uref    {speed};  // m/s, at the height Zref above the inlet's lowest point
Zref    {height};  // m
zDir    (0 0 1);
flowDir ({east:.12g} {north:.12g} 0);
z0      uniform {roughness};  // m, roughness length upstream
zGround uniform {ground};  // m, the inlet's lowest point; OpenFOAM v2006 and later find it themselves
d       uniform 0;
"""

TURBULENCE = """simulationType RAS;
RAS
{{
    RASModel kEpsilon;
    turbulence on;
    printCoeffs on;
    // With this sigmaEps the profile of the inlet is a solution (Richards and Hoxey 1993); 1.3 is the usual one.
    kEpsilonCoeffs {{ Cmu {c_mu}; C1 {c_1}; C2 {c_2}; sigmaEps {sigma:.6f}; }}
}}
"""

DRAG = 0.2  # coefficient of leaves
LEAF_WORDS = """// Drag of leaves: - Cd LAD |U| U, Cd = 0.2, with the leaf area density of each zone (field lad).
// The porous source of OpenFOAM is - (nu d + |U| f / 2) U, so f = 2 Cd LAD. k and epsilon have no source.
"""
POROUS = """{zone}
{{
    type    explicitPorositySource;
    active  yes;
    explicitPorositySourceCoeffs
    {{
        selectionMode cellZone;
        cellZone      {zone};
        type          DarcyForchheimer;
        d             (0 0 0);
        f             ({f:.9g} {f:.9g} {f:.9g});
        coordinateSystem {{ type cartesian; origin (0 0 0); rotation {{ type axes; e1 (1 0 0); e2 (0 1 0); }} }}
    }}
}}
"""

SAMPLING = """// Wind {height} m above the ground: one value a triangle of it, that of the cell it is in.
// At the outlet one a face.
{name}
{{
    type            surfaces;
    libs            ("libsampling.so");
    executeControl  onEnd;
    writeControl    onEnd;
    surfaceFormat   raw;
    fields          (U k epsilon);
    interpolationScheme cell;
    surfaces
    (
        {name} {{ type sampledTriSurfaceMesh; surface {name}.obj; source insideCells; interpolate false; }}
        {outlet} {{ type patch; patches ({sides}); interpolate false; }}
    );
}}
"""

ALLRUN = """#!/bin/sh
# Runs the case; WM_PROJECT_DIR must be set, to /usr/share/openfoam with Debian's OpenFOAM.
cd "${{0%/*}}" || exit 1
{command} > log.simpleFoam 2>&1 || {{ echo "simpleFoam failed, see $PWD/log.simpleFoam" >&2; exit 1; }}
"""

ALLRUN_ALL = """#!/bin/sh
# Runs the cases one after the other; each is a folder that can run alone.
cd "${0%/*}" || exit 1
for case in wind_*; do
    "$case/Allrun" || exit 1
done
"""


@dataclass(frozen=True)
class Domain:
    """What a wind case must know of the mesh."""

    patches: Mapping[str, int]  #: faces of each patch of the region's boundary
    #: lowest and highest point of each (m)
    lowest: Mapping[str, float]
    highest: Mapping[str, float]
    #: for each part a file of the heights of the centres of its cells (m), float64; beside them those of cells at
    #: faces between two parts, see `tiler.export.foam_part.FoamPlan`
    heights: Sequence[Path]
    leaves: Sequence[str] = ()  #: zones of cells between leaves

    @property
    def flat_top(self) -> bool:
        """Whether the top is level."""
        return self.highest["top"] - self.lowest["top"] <= FLAT

    def ground_at(self, sides: Sequence[str]) -> float:
        """Return the lowest point of some sides (m)."""
        return min(self.lowest[side] for side in sides)


def write_wind_cases(folder: Path, domain: Domain, wind: Wind, *, parts: int | None) -> list[str]:
    """Write a case for each direction of the wind: in the folder itself for one, in a folder each for several.

    Parameters
    ----------
    folder : Path
        Where the mesh is, which all cases share by symbolic links.
    domain : Domain
        The mesh.
    wind : Wind
        The wind.
    parts : int, optional
        Number of processes.

    Returns
    -------
    list of str
        What the cases are, in words: a line each, and what the mesh does not allow.

    Raises
    ------
    ConfigError
        If the wind has no side to enter or leave by, or a patch with a roughness is not there.

    References
    ----------
    P. J. Richards, R. P. Hoxey, "Appropriate boundary conditions for computational wind engineering models
    using the k-epsilon turbulence model", J. Wind Eng. Ind. Aerodyn. 46-47, 145-153, 1993.
    """
    _check_patches(domain, wind)
    lines = []
    for direction in wind.directions:
        case = folder / case_name(direction) if len(wind.directions) > 1 else folder
        if case != folder:
            _link_mesh(folder, case, parts)
        lines.append(_write_case(case, domain, wind, direction, parts=parts))
    if len(wind.directions) > 1:
        _write_script(folder / "Allrun", ALLRUN_ALL)
        write_system(folder, parts=parts)
    if not domain.flat_top:
        lines.append(
            "the top follows the terrain and is a slip wall, so the wind slows down towards the outlet; "
            "mesh with --top flat for one that drives it"
        )
    if n := domain.patches.get("missing"):
        lines.append(f"{n:,} faces towards missing tiles are slip walls, wherever the wind goes")
    return lines


def _check_patches(domain: Domain, wind: Wind) -> None:
    present = sorted(name for name in domain.patches if name not in (*SIDES, "top", "missing"))
    for name in wind.patches:
        if name not in present:
            known = ", ".join(present[:6]) + (", ..." if len(present) > 6 else "")
            raise ConfigError(
                f"--patch-roughness {name}: the mesh has no such patch that is solid; it has {known}"
            )


def _link_mesh(folder: Path, case: Path, parts: int | None) -> None:
    """Let a case have the mesh of the folder above it."""
    constants = [Path("constant")] if parts is None else [Path(f"processor{n}/constant") for n in range(parts)]
    for constant in constants:
        (case / constant).mkdir(parents=True)
        up = Path(*[".."] * (len(constant.parts) + 1))
        (case / constant / "polyMesh").symlink_to(up / constant / "polyMesh")
    (case / "constant").mkdir(exist_ok=True)
    (case / "constant" / "triSurface").symlink_to(Path("../../constant/triSurface"))
    (case / "case.foam").touch()


def _write_case(case: Path, domain: Domain, wind: Wind, direction: float, *, parts: int | None) -> str:
    inlets, outlets, along = split_sides(direction, [side for side in SIDES if domain.patches.get(side)])
    if not inlets or not outlets:
        which = "enter" if not inlets else "leave"
        raise ConfigError(
            f"--direction {direction:g}: the mesh has no side by which the wind could {which}; give another one, "
            "or leave --case out"
        )
    ground = domain.ground_at(inlets)
    top = domain.highest["top"] - ground
    write_system(
        case,
        parts=parts,
        application="simpleFoam",
        functions=SAMPLING.format(
            name=PEDESTRIAN, height=PEDESTRIAN_HEIGHT, outlet=OUTLET, sides=" ".join(outlets)
        ),
    )
    east, north = flow_of(direction)
    constants = {
        "transportProperties": f"transportModel Newtonian;\nnu {AIR};\n",
        "turbulenceProperties": TURBULENCE.format(c_mu=C_MU, c_1=C_1, c_2=C_2, sigma=SIGMA_EPSILON),
    }
    (case / "constant").mkdir(exist_ok=True)
    for name, text in constants.items():
        (case / "constant" / name).write_text(foam_header(name, "dictionary", location="constant") + text)
    if wind.table is None:
        words = {"speed": wind.speed, "height": wind.height, "roughness": wind.roughness, "ground": ground}
        (case / "constant" / "wind").write_text(
            CONDITIONS.format(**words, direction=direction, sides=", ".join(inlets), east=east, north=north)
        )
    if domain.leaves:
        drag = [(zone, 2 * DRAG * float(zone.rpartition("_")[2])) for zone in domain.leaves]
        sources = "".join(POROUS.format(zone=zone, f=f) for zone, f in drag)
        header = foam_header("fvOptions", "dictionary", location="constant")
        (case / "constant" / "fvOptions").write_text(header + LEAF_WORDS + sources)
    fields = _fields(domain, wind, (east, north), top, Roles(inlets, outlets, [*along, "missing"]))
    starts = [case] if parts is None else [case / f"processor{n}" for n in range(parts)]
    for start, heights in zip(starts, domain.heights, strict=True):
        (start / "0").mkdir(parents=True)
        for name, field in fields.items():
            _write_field(start / "0" / name, field, heights, ground)
        if leaves_beside(heights).exists():
            _write_leaves(start / "0" / LEAVES, leaves_beside(heights))
    run = "simpleFoam" if parts is None else f"mpirun -np {parts} $MPI_FLAGS simpleFoam -parallel"
    _write_script(case / "Allrun", ALLRUN.format(command=run))
    slip = f"; slip along {', '.join(along)}" if along else ""
    over = "driving shear" if domain.flat_top else "slip"
    return (
        f"wind from {direction:g} degrees: in by {', '.join(inlets)}, out by {', '.join(outlets)}{slip}; "
        f"{over} at the top"
    )


def _write_script(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


@dataclass(frozen=True)
class Roles:
    """What sides are for a direction of the wind: entered, left by, passed along."""

    inlets: Sequence[str]
    outlets: Sequence[str]
    along: Sequence[str]


@dataclass(frozen=True)
class Field:
    """A field at the start: class, dimensions, values in cells, uniform or by height, and conditions."""

    kind: str
    dimensions: str
    start: str
    profile: Profile | None
    conditions: str


def _fields(domain: Domain, wind: Wind, flow: tuple[float, float], top: float, roles: Roles) -> dict[str, Field]:
    """Make the fields at the start, by name."""
    east, north = flow
    start = f"uniform ({wind.speed * east:.6g} {wind.speed * north:.6g} 0)"
    k, epsilon = f"uniform {wind.k_at(wind.height):.6g}", f"uniform {wind.epsilon_at(wind.height):.6g}"
    inlets = _inlets(wind, flow, domain.ground_at(roles.inlets))
    slip = "type slip;"
    # The shear that the profile has at any height; the top so takes no momentum from it.
    shear = f"type fixedShearStress; tau ({wind.friction**2 * east:.8g} {wind.friction**2 * north:.8g} 0);"
    moving = domain.flat_top
    fast = float(wind.speed_at(top))
    u_top = f"({fast * east:.6g} {fast * north:.6g} 0)"
    zero = "uniform (0 0 0)"
    tables: dict[str, tuple[str, str, str, dict[str, str]]] = {
        "U": (
            "volVectorField",
            "[0 1 -1 0 0 0 0]",
            start,
            {
                "inlet": inlets["U"],
                "outlet": f"type inletOutlet; inletValue {zero}; value {start};",
                "solid": "type noSlip;",
                "top": f"{shear} value uniform {u_top};" if moving else slip,
            },
        ),
        "p": (
            "volScalarField",
            "[0 2 -2 0 0 0 0]",
            "uniform 0",
            {
                "inlet": "type zeroGradient;",
                "outlet": "type fixedValue; value uniform 0;",
                "solid": "type zeroGradient;",
                "top": "type zeroGradient;" if moving else slip,
            },
        ),
        "k": (
            "volScalarField",
            "[0 2 -2 0 0 0 0]",
            k,
            {
                "inlet": inlets["k"],
                "outlet": f"type inletOutlet; inletValue {k}; value {k};",
                "solid": f"type kqRWallFunction; value {k};",
                "top": f"type fixedValue; value uniform {wind.k_at(top):.6g};" if moving else slip,
            },
        ),
        "epsilon": (
            "volScalarField",
            "[0 2 -3 0 0 0 0]",
            epsilon,
            {
                "inlet": inlets["epsilon"],
                "outlet": f"type inletOutlet; inletValue {epsilon}; value {epsilon};",
                "solid": f"type epsilonWallFunction; value {epsilon};",
                "top": f"type fixedValue; value uniform {wind.epsilon_at(top):.6g};" if moving else slip,
            },
        ),
        "nut": (
            "volScalarField",
            "[0 2 -1 0 0 0 0]",
            "uniform 0",
            {
                "inlet": "type calculated; value uniform 0;",
                "outlet": "type calculated; value uniform 0;",
                "solid": "type nutkWallFunction; value uniform 0;",
                "top": "type calculated; value uniform 0;" if moving else slip,
            },
        ),
    }
    grounds = [name for name in domain.patches if name.startswith("ground_")]
    rough = {**dict.fromkeys(("ground", *grounds), wind.roughness), **wind.patches}
    inner: dict[str, Profile] = {
        "U": lambda h: np.multiply.outer(wind.speed_at(h), np.array([east, north, 0.0])),
        "epsilon": wind.epsilon_at,
    }
    if wind.table is not None and wind.table.k:
        inner["k"] = wind.k_at
    fields = {}
    for name, (kind, dimensions, inside, of_role) in tables.items():
        conditions = {
            **dict.fromkeys(roles.inlets, of_role["inlet"]),
            **dict.fromkeys(roles.outlets, of_role["outlet"]),
            **dict.fromkeys(roles.along, slip),
            "top": of_role["top"],
            **dict.fromkeys(("ground", *grounds, *SOLID, BUILDINGS), of_role["solid"]),
        }
        if name == "nut":
            conditions |= {patch: _rough(z0) for patch, z0 in rough.items()}
        conditions[PARTS] = f"type processor; value {inside};"
        rows = "\n".join(f"    {patch} {{ {text} }}" for patch, text in conditions.items())
        head = f"dimensions      {dimensions};\n"
        fields[name] = Field(kind, head, inside, inner.get(name), f"{rows}\n")
    return fields


def _inlets(wind: Wind, flow: tuple[float, float], ground: float) -> dict[str, str]:
    """Conditions of U, k and epsilon where the wind enters: the logarithmic profile, or a table of it."""
    if wind.table is None:
        inflow = '#include "$FOAM_CASE/constant/wind"\n   '
        kinds = {"U": "Velocity", "k": "K", "epsilon": "Epsilon"}
        return {name: f"type atmBoundaryLayerInlet{kind}; {inflow}" for name, kind in kinds.items()}
    heights = _table_heights(wind.table)
    speeds = np.multiply.outer(wind.speed_at(heights), flow)
    rows = {
        "U": [f"({east:.9g} {north:.9g} 0)" for east, north in speeds],
        "k": [f"{value:.9g}" for value in wind.k_at(heights)],
        "epsilon": [f"{value:.9g}" for value in wind.epsilon_at(heights)],
    }
    return {
        name: f"type fixedProfile; profile table ({' '.join(map('({:.9g} {})'.format, heights, values))}); "
        f"direction (0 0 1); origin {ground:.9g};"
        for name, values in rows.items()
    }


def _table_heights(table: WindTable) -> NDArray[np.float64]:
    """Heights at which OpenFOAM gets a table (m): its own; where epsilon is computed, closer ones between them."""
    if table.epsilon:
        return np.array(table.height)
    return np.union1d(table.height, np.concatenate(([0.0], np.geomspace(0.1, max(table.height[-1], 1.0), 40))))


def _write_field(path: Path, field: Field, heights: Path, ground: float) -> None:
    """Write a field at the start: the profile in cells, by their heights above the inlet's ground."""
    binary = field.profile is not None
    with path.open("wb") as file:
        header = foam_header(path.name, field.kind, location="0", binary=binary)
        file.write((header + field.dimensions).encode())
        if field.profile is None:
            file.write(f"internalField   {field.start};\nboundaryField\n{{\n{field.conditions}}}\n".encode())
            return
        file.write(b"internalField   ")
        _write_values(file, field, heights, ground)
        file.write(f"boundaryField\n{{\n{field.conditions}".encode())
        # A solver begins with what stands here, without asking the process beyond.
        for beyond in sorted(heights.parent.glob(f"*-{heights.name}")):
            name = interface_name(int(heights.name), int(beyond.name.split("-")[0]))
            file.write(f"    {name} {{ type processor; value ".encode())
            _write_values(file, field, beyond, ground)
            file.write(b"}\n")
        file.write(b"}\n")


def _write_leaves(path: Path, leaves: Path) -> None:
    """Write the leaf area density of cells as a field."""
    header = foam_header(path.name, "volScalarField", location="0", binary=True)
    with path.open("wb") as file:
        file.write(f"{header}dimensions      [0 -1 0 0 0 0 0];\n".encode())
        file.write(f"internalField   nonuniform List<scalar> {leaves.stat().st_size // 8}\n(".encode())
        with leaves.open("rb") as rows:
            shutil.copyfileobj(rows, file)
        words = (
            f'    ".*" {{ type calculated; value uniform 0; }}\n    {PARTS} {{ type processor; value uniform 0; }}'
        )
        file.write(f")\n;\nboundaryField\n{{\n{words}\n}}\n".encode())


def _write_values(file: BinaryIO, field: Field, heights: Path, ground: float) -> None:
    """Write the profile at the heights in a file."""
    if field.profile is None:
        return
    n = heights.stat().st_size // 8
    kind = field.kind.removeprefix("vol").removesuffix("Field").lower()
    file.write(f"nonuniform List<{kind}> {n}\n(".encode())
    with heights.open("rb") as rows:
        while len(z := np.fromfile(rows, "<f8", ROWS)):
            values = np.round(field.profile(np.maximum(z - ground, 0.0)), 9)
            file.write(values.astype("<f8").tobytes())
    file.write(b")\n;\n")


def _rough(z0: float) -> str:
    return f"type nutkAtmRoughWallFunction; z0 uniform {z0}; value uniform 0;"
