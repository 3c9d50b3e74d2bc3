// Spark draws each Gaussian as an instance of its own. Software GPUs begin each instance anew, which costs them far more than its
// four corners: frames of a person took 20 s. Many Gaussians to an instance cost a real GPU nothing.

import * as THREE from "three";

/** Gaussians to an instance. */
const BATCH = 512;

const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]];

/** Lets a renderer of Spark's draw so; one whose shader does not look as expected is left as it is. */
export function inBatches(spark) {
  const { geometry, material } = spark;
  const begin = "void main() {";
  const shader = material.vertexShader;
  if (!shader.includes("gl_InstanceID") || shader.split(begin).length !== 2 || shader.includes("position.z")) {
    return;
  }
  const count = { value: 0 };
  material.uniforms.gaussianCount = count;
  // The row of a Gaussian in its batch comes as the third coordinate of its corners, which is 0 elsewhere.
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
