"""Case files of OpenFOAM around a mesh: enough for `checkMesh`, or a wind simulation to start from.

The wind case is steady flow of air at constant density (simpleFoam, k-epsilon) from the west: a logarithmic
profile at the inlet (Richards and Hoxey, 1993), slip at the other sides and the top, rough ground, smooth walls.
"""

import math
from collections.abc import Mapping
from pathlib import Path

from tiler.export.foam_files import foam_header

CASES = ("wind",)
SPEED, HEIGHT, ROUGHNESS = 5.0, 10.0, 0.5  # m/s at m above the inlet's lowest point; m
KAPPA, C_MU = 0.41, 0.09
AIR = 1.5e-5  # kinematic viscosity, m2/s
ITERATIONS = 500
PROCESSES = 4  # of decomposePar, where the mesh is written whole
INLET, OUTLET = "west", "east"
WALLS = '"(walls|roofs|building_.*)"'
SLIP = '"(south|north|top|missing)"'
PARTS = '"procBoundary.*"'

CONTROL = """application     {application};
startFrom       latestTime;
startTime       0;
stopAt          endTime;
endTime         {end};
deltaT          1;
writeControl    timeStep;
writeInterval   100;
purgeWrite      2;
writeFormat     binary;
writePrecision  10;
timeFormat      general;
runTimeModifiable true;
{libs}"""

# Limited throughout: a few faces of a city are more than 70 degrees from orthogonal.
SCHEMES = """ddtSchemes { default steadyState; }
gradSchemes { default cellLimited Gauss linear 1; }
divSchemes
{
    default none;
    div(phi,U) bounded Gauss linearUpwind grad(U);
    div(phi,k) bounded Gauss upwind;
    div(phi,epsilon) bounded Gauss upwind;
    div((nuEff*dev2(T(grad(U))))) Gauss linear;
    div(div(phi,U)) Gauss linear;
}
laplacianSchemes { default Gauss linear limited corrected 0.5; }
interpolationSchemes { default linear; }
snGradSchemes { default limited corrected 0.5; }
wallDist { method meshWave; }
"""

SOLUTION = """solvers
{
    "(p|Phi)" { solver GAMG; smoother GaussSeidel; tolerance 1e-8; relTol 0.01; }
    "(U|k|epsilon)" { solver smoothSolver; smoother symGaussSeidel; tolerance 1e-9; relTol 0.05; }
    T { solver PCG; preconditioner DIC; tolerance 1e-10; relTol 0; }
}
SIMPLE
{
    nNonOrthogonalCorrectors 1;
    residualControl { p 1e-4; U 1e-5; "(k|epsilon)" 1e-5; }
}
potentialFlow { nNonOrthogonalCorrectors 5; }
relaxationFactors
{
    fields { p 0.3; }
    equations { U 0.5; "(k|epsilon)" 0.4; }
}
"""

CONDITIONS = """// Wind at the inlet: change it here, for all parts.
Uref    {speed};  // m/s, at the height Zref above the inlet's lowest point
Zref    {height};  // m
zDir    (0 0 1);
flowDir (1 0 0);
z0      uniform {roughness};  // m, roughness length upstream
zGround uniform {ground};  // m, the inlet's lowest point; OpenFOAM v2006 and later find it themselves
d       uniform 0;
"""


def write_system(folder: Path, *, parts: int | None, case: str | None) -> None:
    """Write ``system``, without which no program of OpenFOAM starts.

    Parameters
    ----------
    folder : Path
        The case.
    parts : int, optional
        Number of processes.
    case : {"wind"}, optional
        What to simulate.
    """
    libs = 'libs ("libatmosphericModels.so");\n' if case else ""
    texts = {
        "controlDict": CONTROL.format(
            application="simpleFoam" if case else "checkMesh", end=ITERATIONS if case else 0, libs=libs
        ),
        "fvSchemes": SCHEMES,
        "fvSolution": SOLUTION,
    }
    texts["decomposeParDict"] = f"numberOfSubdomains {parts or PROCESSES};\nmethod scotch;\n"
    (folder / "system").mkdir()
    for name, text in texts.items():
        (folder / "system" / name).write_text(foam_header(name, "dictionary", location="system") + text)


def write_wind_case(folder: Path, starts: list[Path], *, ground: float) -> None:
    """Write ``constant`` and ``0`` of the wind case.

    Parameters
    ----------
    folder : Path
        The case.
    starts : list of Path
        Where to put the fields at the start: the case itself, or the folder of each process.
    ground : float
        Lowest point of the inlet (m).

    References
    ----------
    P. J. Richards, R. P. Hoxey, "Appropriate boundary conditions for computational wind engineering models
    using the k-epsilon turbulence model", J. Wind Eng. Ind. Aerodyn. 46-47, 145-153, 1993.
    """
    constants = {
        "transportProperties": f"transportModel Newtonian;\nnu {AIR};\n",
        "turbulenceProperties": "simulationType RAS;\nRAS { RASModel kEpsilon; turbulence on; printCoeffs on; }\n",
    }
    (folder / "constant").mkdir(exist_ok=True)
    for name, text in constants.items():
        (folder / "constant" / name).write_text(foam_header(name, "dictionary", location="constant") + text)
    values = {"speed": SPEED, "height": HEIGHT, "roughness": ROUGHNESS, "ground": ground}
    (folder / "constant" / "wind").write_text(CONDITIONS.format(**values))
    for start in starts:
        (start / "0").mkdir(parents=True)
        for name, (kind, text) in _fields().items():
            (start / "0" / name).write_text(foam_header(name, kind, location="0") + text)


def _fields() -> dict[str, tuple[str, str]]:
    """Make the fields at the start, by name, with their classes."""
    friction = KAPPA * SPEED / math.log((HEIGHT + ROUGHNESS) / ROUGHNESS)
    wind, still = f"uniform ({SPEED} 0 0)", "uniform (0 0 0)"
    k = f"uniform {friction**2 / math.sqrt(C_MU):.6g}"
    epsilon = f"uniform {friction**3 / (KAPPA * (HEIGHT + ROUGHNESS)):.6g}"
    inflow = '#include "$FOAM_CASE/constant/wind"'
    return {
        "U": _field(
            "volVectorField",
            "[0 1 -1 0 0 0 0]",
            wind,
            {
                INLET: f"type atmBoundaryLayerInletVelocity; {inflow}",
                OUTLET: f"type inletOutlet; inletValue {still}; value {wind};",
                "ground": "type noSlip;",
                WALLS: "type noSlip;",
            },
        ),
        "p": _field(
            "volScalarField",
            "[0 2 -2 0 0 0 0]",
            "uniform 0",
            {
                INLET: "type zeroGradient;",
                OUTLET: "type fixedValue; value uniform 0;",
                "ground": "type zeroGradient;",
                WALLS: "type zeroGradient;",
            },
        ),
        "k": _field(
            "volScalarField",
            "[0 2 -2 0 0 0 0]",
            k,
            {
                INLET: f"type atmBoundaryLayerInletK; {inflow}",
                OUTLET: f"type inletOutlet; inletValue {k}; value {k};",
                "ground": f"type kqRWallFunction; value {k};",
                WALLS: f"type kqRWallFunction; value {k};",
            },
        ),
        "epsilon": _field(
            "volScalarField",
            "[0 2 -3 0 0 0 0]",
            epsilon,
            {
                INLET: f"type atmBoundaryLayerInletEpsilon; {inflow}",
                OUTLET: f"type inletOutlet; inletValue {epsilon}; value {epsilon};",
                "ground": f"type epsilonWallFunction; value {epsilon};",
                WALLS: f"type epsilonWallFunction; value {epsilon};",
            },
        ),
        "nut": _field(
            "volScalarField",
            "[0 2 -1 0 0 0 0]",
            "uniform 0",
            {
                INLET: "type calculated; value uniform 0;",
                OUTLET: "type calculated; value uniform 0;",
                "ground": f"type nutkAtmRoughWallFunction; z0 uniform {ROUGHNESS}; value uniform 0;",
                WALLS: "type nutkWallFunction; value uniform 0;",
            },
        ),
    }


def _field(kind: str, dimensions: str, start: str, conditions: Mapping[str, str]) -> tuple[str, str]:
    others = {SLIP: "type slip;", PARTS: f"type processor; value {start};"}
    lines = [f"    {patch} {{ {text} }}" for patch, text in {**conditions, **others}.items()]
    # An include ends with its line.
    rows = "\n".join(lines).replace('wind" }', 'wind"\n    }')
    head = f"dimensions      {dimensions};\ninternalField   {start};\n"
    return kind, f"{head}boundaryField\n{{\n{rows}\n}}\n"
