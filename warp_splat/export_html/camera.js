// Cameras: as in cameras.json, with the principal point: width, height, fx, fy, cx, cy [px]; position; rotation, the rows
// of world from camera. Here its columns, `axes`, take its place: right, down, forward. They are never changed, only
// replaced.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const sum = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const cross = (a, b) => [0, 1, 2].map((i) => a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);

// `vector` turned by `angle` about the unit vector `about` (Rodrigues).
function turned(vector, about, angle) {
  const along = about.map((value) => value * dot(about, vector) * (1 - Math.cos(angle)));
  return sum(sum(along, vector, Math.cos(angle)), cross(about, vector), Math.sin(angle));
}

// The camera carried around `pivot`: by `yaw` about `up`, then by `pitch` about its own right, but never over the top.
function orbited(camera, pivot, up, yaw, pitch) {
  const tilt = Math.acos(Math.max(-1, Math.min(1, dot(camera.axes[2], up)))); // 0: looks along up
  const bounded = Math.max(Math.min(0, tilt - 3.1), Math.min(Math.max(0, tilt - 0.04), pitch));
  const carried = ({ axes, position }, about, angle) => ({
    ...camera, axes: axes.map((axis) => turned(axis, about, angle)),
    position: sum(pivot, turned(sum(position, pivot, -1), about, angle)),
  });
  const beside = carried(camera, up, yaw);
  return carried(beside, beside.axes[0], bounded);
}

// The camera in an image of another size, which shows all that its own shows, in the middle.
function fitted(camera, width, height) {
  const scale = Math.min(width / camera.width, height / camera.height);
  return {
    ...camera, width, height, fx: camera.fx * scale, fy: camera.fy * scale,
    cx: camera.cx * scale + 0.5 * (width - camera.width * scale),
    cy: camera.cy * scale + 0.5 * (height - camera.height * scale),
  };
}

// Depth of what the camera looks at: the median of those Gaussians that are near its axis.
function focusDepth(camera, means) {
  const [right, down, forward] = camera.axes, depths = [];
  for (let i = 0; i < means.length; i += 3) {
    const offset = [means[i] - camera.position[0], means[i + 1] - camera.position[1], means[i + 2] - camera.position[2]];
    const depth = dot(offset, forward);
    if (depth > 0 && Math.hypot(dot(offset, right), dot(offset, down)) < 0.15 * depth) depths.push(depth);
  }
  return depths.length ? Float64Array.from(depths).sort()[depths.length >> 1] : 1;
}
