// The city of a folder of 3D Tiles: streamed, coloured, picked and measured.
import {
  Box3, BufferAttribute, BufferGeometry, Color, DirectionalLight, DRACOLoader, GLTFExtensionsPlugin, HemisphereLight, ImplicitTilingPlugin,
  Line, LineBasicMaterial, MapControls, Mesh, MeshLambertMaterial, PerspectiveCamera, Plane, Raycaster, ReorientationPlugin, Scene, Sphere,
  TilesRenderer, Vector2, Vector3, WebGLRenderer,
} from "./libraries.js";

const RAMPS = { height: [0, 60, "m"], roof_rmse: [0, 2, "m"], quality: [1, 0, "radius ratio"] };
const STOPS = ["#30123b", "#28bceb", "#a4fc3c", "#fb7e21", "#7a0403"].map((word) => new Color(word));
const HUES = ["#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#dd8452", "#8c8c8c"].map((word) => new Color(word));
const NONE = new Color("#9a9a9a"), PICKED = new Color("#ffd400");
const NO_NUMBER = -9999;

const get = (id) => document.getElementById(id);
const canvas = get("view");
const renderer = new WebGLRenderer({ canvas, antialias: true, logarithmicDepthBuffer: true });
renderer.setClearColor(0xcfdde8);
const scene = new Scene();
const sun = new DirectionalLight(0xffffff, 1.7);
sun.position.set(0.6, 1, -0.4);
scene.add(new HemisphereLight(0xffffff, 0x8a8578, 1.3), sun);
const camera = new PerspectiveCamera(50, 1, 1, 1e6);
const controls = new MapControls(camera, canvas);
controls.maxPolarAngle = 1.5;
controls.minDistance = 5;

const state = { mode: "surface", picked: null, measuring: false, cutting: false, places: [], bytes: 0, frames: [], first: null, failed: [], classes: new Map(), swaps: 0 };
const meshes = new Set();
let dirty = true;
let city = null; // the sphere around the first content
window.citystitch = { get tiles() { return tiles; }, state, camera, controls, meshes, get section() { return section; } };
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) if (entry.name.includes("/tiles/")) state.bytes += entry.encodedBodySize;
}).observe({ type: "resource", buffered: true });

// Rows of the table of features that a mesh has: read once.
function readRows(mesh) {
  const [info] = mesh.userData.meshFeatures.featureIds;
  return Array.from({ length: info.featureCount }, (_, k) => mesh.userData.structuralMetadata.getPropertyTableData(info.propertyTable, k));
}

function blend([low, high], value) {
  const place = Math.min(Math.max((value - low) / (high - low), 0), 1) * (STOPS.length - 1), k = Math.min(Math.floor(place), STOPS.length - 2);
  return STOPS[k].clone().lerp(STOPS[k + 1], place - k);
}

function ofClass(key) {
  if (!state.classes.has(key)) state.classes.set(key, HUES[state.classes.size % HUES.length]);
  return state.classes.get(key);
}

function colourOf(mesh, row) {
  const { base, level, x, y } = mesh.userData.own;
  if (row.id && row.id === state.picked) return PICKED;
  if (state.mode === "tile") return HUES[(level * 5 + x * 3 + y) % HUES.length];
  if (state.mode === "surface" || (state.mode === "quality" ? row.quality === undefined : !row.id)) return base;
  const value = row[state.mode];
  if (value === undefined || value === null || value === "" || value === NO_NUMBER) return NONE;
  return RAMPS[state.mode] ? blend(RAMPS[state.mode], value) : ofClass(value);
}

function paint(mesh) {
  const { rows } = mesh.userData.own;
  const ids = mesh.geometry.getAttribute("_feature_id_0"), colours = mesh.geometry.getAttribute("color");
  const own = rows.map((row) => colourOf(mesh, row));
  for (let k = 0; k < ids.count; k++) {
    const { r, g, b } = own[ids.getX(k)]; // Draco's ids have gaps between them
    colours.setXYZ(k, r, g, b);
  }
  colours.needsUpdate = true;
}

function paintAll() {
  state.classes.clear();
  for (const mesh of meshes) paint(mesh);
  showLegend();
  dirty = true;
}

function showLegend() {
  const legend = get("legend");
  legend.replaceChildren();
  const add = (mark, text) => {
    const entry = document.createElement("span"), sign = document.createElement("i");
    if (mark) sign.style.background = mark; else sign.className = "ramp";
    entry.append(sign, text);
    legend.append(entry);
  };
  if (RAMPS[state.mode]) add(null, `${RAMPS[state.mode][0]} to ${RAMPS[state.mode][1]} ${RAMPS[state.mode][2]}`);
  for (const [key, colour] of state.classes) add(`#${colour.getHexString()}`, key);
}

// What a feature has no value of keeps the number that says so, for which the library would give 0.
const keepNoData = ({ json }) => ({ name: "keep_no_data", beforeRoot() {
  const classes = Object.values(json.extensions?.EXT_structural_metadata?.schema?.classes ?? {});
  for (const one of classes.flatMap(({ properties }) => Object.values(properties))) if ("noData" in one) one.default ??= one.noData;
} });
const dracoLoader = new DRACOLoader().setDecoderPath("./"); // read when the first tile needs it
function openTiles(place) {
  const own = new TilesRenderer("tiles/tileset.json");
  own.registerPlugin(new ImplicitTilingPlugin());
  own.registerPlugin(new GLTFExtensionsPlugin({ metadata: true, dracoLoader, autoDispose: false, plugins: [keepNoData] }));
  if (place) for (const key of ["position", "quaternion", "scale"]) own.group[key].copy(place[key]);
  else own.registerPlugin(new ReorientationPlugin());
  own.errorTarget = 5; // pixels
  own.setCamera(camera);
  own.addEventListener("load-model", ({ scene: model, tile }) => {
    const { level, x, y } = tile.implicitTilingData;
    model.traverse((mesh) => {
      if (!mesh.isMesh) return;
      const base = mesh.material.color.clone(), { name, side } = mesh.material;
      mesh.material.dispose();
      mesh.material = new MeshLambertMaterial({ vertexColors: true, name, side });
      mesh.geometry.setAttribute("color", new BufferAttribute(new Float32Array(3 * mesh.geometry.getAttribute("position").count), 3));
      mesh.userData.own = { base, level, x, y, rows: readRows(mesh) };
      meshes.add(mesh);
      paint(mesh);
    });
    showLegend();
    dirty = true;
  });
  own.addEventListener("dispose-model", ({ scene: model }) => model.traverse((mesh) => meshes.delete(mesh)));
  own.addEventListener("load-error", ({ error, url }) => {
    state.failed.push(String(url));
    get("trouble").textContent = `${url}: ${error.message}`;
    get("trouble").hidden = false;
  });
  own.addEventListener("needs-update", () => { dirty = true; });
  own.addEventListener("tile-visibility-change", ({ scene: model, visible }) => {
    dirty = true;
    if (city || !visible || !model?.parent) return;
    city = new Box3().setFromObject(model).getBoundingSphere(new Sphere());
    showAll();
  });
  if (!place) own.addEventListener("load-root-tileset", showAll);
  return own;
}

let tiles = openTiles(null);
let coming = null; // the tiles of the edited city, until what is in view of them is there
scene.add(tiles.group);

// Show an edited city: its tiles are read beside those that are shown, unchanged ones from the browser's own store.
function replaceTiles() {
  coming?.dispose();
  coming = openTiles(tiles.group);
  coming.setResolutionFromRenderer(camera, renderer);
  dirty = true;
}
function swapTiles() {
  scene.remove(tiles.group);
  tiles.dispose();
  tiles = coming;
  coming = null;
  scene.add(tiles.group);
  state.swaps += 1;
  if (state.picked) {
    const mesh = [...meshes].find((one) => one.userData.own.rows.some((row) => row.id === state.picked));
    if (mesh) showFeature(mesh, mesh.userData.own.rows.find((row) => row.id === state.picked)); else closePanel();
  }
  if (section.ends) cut(section.ends);
  paintAll();
}
let version = null; // of the tiles, as the server tells it
async function follow() {
  try {
    const { headers } = await fetch("tiles/tileset.json", { method: "HEAD", cache: "no-store" }), found = headers.get("ETag");
    get("section").hidden = !headers.get("Citystitch-Section");
    if (version && found && found !== version) replaceTiles();
    version = found ?? version;
  } catch { /* the server is away: it may come back */ }
  setTimeout(follow, 2000);
}
follow();
controls.addEventListener("change", () => { dirty = true; });

function showAll() {
  const sphere = city ?? new Sphere();
  if (!city) {
    if (!tiles.getBoundingSphere(sphere)) return;
    tiles.group.updateMatrixWorld(true);
    sphere.applyMatrix4(tiles.group.matrixWorld);
  }
  controls.target.copy(sphere.center);
  controls.maxDistance = 20 * sphere.radius;
  camera.position.copy(sphere.center).add(new Vector3(0.25, 0.8, -1).setLength(1.9 * sphere.radius)); // x is west, z is north
  controls.update();
  dirty = true;
}

function hitAt(clientX, clientY) {
  const caster = new Raycaster();
  caster.setFromCamera(new Vector2(clientX / canvas.clientWidth * 2 - 1, 1 - clientY / canvas.clientHeight * 2), camera);
  return caster.intersectObject(tiles.group, true).find((hit) => hit.object.userData.own);
}

function pick(clientX, clientY) {
  const hit = hitAt(clientX, clientY);
  if (state.measuring || state.cutting) return hit && measure(hit.point);
  const row = hit && hit.object.userData.own.rows[hit.object.geometry.getAttribute("_feature_id_0").getX(hit.face.a)];
  state.picked = row && row.id ? row.id : null;
  get("panel").hidden = !row;
  if (row) showFeature(hit.object, row);
  paintAll();
}

function showFeature(mesh, row) {
  get("name").textContent = row.id ?? row.patch ?? "cell of the mesh";
  const { level, x, y } = mesh.userData.own;
  const facts = { ...row, surface: mesh.material.name, tile: `level ${level}, column ${x}, row ${y}` };
  get("facts").replaceChildren(...Object.entries(facts).filter(([key, value]) => key !== "id" && value !== "" && value !== NO_NUMBER).map(([key, value]) => {
    const line = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
    head.textContent = key.replaceAll("_", " ");
    cell.textContent = typeof value === "number" ? value.toFixed(key === "buildings" ? 0 : 2) : value;
    line.append(head, cell);
    return line;
  }));
}

const line = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0xd4006a, depthTest: false }));
line.renderOrder = 1;
line.frustumCulled = false;
scene.add(line);
function measure(point) {
  state.places = state.places.length === 1 ? [state.places[0], point.clone()] : [point.clone()];
  line.geometry.dispose();
  line.geometry = new BufferGeometry().setFromPoints(state.places);
  const [a, b] = state.places;
  if (state.cutting) {
    get("length").textContent = b ? "" : "now the other end of the section";
    if (b) cut([a, b].map((one) => one.clone().applyMatrix4(tiles.group.matrixWorld.clone().invert())));
  } else get("length").textContent = b
    ? `${a.distanceTo(b).toFixed(2)} m; in plan ${Math.hypot(b.x - a.x, b.z - a.z).toFixed(2)} m, up ${(b.y - a.y).toFixed(2)} m`
    : "now the second place";
  dirty = true;
}
function setMeasuring(on) {
  state.measuring = on;
  state.cutting = false;
  get("measure").setAttribute("aria-pressed", on);
  get("section").setAttribute("aria-pressed", Boolean(section.ends));
  state.places = [];
  line.geometry.dispose();
  line.geometry = new BufferGeometry();
  get("length").textContent = on ? "the first place" : "";
  dirty = true;
}

// The section through the volume mesh: cells that the server has cut, coloured by quality; the city before it is hidden.
const section = { ends: null, place: null, across: null, plane: new Plane(), meshes: [] };
function setCutting(on) {
  setMeasuring(false);
  endSection();
  state.cutting = on;
  get("section").setAttribute("aria-pressed", on);
  get("length").textContent = on ? "one end of the section" : "";
}
function endSection() {
  for (const mesh of section.meshes) { scene.remove(mesh); mesh.geometry.dispose(); mesh.material.dispose(); }
  section.ends = null;
  section.meshes = [];
  renderer.clippingPlanes = [];
  dirty = true;
}
async function cut(ends) {
  endSection();
  const reply = await fetch(`section?${new URLSearchParams({ from: ends[0].toArray(), to: ends[1].toArray() })}`);
  if (!reply.ok) { get("length").textContent = (await reply.json()).error; return; }
  const data = await reply.arrayBuffer(), rows = new Float32Array(data, 24), n = rows.length / 10;
  const places = new Float32Array(9 * n), colours = new Float32Array(9 * n), seen = new Map();
  for (let k = 0; k < n; k++) {
    const quality = rows[10 * k + 9];
    if (!seen.has(quality)) seen.set(quality, blend(RAMPS.quality, quality).toArray());
    places.set(rows.subarray(10 * k, 10 * k + 9), 9 * k);
    for (let corner = 0; corner < 3; corner++) colours.set(seen.get(quality), 9 * k + 3 * corner);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
  geometry.computeVertexNormals();
  const look = { emissive: 0xffffff, emissiveIntensity: 0.15, side: 2 };
  section.meshes = [new MeshLambertMaterial({ vertexColors: true, ...look }), new MeshLambertMaterial({ color: 0x202020, wireframe: true })].map((material) => new Mesh(geometry, material));
  const frame = tiles.group.matrixWorld, place = new Vector3(...new Float64Array(data, 0, 3)).applyMatrix4(frame);
  for (const mesh of section.meshes) {
    mesh.matrixAutoUpdate = false;
    mesh.matrix.copy(frame).setPosition(place);
    scene.add(mesh);
  }
  const [a, b] = ends.map((one) => one.clone().applyMatrix4(frame));
  Object.assign(section, { ends, place: a, across: new Vector3(b.z - a.z, 0, a.x - b.x).normalize() });
  renderer.clippingPlanes = [section.plane];
  get("length").textContent = `${seen.size} cells of the section; colours: radius ratio, 1 (dark blue) to 0 (red)`;
  state.measuring = state.cutting = false;
  get("section").setAttribute("aria-pressed", true);
  dirty = true;
}
// What lies on the side of the camera is hidden, but for a hand's breadth before the section.
function turnSection() {
  section.plane.setFromNormalAndCoplanarPoint(section.across, section.place);
  if (section.plane.distanceToPoint(camera.position) > 0) section.plane.negate();
  section.plane.constant += 0.1;
}

function orbit(turn, tilt, scale) {
  const arm = camera.position.clone().sub(controls.target);
  arm.applyAxisAngle(new Vector3(0, 1, 0), turn).multiplyScalar(scale);
  const side = new Vector3(arm.z, 0, -arm.x).normalize(), tilted = arm.clone().applyAxisAngle(side, tilt);
  if (tilted.angleTo(new Vector3(0, 1, 0)) > 0.05 && tilted.y > 0) arm.copy(tilted);
  camera.position.copy(controls.target).add(arm);
  controls.update();
}
function shift(right, ahead) {
  const far = camera.position.distanceTo(controls.target) * 0.1, look = controls.target.clone().sub(camera.position).setY(0).normalize();
  const step = look.clone().multiplyScalar(ahead * far).add(new Vector3(-look.z, 0, look.x).multiplyScalar(right * far));
  camera.position.add(step);
  controls.target.add(step);
  controls.update();
}

let pressed = null;
canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
canvas.addEventListener("pointerup", (event) => {
  if (pressed && event.button === 0 && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 4) pick(event.clientX, event.clientY);
});
get("mode").addEventListener("change", (event) => { state.mode = event.target.value; paintAll(); });
get("measure").addEventListener("click", () => setMeasuring(!state.measuring));
get("section").addEventListener("click", () => setCutting(get("section").getAttribute("aria-pressed") !== "true"));
get("home").addEventListener("click", showAll);
function closePanel() { get("panel").hidden = true; state.picked = null; paintAll(); }
get("close").addEventListener("click", closePanel);
const KEYS = {
  ArrowLeft: () => shift(-1, 0), ArrowRight: () => shift(1, 0), ArrowUp: () => shift(0, 1), ArrowDown: () => shift(0, -1),
  "+": () => orbit(0, 0, 0.8), "=": () => orbit(0, 0, 0.8), "-": () => orbit(0, 0, 1.25), q: () => orbit(-0.15, 0, 1), e: () => orbit(0.15, 0, 1),
  PageUp: () => orbit(0, -0.1, 1), PageDown: () => orbit(0, 0.1, 1), 0: showAll, m: () => setMeasuring(!state.measuring),
  s: () => { if (!get("section").hidden) get("section").click(); },
  Enter: () => pick(canvas.clientWidth / 2, canvas.clientHeight / 2), Escape: () => { setCutting(false); closePanel(); },
  c: () => { const select = get("mode"); select.selectedIndex = (select.selectedIndex + 1) % select.length; select.dispatchEvent(new Event("change")); },
};
window.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || (event.target !== canvas && event.target !== document.body)) return;
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (act) { event.preventDefault(); act(); }
});

function resize() {
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setSize(window.innerWidth, window.innerHeight, false);
  camera.aspect = window.innerWidth / window.innerHeight;
  camera.updateProjectionMatrix();
  for (const one of [tiles, coming]) one?.setResolutionFromRenderer(camera, renderer);
  dirty = true;
}
window.addEventListener("resize", resize);
resize();

function showDetail() {
  const levels = [...tiles.visibleTiles].map((tile) => tile.implicitTilingData?.level).filter((level) => level !== undefined);
  const lods = new Set([...meshes].filter((mesh) => mesh.parent && levels.includes(mesh.userData.own.level)).flatMap((mesh) => mesh.userData.own.rows.map((row) => row.lod)).filter(Boolean));
  const frame = state.frames.reduce((sum, one) => sum + one, 0) / (state.frames.length || 1);
  get("detail").textContent = levels.length
    ? `${levels.length} tiles of level ${Math.min(...levels)} to ${Math.max(...levels)}, LoD ${[...lods].sort().join(", ")}; ${(state.bytes / 1e6).toFixed(1)} MB read${frame ? `; ${frame.toFixed(0)} ms a frame` : ""}`
    : "reading tiles";
}

let before = null; // the time of the frame before, if that was drawn too
renderer.setAnimationLoop((now) => {
  camera.updateMatrixWorld();
  tiles.update();
  if (coming) {
    coming.group.updateMatrixWorld(true);
    coming.update();
    if (coming.visibleTiles.size && !coming.isLoading) swapTiles();
  }
  if (!dirty) { before = null; return; }
  dirty = false;
  if (section.ends) turnSection();
  renderer.render(scene, camera);
  if (before !== null) state.frames = [...state.frames.slice(-29), now - before];
  before = now;
  if (state.first === null && meshes.size && tiles.visibleTiles.size) state.first = performance.now();
  showDetail();
});
