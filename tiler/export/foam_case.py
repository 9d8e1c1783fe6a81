"""The folder ``system`` of an OpenFOAM case: enough for `checkMesh`, or a solver's schemes and solvers."""

import math
from pathlib import Path

from tiler.export.foam_files import foam_header

ITERATIONS = 500
PROCESSES = 4  # of decomposePar, where the mesh is written whole

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
writePrecision  12;
timeFormat      general;
runTimeModifiable true;
{libs}"""

# A few faces of a city are more than 70 degrees from orthogonal, so Laplacians are limited, and gradients where
# they are convected. Limited gradients in the production of k would take half of the turbulence from bare ground.
SCHEMES = """ddtSchemes { default steadyState; }
gradSchemes { default Gauss linear; limited cellLimited Gauss linear 1; }
divSchemes
{
    default none;
    div(phi,U) bounded Gauss linearUpwind limited;
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

# SIMPLEC with a relaxed pressure: less than half of the iterations of SIMPLE. Without relaxation it diverges on
# flat tetrahedra, and where the wind blows into houses at the side of the domain: docs/wind.md.
SOLUTION = """solvers
{
    "(p|Phi)" { solver GAMG; smoother GaussSeidel; tolerance 1e-8; relTol 0.01; }
    "(U|k|epsilon)" { solver smoothSolver; smoother symGaussSeidel; tolerance 1e-9; relTol 0.05; }
    T { solver PCG; preconditioner DIC; tolerance 1e-10; relTol 0; }
}
SIMPLE
{
    consistent yes;
    nNonOrthogonalCorrectors 0;
    residualControl { p 1e-4; U 1e-5; "(k|epsilon)" 1e-5; }
}
potentialFlow { nNonOrthogonalCorrectors 5; }
relaxationFactors
{
    fields { p 0.5; }
    equations { U 0.9; "(k|epsilon)" 0.7; }
}
"""


def write_system(folder: Path, *, parts: int | None, application: str | None = None, functions: str = "") -> None:
    """Write ``system``, without which no program of OpenFOAM starts.

    Parameters
    ----------
    folder : Path
        The case.
    parts : int, optional
        Number of processes.
    application : str, optional
        The solver; `checkMesh` if there is none.
    functions : str
        Function objects to run with it.
    """
    ends = {"application": application or "checkMesh", "end": ITERATIONS if application else 0}
    words = f'libs ("libatmosphericModels.so");\nfunctions\n{{\n{functions}}}\n' if application else ""
    texts = {
        "controlDict": CONTROL.format(**ends, libs=words),
        "fvSchemes": SCHEMES,
        "fvSolution": SOLUTION,
        "decomposeParDict": _decomposition(parts or PROCESSES),
    }
    (folder / "system").mkdir(parents=True)
    for name, text in texts.items():
        (folder / "system" / name).write_text(foam_header(name, "dictionary", location="system") + text)


def _decomposition(parts: int) -> str:
    """Write how `decomposePar` divides: in boxes, which every build of OpenFOAM can; Debian's has no scotch.

    Examples
    --------
    >>> _decomposition(6).splitlines()[-1]
    'hierarchicalCoeffs { n (3 2 1); delta 0.001; order xyz; }'
    """
    across = next(n for n in range(math.isqrt(parts), 0, -1) if parts % n == 0)
    coefficients = f"hierarchicalCoeffs {{ n ({parts // across} {across} 1); delta 0.001; order xyz; }}"
    return f"numberOfSubdomains {parts};\nmethod hierarchical;\n{coefficients}\n"
