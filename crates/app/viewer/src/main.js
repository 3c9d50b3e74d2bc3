// The page of `snapsnap view`. World: metres, y up, a person who faces +z stands near the origin.

import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { inBatches } from "./batches.js";
import "./style.css";

const element = (id) => document.getElementById(id);
const canvas = element("canvas");

const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
const scene = new THREE.Scene();
// The page draws only after changes.
let changed = true;
const redraw = () => {
  changed = true;
};
// The kernel of the program's rasteriser: variances grow by 0.3 pixels², opacity stays, and alpha below 1/255 is omitted.
const spark = new SparkRenderer({
  renderer,
  preBlurAmount: 0.3,
  blurAmount: 0,
  maxStdDev: 3,
  minAlpha: 1 / 255,
  sortRadial: false,
  // Spark sorts the Gaussians for a camera after its first frame.
  onDirty: redraw,
});
inBatches(spark);
scene.add(spark);

// The nominal camera: 2 m away, 8° above the horizon, focal length 0.8 of the picture's height.
const CENTRE = new THREE.Vector3(0, 0.85, 0);
const DISTANCE = 2;
const PITCH = (8 * Math.PI) / 180;
const FIELD = (2 * Math.atan(0.5 / 0.8) * 180) / Math.PI;

const camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
const controls = new OrbitControls(camera, canvas);
controls.enableDamping = true;
controls.listenToKeyEvents(canvas);

/** Frames without a visible move after which the camera stops. Damping alone does not stop it. */
const REST = 60;
let still = 0;
let pressed = false;
controls.addEventListener("change", () => {
  still = 0;
  redraw();
});
controls.addEventListener("start", () => {
  pressed = true;
});
controls.addEventListener("end", () => {
  pressed = false;
  still = 0;
});

/** Ends the damped movement after a drag. */
function hold() {
  controls.enableDamping = false;
  controls.update();
  controls.enableDamping = true;
}

/** Target and distance of the camera, chosen so that the picture contains the whole person. */
let view = { centre: CENTRE.clone(), distance: DISTANCE };

function lookFrom(yawDegrees) {
  const yaw = (yawDegrees * Math.PI) / 180;
  const away = new THREE.Vector3(Math.cos(PITCH) * Math.sin(yaw), Math.sin(PITCH), Math.cos(PITCH) * Math.cos(yaw));
  // Narrow windows need a larger distance.
  const distance = view.distance * Math.max(1, 0.45 / camera.aspect);
  hold();
  controls.target.copy(view.centre);
  camera.position.copy(view.centre).addScaledVector(away, distance);
  controls.update();
}

/** The bounding box of opaque Gaussians, without the outermost 0.2 % at each end, which may be outliers. */
function bounds(mesh) {
  const along = { x: [], y: [], z: [] };
  mesh.forEachSplat((_, centre, __, ___, opacity) => {
    if (opacity >= 0.1 && [centre.x, centre.y, centre.z].every(Number.isFinite)) {
      Object.keys(along).forEach((axis) => along[axis].push(centre[axis]));
    }
  });
  const box = new THREE.Box3();
  const count = along.x.length;
  if (count > 0) {
    const skipped = Math.floor(0.002 * count);
    for (const [axis, values] of Object.entries(along)) {
      const sorted = Float64Array.from(values).sort();
      box.min[axis] = sorted[skipped];
      box.max[axis] = sorted[count - 1 - skipped];
    }
  }
  return box;
}

function frame(box) {
  const size = box.getSize(new THREE.Vector3());
  const centre = box.getCenter(new THREE.Vector3());
  const height = Math.max(size.y, 0.5 * Math.max(size.x, size.z));
  const person = !box.isEmpty() && Number.isFinite(height) && height > 0;
  // The nominal camera fits people who stand at the origin and are no higher than its picture.
  const standing = Math.abs(box.min.y) < 0.3 && Math.hypot(centre.x, centre.z) < 0.3;
  const nominal = standing && height > 1 && box.max.y < 1.95;
  view = nominal || !person
    ? { centre: CENTRE.clone(), distance: DISTANCE }
    : { centre, distance: (DISTANCE * height) / 1.7 };
  camera.near = view.distance / 200;
  camera.far = view.distance * 50;
  camera.updateProjectionMatrix();
}

function resize() {
  renderer.setPixelRatio(window.devicePixelRatio);
  renderer.setSize(window.innerWidth, window.innerHeight, false);
  camera.aspect = window.innerWidth / window.innerHeight;
  camera.updateProjectionMatrix();
  redraw();
}
window.addEventListener("resize", resize);
canvas.addEventListener("webglcontextrestored", () => {
  // The new context needs Spark's textures again.
  shown?.updateVersion();
  redraw();
});
resize();

function say(text) {
  element("message").textContent = text;
}

let shown = null;
let asked = 0;

/** Shows the file that `read` returns, unless another one is requested meanwhile. */
async function show(what, read) {
  asked += 1;
  const own = asked;
  say("Loading …");
  let mesh, name, served;
  try {
    const file = await read();
    ({ name, served } = file);
    mesh = new SplatMesh({ fileBytes: file.bytes, fileName: name, fileType: file.type, extSplats: true });
    await mesh.initialized;
  } catch (error) {
    if (own === asked) {
      say(`${what}: ${error.message ?? error}`);
    }
    return;
  }
  if (own !== asked) {
    mesh.dispose();
    return;
  }
  if (shown) {
    scene.remove(shown);
    shown.dispose();
  }
  shown = mesh;
  scene.add(mesh);
  frame(bounds(mesh));
  lookFrom(0);
  redraw();
  element("name").textContent = name;
  const count = (mesh.extSplats ?? mesh.packedSplats).numSplats;
  element("count").textContent = `${count.toLocaleString("en")} Gaussians`;
  document.title = `${name} – snapsnap`;
  // The downloads contain the served file only.
  element("downloads").classList.toggle("hidden", !served);
  say("");
}

async function served() {
  // The current file, without caches.
  const answer = await fetch("./scene.ply", { cache: "no-store" });
  if (!answer.ok) {
    throw new Error(await answer.text());
  }
  const name = decodeURIComponent(answer.headers.get("x-name") ?? "scene.ply");
  return { bytes: new Uint8Array(await answer.arrayBuffer()), name, type: SplatFileType.PLY, served: true };
}

window.addEventListener("dragover", (event) => event.preventDefault());
window.addEventListener("drop", (event) => {
  event.preventDefault();
  const file = event.dataTransfer.files[0];
  if (file) {
    show(file.name, async () => ({ bytes: new Uint8Array(await file.arrayBuffer()), name: file.name }));
  }
});

for (const button of document.querySelectorAll("button[data-yaw]")) {
  button.addEventListener("click", () => lookFrom(Number(button.dataset.yaw)));
}

function background() {
  scene.background = new THREE.Color(element("background").value);
  redraw();
}
element("background").addEventListener("input", background);

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

const stem = () => element("name").textContent.replace(/\.[^.]*$/, "") || "scene";

function screenshot() {
  // The canvas is empty after the current task. Hence it is drawn and read in one task.
  renderer.render(scene, camera);
  return new Promise((done) => canvas.toBlob(done));
}
element("screenshot").addEventListener("click", async () => save(await screenshot(), `${stem()}.png`));

/** The current camera as an entry of `cameras.json`: OpenCV axes, pixels of the canvas. */
function cameraEntry() {
  camera.updateMatrixWorld();
  const m = camera.matrixWorldInverse.elements;
  // Columns become rows. The y and z axes are reversed.
  const row = (i, sign) => [0, 1, 2, 3].map((j) => sign * m[4 * j + i]);
  const { width, height } = canvas;
  const focal = (0.5 * height) / Math.tan((0.5 * camera.fov * Math.PI) / 180);
  return {
    width,
    height,
    fx: focal,
    fy: focal,
    cx: width / 2,
    cy: height / 2,
    world_to_camera: [row(0, 1), row(1, -1), row(2, -1), [0, 0, 0, 1]],
  };
}
element("camera").addEventListener("click", () => {
  save(new Blob([JSON.stringify([cameraEntry()], null, 1)], { type: "application/json" }), "cameras.json");
});

// Number of consecutive frames, and their time in milliseconds.
let drawn = 0;
let busy = 0;
let last = null;
renderer.setAnimationLoop((now) => {
  controls.update();
  still += pressed ? 0 : 1;
  if (still === REST) {
    hold();
    redraw();
  }
  if (!changed) {
    last = null;
    return;
  }
  changed = false;
  renderer.render(scene, camera);
  if (last !== null) {
    drawn += 1;
    busy += now - last;
  }
  last = now;
  if (busy > 1000) {
    element("rate").textContent = `${Math.round((1000 * drawn) / busy)} frames/s`;
    drawn = 0;
    busy = 0;
  }
});

background();
lookFrom(0);
const ready = show("Cannot show the file", served);
// For tests and the browser's console.
window.snapsnap = { ready, camera: cameraEntry, screenshot, lookFrom, renderer, spark };
