// gsplat.js, also with as many Gaussians without opacity as it takes to have its sorter work: below 513 in all, that one
// overwrites their places by its list of transforms, which has 1,024 entries at least.
import { settled } from "./camera.js";
import * as SPLAT from "/node_modules/gsplat/dist/index.es.js";

function padded({ vertexCount, positions, rotations, scales, colors }, more) {
  const longer = (array, width, last) => {
    const copy = new array.constructor(width * (vertexCount + more));
    for (let i = 0; i < copy.length; i++) copy[i] = i < array.length ? array[i] : last[i % width];
    return copy;
  };
  const like = (array, width) => longer(array, width, array.slice(0, width)); // the first: no depth is added
  return new SPLAT.SplatData(vertexCount + more, like(positions, 3), like(rotations, 4), like(scales, 3), longer(colors, 4, [0, 0, 0, 0]));
}

export async function show({ width, height, fx, fy, cx, cy, position, rotation }, url, more = 0) {
  const renderer = new SPLAT.WebGLRenderer(document.querySelector("canvas"), []);
  renderer.setSize(width, height);
  const read = new SPLAT.Scene(), scene = new SPLAT.Scene(), camera = new SPLAT.Camera();
  const [near, far] = [0.2, 1e7];
  await SPLAT.PLYLoader.LoadAsync(url, read);
  scene.addObject(new SPLAT.Splat(padded(read.objects[0].data, more)));
  Object.assign(camera.data, { fx, fy, near, far });
  camera.data._updateProjectionMatrix = () => {
    const m = new SPLAT.Matrix4(2 * fx / width, 0, 0, 0, 0, -2 * fy / height, 0, 0,
      2 * cx / width - 1, 1 - 2 * cy / height, far / (far - near), 1, 0, 0, -far * near / (far - near), 0);
    [camera.data._projectionMatrix, camera.data._viewProj] = [m, m.multiply(camera.data.viewMatrix)];
  };
  camera.position = new SPLAT.Vector3(...position);
  camera.rotation = SPLAT.Quaternion.FromMatrix3(new SPLAT.Matrix3(...rotation.flat()));
  await settled(renderer.canvas, () => renderer.render(scene, camera));
}
