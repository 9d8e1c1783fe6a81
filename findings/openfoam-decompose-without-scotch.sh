#!/usr/bin/env bash
# OpenFOAM 1912.200626-1+b1 of Debian 12 (package openfoam): decomposePar with `method scotch`, the usual one of tutorials,
# ends with FOAM FATAL ERROR, exit code 1: its scotchDecomp is a stub, and the package has no wmake to build another.
# `hierarchical` divides the same mesh evenly.
# Seen: "scotch: 1, dummy scotchDecomp stub", "hierarchical: 0, processors of 32 32 cells".
# Exits 1 if that changes. Needs Debian 12, and rights to install packages.
set -euo pipefail
DEBIAN_FRONTEND=noninteractive apt-get install -y -qq openfoam=1912.200626-1+b1 > /dev/null
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export WM_PROJECT_DIR=/usr/share/openfoam
cd "$folder"
mkdir -p system constant
head='FoamFile { version 2.0; format ascii; class dictionary; object'
echo "$head controlDict; } application none; startFrom startTime; startTime 0; stopAt endTime; endTime 1; deltaT 1;
writeControl timeStep; writeInterval 1;" > system/controlDict
echo "$head fvSchemes; }" > system/fvSchemes
echo "$head fvSolution; }" > system/fvSolution
echo "$head blockMeshDict; } vertices ((0 0 0) (1 0 0) (1 1 0) (0 1 0) (0 0 1) (1 0 1) (1 1 1) (0 1 1));
blocks (hex (0 1 2 3 4 5 6 7) (4 4 4) simpleGrading (1 1 1)); edges (); boundary ();" > system/blockMeshDict
blockMesh > blockMesh.log
divide() {
    echo "$head decomposeParDict; } numberOfSubdomains 2; method $1; hierarchicalCoeffs { n (2 1 1); delta 0.001; order xyz; }" \
        > system/decomposeParDict
    code=0
    decomposePar -force > "$1.log" 2>&1 || code=$?
}
divide scotch
scotch="$code, $(grep -o 'dummy scotchDecomp stub' scotch.log || true)"
divide hierarchical
hierarchical="$code, processors of $(sed -n 's/.*Number of cells = //p' hierarchical.log | tr '\n' ' ')cells"
echo "scotch: $scotch"
echo "hierarchical: $hierarchical"
[[ $scotch == "1, dummy scotchDecomp stub" && $hierarchical == "0, processors of 32 32 cells" ]]
