// The page of `snapsnap view` and `snapsnap studio`. World: metres, y up, a person who faces +z stands near the origin.

import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { fetched } from "./asking.js";
import { inBatches } from "./batches.js";
import { bounds, hasYDown, nearestTo } from "./gaussians.js";
import { listen } from "./keys.js";
import { openLan } from "./lan.js";
import { loadSkeleton } from "./moving.js";
import { save, saveLong } from "./saving.js";
import { openStudio } from "./studio.js";
import "./style.css";

const element = (id) => document.getElementById(id);
const canvas = element("canvas");

function say(text) {
  element("message").textContent = text;
}

// Without this the browser would leave the page for a dropped file.
["dragover", "drop"].forEach((kind) => window.addEventListener(kind, (event) => event.preventDefault()));

/** Where the server has the shown person's files. */
let address = "./";
const links = [...document.querySelectorAll("#downloads a")].map((link) => [link, link.getAttribute("href").slice(2)]);

/** Shows a person of the studio. Without WebGL only the downloads lead there. */
let showMade = async () => {};
const isStudio = document.documentElement.classList.contains("studio");
if (isStudio) {
  element("downloads").classList.add("hidden");
  openLan();
  openStudio((name) => {
    address = `./people/${name}/`;
    links.forEach(([link, file]) => link.setAttribute("href", address + file));
    element("downloads").classList.remove("hidden");
    return showMade();
  });
}

function newRenderer() {
  try {
    return new THREE.WebGLRenderer({ canvas, antialias: false });
  } catch (error) {
    say(
      "This browser does not offer WebGL 2, which the viewer needs. Allow hardware acceleration in its settings or use " +
        "another browser. The downloads below work without it.",
    );
    throw error;
  }
}

const renderer = newRenderer();
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

/** Looks at a scene from the front. */
function lookAt(mesh) {
  mesh.updateMatrixWorld();
  frame(bounds(mesh));
  lookFrom(0);
  redraw();
}

function resize() {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (width > 0 && height > 0) {
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    redraw();
  }
}
window.addEventListener("resize", resize);
// On small screens the buttons take a part of the window.
new ResizeObserver(resize).observe(canvas);
canvas.addEventListener("webglcontextrestored", () => {
  // The new context needs Spark's textures again.
  shown?.updateVersion();
  redraw();
});
resize();

let shown = null;
let asked = 0;

/** Shows the file that `read` returns, unless another one is requested meanwhile. */
async function show(what, read) {
  asked += 1;
  const own = asked;
  say("Loading …");
  let mesh, name, served, overturned;
  try {
    const file = await read();
    ({ name, served, overturned } = file);
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
  mesh.rotation.x = overturned ? Math.PI : 0;
  scene.add(mesh);
  lookAt(mesh);
  element("name").textContent = name;
  const count = (mesh.extSplats ?? mesh.packedSplats).numSplats;
  element("count").textContent = `${count.toLocaleString("en")} Gaussians`;
  document.title = `${name} – snapsnap`;
  // The downloads contain the served file only.
  element("downloads").classList.toggle("hidden", !served);
  element("moving").classList.toggle("hidden", !served);
  [skeleton, moves, element("motion").value] = [null, false, ""];
  say("");
}

async function served() {
  const answer = await fetched(`${address}scene.ply`);
  const name = decodeURIComponent(answer.headers.get("x-name") ?? "scene.ply");
  return { bytes: new Uint8Array(await answer.arrayBuffer()), name, type: SplatFileType.PLY, served: true };
}

/** The scene in a page that `snapsnap convert` wrote. */
const inside = element("scene");

function contained() {
  const bytes = Uint8Array.from(atob(inside.textContent), (letter) => letter.charCodeAt(0));
  return { bytes, name: inside.dataset.name, type: SplatFileType.SPZ };
}

window.addEventListener("drop", (event) => {
  // A photograph beside its place is no scene.
  const file = document.body.classList.contains("making") ? null : event.dataTransfer.files[0];
  if (file) {
    show(file.name, async () => {
      const bytes = new Uint8Array(await file.arrayBuffer());
      return { bytes, name: file.name, overturned: hasYDown(bytes, file.name) };
    });
  }
});

for (const button of document.querySelectorAll("button[data-yaw]")) {
  button.addEventListener("click", () => lookFrom(Number(button.dataset.yaw)));
}

/** Mid-grey, lighter at the top: dark and light people stand out against it. */
function gradient() {
  const picture = document.createElement("canvas");
  [picture.width, picture.height] = [1, 256];
  const context = picture.getContext("2d");
  const colors = context.createLinearGradient(0, 0, 0, picture.height);
  colors.addColorStop(0, "#a0a0a0");
  colors.addColorStop(1, "#585858");
  context.fillStyle = colors;
  context.fillRect(0, 0, picture.width, picture.height);
  const texture = new THREE.CanvasTexture(picture);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}
const GRADIENT = gradient();

function background() {
  const wanted = element("surround").value;
  const own = wanted === "chosen";
  element("background").classList.toggle("hidden", !own);
  scene.background = wanted === "gradient" ? GRADIENT : new THREE.Color(own ? element("background").value : wanted);
  redraw();
}
element("surround").addEventListener("input", background);
element("background").addEventListener("input", background);

const stem = () => element("name").textContent.replace(/\.[^.]*$/, "") || "scene";

function screenshot() {
  // The canvas is empty after the current task. Hence it is drawn and read in one task.
  renderer.render(scene, camera);
  return new Promise((done) => canvas.toBlob(done));
}

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
function saveCamera() {
  save(new Blob([JSON.stringify([cameraEntry()], null, 1)], { type: "application/json" }), "cameras.json");
}
element("camera").addEventListener("click", saveCamera);

/** Extensions of the files that take long. */
const LONG = { mesh: "glb", skeleton: "rigged.glb", turntable: "gif" };
for (const link of document.querySelectorAll("#downloads .long")) {
  link.addEventListener("click", (event) => {
    event.preventDefault();
    saveLong(link, `${stem()}.${LONG[link.id]}`, say);
  });
}

function rotate() {
  controls.autoRotate = !controls.autoRotate;
  element("rotate").setAttribute("aria-pressed", controls.autoRotate);
  hold();
}
element("rotate").addEventListener("click", rotate);

function help() {
  const hidden = element("keys").classList.toggle("hidden");
  element("help").setAttribute("aria-expanded", !hidden);
}
element("help").addEventListener("click", help);

/** Turns the scene by 180° about x, for files with y down. */
function turnOver() {
  if (shown) {
    shown.rotation.x = shown.rotation.x === 0 ? Math.PI : 0;
    lookAt(shown);
  }
}

/** Moves the centre of turning to the Gaussian below the pointer. */
canvas.addEventListener("dblclick", (event) => {
  const box = canvas.getBoundingClientRect();
  const at = new THREE.Vector2((event.clientX - box.left) / box.width, (box.bottom - event.clientY) / box.height);
  const place = shown && nearestTo(shown, camera, at);
  if (place) {
    hold();
    camera.position.add(place).sub(controls.target);
    controls.target.copy(place);
    controls.update();
  }
});

/** Turns the camera around its target, radians. */
function turn(yaw, pitch) {
  const away = camera.position.clone().sub(controls.target);
  const place = new THREE.Spherical().setFromVector3(away);
  place.theta += yaw;
  place.phi -= pitch;
  hold();
  camera.position.copy(controls.target).add(away.setFromSpherical(place.makeSafe()));
  controls.update();
}

/** Moves the camera and its target by shares of the picture's height. */
function shift(x, y) {
  const size = 2 * camera.position.distanceTo(controls.target) * Math.tan((0.5 * camera.fov * Math.PI) / 180);
  const move = new THREE.Vector3(x * size, y * size, 0).applyQuaternion(camera.quaternion);
  hold();
  camera.position.add(move);
  controls.target.add(move);
  controls.update();
}

function zoom(factor) {
  hold();
  camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
  controls.update();
}

const saveScreenshot = async () => save(await screenshot(), `${stem()}.png`);
element("screenshot").addEventListener("click", saveScreenshot);
listen({ turn, shift, zoom, lookFrom, rotate, turnOver, saveScreenshot, saveCamera, help });

/** The shown person's skeleton once it is loaded, and whether it moves. */
let skeleton = null;
let moves = false;

element("motion").addEventListener("input", async () => {
  const [mesh, name] = [shown, element("motion").value];
  moves = false;
  element("motion").disabled = true;
  try {
    if (name && !skeleton) {
      say("Making the skeleton …");
      const loaded = await loadSkeleton(mesh, `${address}scene.rigged.glb`, (step) => say(`Making the skeleton: ${step} …`));
      if (mesh !== shown) {
        return;
      }
      skeleton = loaded;
      say("");
    }
    skeleton?.play(element("motion").value);
    moves = Boolean(skeleton && element("motion").value);
  } catch (error) {
    say(`No skeleton: ${error.message ?? error}`);
    element("motion").value = "";
  } finally {
    element("motion").disabled = false;
    redraw();
  }
});

// Number of consecutive frames, and their time in milliseconds.
let drawn = 0;
let busy = 0;
let last = null;
renderer.setAnimationLoop((now) => {
  controls.update();
  still += pressed || controls.autoRotate ? 0 : 1;
  if (still === REST) {
    hold();
    redraw();
  }
  if (moves) {
    skeleton.move(last === null ? 0 : (now - last) / 1000);
    changed = true;
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
showMade = () => show("Cannot show the person", served);
const ready = isStudio ? Promise.resolve() : show("Cannot show the file", inside ? contained : served);
// For tests and the browser's console.
window.snapsnap = { ready, camera: cameraEntry, target: () => controls.target.toArray(), screenshot, lookFrom, renderer, spark };
