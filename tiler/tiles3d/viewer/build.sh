#!/usr/bin/env bash
# Makes libraries.js, the two libraries of the page in one file, draco_*, the decoder of tiles with --compression draco, and
# libraries.txt, their licences. Needs node and npm.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init --yes > /dev/null
npm install --silent --ignore-scripts three@0.187.0 3d-tiles-renderer@0.5.3 esbuild@0.28.2
node node_modules/esbuild/install.js
cp "$here/libraries.mjs" .
npx esbuild libraries.mjs --bundle --format=esm --minify --legal-comments=none --log-level=warning \
    --banner:js="// three.js 0.187.0 (MIT) and 3DTilesRendererJS 0.5.3 (Apache-2.0): see libraries.txt" --outfile="$here/libraries.js"
cp node_modules/three/examples/jsm/libs/draco/gltf/draco_{decoder.wasm,wasm_wrapper.js} "$here"
{
    printf 'three 0.187.0\n\n'
    cat node_modules/three/LICENSE
    printf '\n\n3d-tiles-renderer 0.5.3\n\n'
    cat node_modules/3d-tiles-renderer/LICENSE
    printf '\n\ndraco_decoder.wasm and draco_wasm_wrapper.js, as three 0.187.0 has them\n\n'
    cat node_modules/three/examples/jsm/libs/draco/README.md
} > "$here/libraries.txt"
