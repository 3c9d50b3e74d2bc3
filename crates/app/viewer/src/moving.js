// Gaussians that follow a skeleton. The server makes a skinned mesh; every Gaussian takes the weights of its nearest position.

import { SplatSkinning } from "@sparkjsdev/spark";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { ask } from "./asking.js";

/** Edge of the cells in which positions are looked up, metres, and most cells that a Gaussian is away from the surface. */
const CELL = 0.02;
const FAR = 12;

/** A function that returns the row of the position nearest to a place; -1 if there is none near. */
function nearest(positions) {
  const cells = new Map();
  const key = (x, y, z) => ((x + 1024) * 2048 + y + 1024) * 2048 + z + 1024;
  const cell = (value) => Math.floor(value / CELL);
  for (let row = 0; row < positions.count; row += 1) {
    const at = key(cell(positions.getX(row)), cell(positions.getY(row)), cell(positions.getZ(row)));
    (cells.get(at) ?? cells.set(at, []).get(at)).push(row);
  }
  return ({ x, y, z }) => {
    let [found, least] = [-1, Infinity];
    for (let reach = 1; reach <= FAR && found < 0; reach *= 2) {
      for (let i = -reach; i <= reach; i += 1) {
        for (let j = -reach; j <= reach; j += 1) {
          for (let k = -reach; k <= reach; k += 1) {
            for (const row of cells.get(key(cell(x) + i, cell(y) + j, cell(z) + k)) ?? []) {
              const distance = (positions.getX(row) - x) ** 2 + (positions.getY(row) - y) ** 2 + (positions.getZ(row) - z) ** 2;
              if (distance < least) {
                [found, least] = [row, distance];
              }
            }
          }
        }
      }
    }
    return found;
  };
}

/** The skeleton of shown Gaussians, from the server. `step` gets the server's steps. */
export async function loadSkeleton(splats, address, step) {
  const answer = await ask(address, {}, step);
  const file = await new GLTFLoader().parseAsync(await answer.arrayBuffer(), "");
  let surface = null;
  file.scene.traverse((node) => {
    surface = node.isSkinnedMesh ? node : surface;
  });
  const { position, skinIndex, skinWeight } = surface.geometry.attributes;
  const skinning = new SplatSkinning({ mesh: splats, numBones: surface.skeleton.bones.length });
  const near = nearest(position);
  const [bones, weights] = [new THREE.Vector4(), new THREE.Vector4()];
  splats.forEachSplat((index, centre) => {
    const row = near(centre);
    if (row >= 0) {
      bones.fromBufferAttribute(skinIndex, row);
      weights.fromBufferAttribute(skinWeight, row);
      skinning.setSplatBones(index, bones, weights);
    }
  });
  skinning.skinTexture.needsUpdate = true;
  const mixer = new THREE.AnimationMixer(file.scene);
  const [matrix, place, turn, scale] = [new THREE.Matrix4(), new THREE.Vector3(), new THREE.Quaternion(), new THREE.Vector3()];
  return {
    /** Plays a motion from its start; without a name, the person stands as in the photographs. */
    play(name) {
      mixer.stopAllAction();
      const clip = THREE.AnimationClip.findByName(file.animations, name);
      if (clip) {
        mixer.clipAction(clip).play();
      }
      splats.skinning = clip ? skinning : null;
      splats.updateGenerator();
    },
    /** Moves the Gaussians on by seconds. */
    move(seconds) {
      mixer.update(seconds);
      file.scene.updateMatrixWorld(true);
      surface.skeleton.bones.forEach((bone, row) => {
        matrix.multiplyMatrices(bone.matrixWorld, surface.skeleton.boneInverses[row]).decompose(place, turn, scale);
        skinning.setBoneQuatPos(row, turn, place);
      });
      skinning.updateBones();
    },
  };
}
