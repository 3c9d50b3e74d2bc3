// Draws files of Gaussians in other people's viewers, in headless Chromium: which of them shows a PLY upright?
//
//   npm install @playcanvas/supersplat-viewer@1.36.2 @sparkjsdev/spark@2.2.0 three@0.180.0 babylonjs@9.35.0 babylonjs-loaders@9.35.0 playwright-core@1.64.1
//   node viewers_reference.mjs OUT VIEWER FILE [VIEWER FILE …]        VIEWER is supersplat, spark or babylon
//
// Writes OUT/VIEWER-FILE.png for each pair. The viewers look at the person from +z with the viewer's own up direction.

import { createServer } from "node:http";
import { readFile, mkdir } from "node:fs/promises";
import { basename, extname, join } from "node:path";
import { chromium } from "playwright-core";

const [out, ...rest] = process.argv.slice(2);
const modules = join(process.cwd(), "node_modules");
const TYPES = { ".js": "text/javascript", ".html": "text/html", ".css": "text/css", ".json": "application/json" };
const SETTINGS = {
  version: 2,
  tonemapping: "none",
  highPrecisionRendering: false,
  background: { color: [0.4, 0.4, 0.4] },
  postEffectSettings: {
    sharpness: { enabled: false, amount: 0 },
    bloom: { enabled: false, intensity: 1, blurLevel: 2 },
    grading: { enabled: false, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
    vignette: { enabled: false, intensity: 0.5, inner: 0.3, outer: 0.75, curvature: 1 },
    fringing: { enabled: false, intensity: 0.5 },
  },
  animTracks: [],
  cameras: [{ initial: { position: [0, 0.9, 3], target: [0, 0.9, 0], fov: 50 } }],
  annotations: [],
  startMode: "default",
};
// SuperSplat shows a PLY in its own axes, in which a file with y up stands below the floor.
const below = structuredClone(SETTINGS);
Object.assign(below.cameras[0].initial, { position: [0, -0.9, 3], target: [0, -0.9, 0] });

const SPARK = `<!doctype html><style>body{margin:0}</style><script type="importmap">{"imports":{"three":"/m/three/build/three.module.js","three/addons/":"/m/three/examples/jsm/",
"@sparkjsdev/spark":"/m/@sparkjsdev/spark/dist/spark.module.js"}}</script><script type="module">
import * as THREE from "three"; import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true }); renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement); const scene = new THREE.Scene(); scene.background = new THREE.Color(0x666666);
const camera = new THREE.PerspectiveCamera(50, innerWidth / innerHeight, 0.1, 100); camera.position.set(0, 0.9, 3); camera.lookAt(0, 0.9, 0);
scene.add(new SparkRenderer({ renderer })); const mesh = new SplatMesh({ url: new URLSearchParams(location.search).get("content") });
scene.add(mesh); await mesh.initialized; renderer.setAnimationLoop(() => renderer.render(scene, camera));
setTimeout(() => { document.title = "shown"; }, 8000); </script>`;

const BABYLON = `<!doctype html><style>body{margin:0}canvas{width:100vw;height:100vh}</style><canvas id="c"></canvas>
<script src="/m/babylonjs/babylon.js"></script><script src="/m/babylonjs-loaders/babylonjs.loaders.js"></script><script type="module">
const engine = new BABYLON.Engine(document.getElementById("c"), true); const scene = new BABYLON.Scene(engine);
scene.useRightHandedSystem = true; scene.clearColor = new BABYLON.Color4(0.4, 0.4, 0.4, 1);
const camera = new BABYLON.FreeCamera("camera", new BABYLON.Vector3(0, 0.9, 3), scene); camera.setTarget(new BABYLON.Vector3(0, 0.9, 0));
camera.fov = 50 * Math.PI / 180; camera.minZ = 0.1;
await BABYLON.ImportMeshAsync(new URLSearchParams(location.search).get("content"), scene);
engine.runRenderLoop(() => scene.render()); </script>`;

const files = new Map();
const server = createServer(async (request, response) => {
  const { pathname } = new URL(request.url, "http://localhost");
  try {
    let body;
    if (pathname === "/spark.html") body = SPARK;
    else if (pathname === "/babylon.html") body = BABYLON;
    else if (pathname === "/settings.json") body = JSON.stringify(SETTINGS);
    else if (pathname === "/below.json") body = JSON.stringify(below);
    else if (pathname.startsWith("/f/")) body = await readFile(files.get(basename(pathname)));
    else if (pathname.startsWith("/m/")) body = await readFile(join(modules, pathname.slice(3)));
    else body = await readFile(join(modules, "@playcanvas/supersplat-viewer/public", pathname));
    response.writeHead(200, { "Content-Type": TYPES[extname(pathname)] ?? "application/octet-stream" }).end(body);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const host = `http://127.0.0.1:${server.address().port}`;
await mkdir(out, { recursive: true });
const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"],
});
for (let i = 0; i + 1 < rest.length; i += 2) {
  const [viewer, file] = [rest[i], rest[i + 1]];
  files.set(basename(file), file);
  const page = await browser.newPage({ viewport: { width: 420, height: 560 } });
  page.on("pageerror", (error) => console.error(`${viewer} ${file}: ${error}`));
  const content = `/f/${basename(file)}`;
  const settings = file.endsWith(".ply") && !file.includes("down") ? "/below.json" : "/settings.json";
  const url = viewer !== "supersplat" ? `/${viewer}.html?content=${content}` : `/index.html?webgl&noui&noanim&content=${content}&settings=${settings}`;
  await page.goto(host + url);
  await page.waitForTimeout(viewer === "supersplat" ? 25_000 : 15_000);
  await page.screenshot({ path: join(out, `${viewer}-${basename(file)}.png`), timeout: 120_000 });
  console.log(`${viewer} ${file}`);
  await page.close();
}
await browser.close();
server.close();
