// A camera of cameras.json in OpenGL's axes: numbers of its pose and projection, column by column. What is nearer than
// 0.2 is clipped, as by the reference.
export const pose = ({ position, rotation }) =>
  [0, 1, 2].flatMap((column) => [...rotation.map((row) => row[column] * (column ? -1 : 1)), 0]).concat(position, 1);

export const projection = ({ width, height, fx, fy, cx, cy }, near = 0.2, far = 1e7) => [
  2 * fx / width, 0, 0, 0,
  0, 2 * fy / height, 0, 0,
  1 - 2 * cx / width, 2 * cy / height - 1, -(far + near) / (far - near), -1,
  0, 0, -2 * far * near / (far - near), 0];

// The same as a camera of three.js, which may not work it out anew.
export function placed(camera, entry) {
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray(pose(entry));
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  camera.aspect = entry.width / entry.height;
  camera.fov = (360 / Math.PI) * Math.atan(entry.height / (2 * entry.fy));
  [camera.near, camera.far] = [0.2, 1e7];
  camera.projectionMatrix.fromArray(projection(entry));
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.updateProjectionMatrix = () => {};
  return camera;
}

// Draws until the canvas has not changed for six frames, and shows something: 40 frames, and for blank ones 10 s, at most.
export async function settled(canvas, draw) {
  const paper = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  const end = performance.now() + 10000;
  for (let i = 0, same = 0, last = ""; same < 6 && (i < 40 || (!last && performance.now() < end)); i++) {
    await new Promise((resolve) => setTimeout(() => requestAnimationFrame(resolve), 40));
    await draw?.();
    paper.clearRect(0, 0, canvas.width, canvas.height);
    paper.drawImage(canvas, 0, 0);
    const pixels = paper.getImageData(0, 0, canvas.width, canvas.height).data;
    const shown = pixels.some((value, index) => index % 4 < 3 && value > 0) ? pixels.join() : "";
    [same, last] = [shown && shown === last ? same + 1 : 0, shown];
  }
}
