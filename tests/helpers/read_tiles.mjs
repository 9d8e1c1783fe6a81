// What 3d-tiles-tools and Khronos' glTF-Validator say of a folder of 3D Tiles, as JSON.
// usage: NODE_PATH=$(npm root -g) node read_tiles.mjs FOLDER
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const require = createRequire(import.meta.url);
const validator = require("gltf-validator");
const { TilesetSources, TilesetTraversers } = await import(pathToFileURL(require.resolve("3d-tiles-tools")));
const folder = process.argv[2];
const source = await TilesetSources.createAndOpen(folder);
const tiles = [], messages = [];
for await (const one of await TilesetTraversers.createTraversedTilesIterable(source, "tileset.json", true, false)) {
  const { boundingVolume, geometricError } = await one.asFinalTile();
  const contents = (await one.getFinalContents()).map((content) => content.uri);
  if (contents.some((uri) => uri.includes("{"))) continue; // the root of the tiling itself, before its subtrees
  tiles.push({ level: one.level, region: boundingVolume.region, error: geometricError, contents });
}
for (const uri of new Set(tiles.flatMap((tile) => tile.contents))) {
  const words = { maxIssues: 0, ignoredIssues: ["UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"] }; // of the metadata that it does not know
  const report = await validator.validateBytes(new Uint8Array(readFileSync(join(folder, uri))), words);
  messages.push(...report.issues.messages.map((message) => `${uri}: ${message.code} ${message.message}`));
}
console.log(JSON.stringify({ tiles, messages }));
