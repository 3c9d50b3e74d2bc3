// What the page computes from the Gaussians themselves.

import * as THREE from "three";

/** Gaussians of lower opacity are neither framed nor focused. */
const OPAQUE = 0.1;
/** Largest distance of a focused Gaussian from the pointer, as a share of the window's height. */
const NEAR = 0.01;

/** Calls `use` with the place in the world and the opacity of every finite, visible Gaussian. */
function forEachVisible(mesh, use) {
  const place = new THREE.Vector3();
  mesh.forEachSplat((_, centre, __, ___, opacity) => {
    if (opacity >= OPAQUE && [centre.x, centre.y, centre.z].every(Number.isFinite)) {
      use(place.copy(centre).applyMatrix4(mesh.matrixWorld));
    }
  });
}

/** Whether a file of Gaussians has y down: a SOG has by definition, a PLY says so in a comment of this program. */
export function hasYDown(bytes, name) {
  const start = new TextDecoder("latin1").decode(bytes.subarray(0, 4096)).split("end_header")[0];
  return /\.sog$/i.test(name) || (start.startsWith("ply") && start.includes("comment axes: y down"));
}

/** The bounding box of visible Gaussians, without the outermost 0.2 % at each end, which may be outliers. */
export function bounds(mesh) {
  const along = { x: [], y: [], z: [] };
  forEachVisible(mesh, (place) => Object.keys(along).forEach((axis) => along[axis].push(place[axis])));
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

/** Place of the foremost visible Gaussian near a point of the window; `null` without one. (0, 0) is the lower left, (1, 1) the
 * upper right. */
export function nearestTo(mesh, camera, point) {
  camera.updateMatrixWorld();
  const project = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse);
  const seen = new THREE.Vector3();
  let [nearest, depth] = [null, 1];
  forEachVisible(mesh, (place) => {
    seen.copy(place).applyMatrix4(project);
    const x = (0.5 * (seen.x + 1) - point.x) * camera.aspect;
    const y = 0.5 * (seen.y + 1) - point.y;
    if (seen.z > -1 && seen.z < depth && Math.hypot(x, y) < NEAR) {
      depth = seen.z;
      nearest = place.clone();
    }
  });
  return nearest;
}
