// Spark draws each Gaussian as its own instance. On software GPUs the start of an instance costs far more than its four corners:
// frames of a person took 20 s. Real GPUs are as fast with many Gaussians per instance.

import * as THREE from "three";

/** Gaussians per instance. */
const BATCH = 512;

const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]];

/** Changes Spark's renderer to instances of several Gaussians. A renderer with an unexpected shader is not changed. */
export function inBatches(spark) {
  const { geometry, material } = spark;
  const begin = "void main() {";
  const shader = material.vertexShader;
  if (!shader.includes("gl_InstanceID") || shader.split(begin).length !== 2 || shader.includes("position.z")) {
    return;
  }
  const count = { value: 0 };
  material.uniforms.gaussianCount = count;
  // The third coordinate of the corners, which Spark sets to 0, is the index of a Gaussian in its batch.
  const row = `
    int gaussian = gl_InstanceID * ${BATCH} + int(position.z);
    if (gaussian >= gaussianCount) {
      gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
      return;
    }`;
  const [head, body] = shader.replaceAll("gl_InstanceID", "gaussian").split(begin);
  material.vertexShader = `uniform int gaussianCount;\n${head}${begin}${row}${body}`;

  const position = new Float32Array(12 * BATCH);
  const index = new Uint16Array(6 * BATCH);
  for (let i = 0; i < BATCH; i += 1) {
    corners.forEach(([x, y], corner) => position.set([x, y, i], 12 * i + 3 * corner));
    index.set([0, 1, 2, 0, 2, 3].map((corner) => 4 * i + corner), 6 * i);
  }
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setIndex(new THREE.BufferAttribute(index, 1));
  // Spark sets the number of Gaussians.
  Object.defineProperty(geometry, "instanceCount", {
    get: () => Math.ceil(count.value / BATCH),
    set: (value) => {
      count.value = value;
    },
  });
}
