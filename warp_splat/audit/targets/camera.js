// A camera of cameras.json as three.js has it: OpenGL's axes, and a projection with the principal point.
export function placed(camera, { width, height, fx, fy, cx, cy, position, rotation }, three) {
  const [near, far] = [0.01, 1e5], [x, y, z] = [0, 1, 2].map((column) => rotation.map((row) => row[column]));
  camera.matrixAutoUpdate = false;
  camera.matrix.set(x[0], -y[0], -z[0], position[0], x[1], -y[1], -z[1], position[1], x[2], -y[2], -z[2], position[2],
    0, 0, 0, 1);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  camera.aspect = width / height;
  camera.fov = (360 / Math.PI) * Math.atan(height / (2 * fy));
  [camera.near, camera.far] = [near, far];
  camera.projectionMatrix.set(
    2 * fx / width, 0, 1 - 2 * cx / width, 0,
    0, 2 * fy / height, 2 * cy / height - 1, 0,
    0, 0, -(far + near) / (far - near), -2 * far * near / (far - near),
    0, 0, -1, 0);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.updateProjectionMatrix = () => {};
  return camera;
}

export const frames = async (count, draw) => {
  for (let i = 0; i < count; i++) {
    await new Promise((resolve) => setTimeout(() => requestAnimationFrame(resolve), 20));
    await draw();
  }
};
