"""Air and houses as two regions: chtMultiRegionFoam runs on what splitMeshRegions makes of an export."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Once
from tests.helpers.foam_reader import read_field
from tests.helpers.programs import run_foam
from tests.helpers.synthetic import run_city
from tiler.export.export import export_run
from tiler.export.foam_files import foam_header

AIR, HOUSE = 300, 320  # K, at the start; both conduct far better than air and brick, so that five steps show it
THERMO = """thermoType {{ type {type}; mixture pureMixture; transport {transport}; thermo hConst;
    equationOfState {state}; specie specie; energy sensibleEnthalpy; }}
mixture {{ specie {{ molWeight 28.9; }} thermodynamics {{ Cp 1000; Hf 0; }} transport {{ {how} }}
    equationOfState {{ rho 2000; }} }}
"""
COUPLED = (
    "type compressible::turbulentTemperatureCoupledBaffleMixed; Tnbr T; kappaMethod {method}; value uniform 300;"
)
SCHEMES = """ddtSchemes { default Euler; } gradSchemes { default Gauss linear; }
divSchemes { default Gauss upwind; div(phi,K) Gauss linear; div(((rho*nuEff)*dev2(T(grad(U))))) Gauss linear; }
laplacianSchemes { default Gauss linear limited corrected 0.5; } interpolationSchemes { default linear; }
snGradSchemes { default limited corrected 0.5; }
"""
SOLVERS = """solvers {
    "rho.*" { solver PCG; preconditioner DIC; tolerance 1e-8; relTol 0; }
    "p_rgh.*" { solver GAMG; smoother GaussSeidel; tolerance 1e-8; relTol 0.01; }
    "(U|h).*" { solver smoothSolver; smoother symGaussSeidel; tolerance 1e-9; relTol 0; } }
PIMPLE { nOuterCorrectors 1; nCorrectors 2; nNonOrthogonalCorrectors 1; }
"""
CONTROL = """application chtMultiRegionFoam; startFrom startTime; startTime 0; stopAt endTime; endTime 0.5;
deltaT 0.1; writeControl timeStep; writeInterval 5; writeFormat binary; timeFormat general;
"""


def put(path: Path, text: str, kind: str = "dictionary") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(foam_header(path.name, kind, location=str(path.parent.name)) + text)


def put_field(
    path: Path, dimensions: str, start: str, patches: dict[str, str], kind: str = "volScalarField"
) -> None:
    rows = "\n".join(f'"{name}" {{ {words} }}' for name, words in patches.items())
    put(path, f"dimensions {dimensions};\ninternalField uniform {start};\nboundaryField\n{{\n{rows}\n}}\n", kind)


@pytest.mark.long
@pytest.mark.parametrize("options", [{}, {"cells": "hybrid"}])
def test_heat_passes_from_houses_into_the_air(once: Once, tmp_path: Path, options: dict[str, str]) -> None:
    run = once("solids", lambda folder: run_city(folder, solids=True)) / "out"
    case = tmp_path / "case"
    export_run(run, case, name="openfoam", options=options)
    said = run_foam("splitMeshRegions", case, "-cellZonesOnly", "-overwrite")
    assert "air_to_building" in said
    put(case / "system/controlDict", CONTROL)
    put(case / "system/fvSolution", SOLVERS)
    put(case / "constant/regionProperties", "regions ( fluid (air) solid (building) );\n")
    put(case / "constant/g", "dimensions [0 1 -2 0 0 0 0];\nvalue (0 0 -9.81);\n", "uniformDimensionedVectorField")
    gas = {"type": "heRhoThermo", "transport": "const", "state": "perfectGas", "how": "mu 18; Pr 0.7;"}
    wall = {"type": "heSolidThermo", "transport": "constIso", "state": "rhoConst", "how": "kappa 1e5;"}
    for region, thermo, method, kelvin in (
        ("air", gas, "fluidThermo", AIR),
        ("building", wall, "solidThermo", HOUSE),
    ):
        put(case / f"constant/{region}/thermophysicalProperties", THERMO.format(**thermo))
        put(case / f"constant/{region}/radiationProperties", "radiation off;\nradiationModel none;\n")
        put(case / f"system/{region}/fvSchemes", SCHEMES)
        put(case / f"system/{region}/fvSolution", SOLVERS)
        patches = {".*": "type zeroGradient;", f"{region}_to_.*": COUPLED.format(method=method)}
        put_field(case / f"0/{region}/T", "[0 0 0 1 0 0 0]", str(kelvin), patches)
    put(case / "constant/air/turbulenceProperties", "simulationType laminar;\n")
    still = {".*": "type fixedValue; value uniform (0 0 0);"}
    put_field(case / "0/air/U", "[0 1 -1 0 0 0 0]", "(0 0 0)", still, "volVectorField")
    pressure = "[1 -1 -2 0 0 0 0]"
    for region in ("air", "building"):
        put_field(case / f"0/{region}/p", pressure, "1e5", {".*": "type calculated; value uniform 1e5;"})
    sides = {".*": "type fixedFluxPressure; value uniform 1e5;", "top": "type fixedValue; value uniform 1e5;"}
    put_field(case / "0/air/p_rgh", pressure, "1e5", sides)
    said = run_foam("chtMultiRegionFoam", case)
    assert len(re.findall(r"^Time = ", said, re.MULTILINE)) == 5
    air, house = (read_field(case / f"0.5/{region}/T", 1) for region in ("air", "building"))
    # Pressure alone, without a coupling, warms air by 0.1 K.
    assert AIR + 2 < np.max(air) < HOUSE
    assert AIR < np.min(house) < HOUSE - 1e-3
    assert np.min(air) > AIR - 1
