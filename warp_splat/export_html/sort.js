// Runs in a worker. Sorts the Gaussians by depth, nearest first: a counting sort by 16 bits of the depth's float32
// number, which for positive numbers grows as they do and divides each factor of two alike.
"use strict";
let means, depths, bits, near, width;
const starts = new Uint32Array(1 << 16);

// Those from `begin` to `end`.
function sort([x, y, z], [fx, fy, fz], begin, end) {
  let least = Infinity, most = 0, seen = 0;
  for (let i = begin; i < end; i++) {
    depths[i] = (means[3 * i] - x) * fx + (means[3 * i + 1] - y) * fy + (means[3 * i + 2] - z) * fz;
    const depth = depths[i];
    if (depth > near) {
      seen++;
      if (depth < least) least = depth;
      if (depth > most) most = depth;
    }
  }
  const [low, high] = new Uint32Array(new Float32Array([least, most]).buffer);
  const shift = Math.max(0, 16 - Math.clz32(high - low));
  starts.fill(0);
  for (let i = begin; i < end; i++) if (depths[i] > near) starts[(bits[i] - low) >>> shift]++;
  for (let key = 0, sum = 0; key < starts.length; key++) {
    const size = starts[key];
    starts[key] = sum;
    sum += size;
  }
  const order = new Uint32Array(width * Math.ceil(seen / width)); // whole rows of a texture
  for (let i = begin; i < end; i++) if (depths[i] > near) order[starts[(bits[i] - low) >>> shift]++] = i;
  return [order, seen];
}

onmessage = ({ data }) => {
  if (data.total !== undefined) {
    ({ near, width } = data);
    means = new Float32Array(3 * data.total);
    depths = new Float32Array(data.total);
    bits = new Uint32Array(depths.buffer);
  } else if (data.means) {
    means.set(data.means, 3 * data.first);
  } else {
    const start = performance.now(), { version, range } = data;
    const [order, visible] = sort(data.position, data.forward, ...range);
    postMessage({ order, visible, version, range, milliseconds: performance.now() - start }, [order.buffer]);
  }
};
