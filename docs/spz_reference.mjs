// Files of Niantic's own library, built for JavaScript (npm install @adobe/spz@0.2.3), and what it reads from them:
// node docs/spz_reference.mjs tests/data/spz
import { writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const here = createRequire(process.cwd() + "/");
const { default: load } = await import(pathToFileURL(here.resolve("@adobe/spz")).href);
const spz = await load();

let state = 1;
const random = () => {
  state = (state * 1103515245 + 12345) % 2147483648;
  return state / 2147483648;
};
const between = (low, high) => low + (high - low) * random();
const list = (n, value) => Float32Array.from({ length: n }, value);

function cloud(numPoints, shDegree) {
  const rotations = list(4 * numPoints, () => between(-1, 1));
  for (let i = 0; i < rotations.length; i += 4) {
    const length = Math.hypot(...rotations.subarray(i, i + 4));
    for (let j = i; j < i + 4; j++) rotations[j] /= length;
  }
  return {
    numPoints,
    shDegree,
    antialiased: false,
    extensions: [],
    positions: list(3 * numPoints, () => between(-2, 2)),
    scales: list(3 * numPoints, () => between(-9, 0)),
    rotations,
    alphas: list(numPoints, () => between(-6, 6)),
    colors: list(3 * numPoints, () => between(-2, 2)),
    sh: list(3 * numPoints * ((shDegree + 1) ** 2 - 1), () => between(-1, 1)),
  };
}

const plain = (cloud) =>
  Object.fromEntries(
    ["positions", "scales", "rotations", "alphas", "colors", "sh"].map((key) => [key, Array.from(cloud[key])]),
  );

// No turning: what goes in is what is stored.
const from = spz.CoordinateSystem?.UNSPECIFIED ?? 0;
for (const [name, version, points, degree] of [
  ["v2_degree0", 2, 40, 0],
  ["v3_degree0", 3, 40, 0],
  ["v3_degree3", 3, 24, 3],
  ["v4_degree1", 4, 8, 1],
]) {
  const input = cloud(points, degree);
  const bytes = spz.saveSpzToBuffer(input, { version, from, sh1Bits: 5, shRestBits: 4 });
  const output = spz.loadSpzFromBuffer(bytes, { to: from });
  writeFileSync(`${process.argv[2]}/${name}.spz`, bytes);
  writeFileSync(`${process.argv[2]}/${name}.json`, JSON.stringify({ degree, input: plain(input), output: plain(output) }));
}
