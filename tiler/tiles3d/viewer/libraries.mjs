// What the page takes of three.js and 3DTilesRendererJS; build.sh makes libraries.js of it.
export {
  Box3, BufferAttribute, BufferGeometry, Color, DirectionalLight, HemisphereLight, Line, LineBasicMaterial,
  Mesh, MeshLambertMaterial, PerspectiveCamera, Plane, Raycaster, Scene, Sphere, Vector2, Vector3, WebGLRenderer,
} from "three";
export { DRACOLoader } from "three/examples/jsm/loaders/DRACOLoader.js";
export { MapControls } from "three/examples/jsm/controls/MapControls.js";
export { TilesRenderer } from "3d-tiles-renderer/three";
export { ImplicitTilingPlugin } from "3d-tiles-renderer/core/plugins";
export { GLTFExtensionsPlugin, ReorientationPlugin } from "3d-tiles-renderer/three/plugins";
