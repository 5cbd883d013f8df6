// Runs in a worker. Sorts the Gaussians by depth, nearest first: by the bits of the depth's float32 number, which for
// positive numbers grows as they do. First by the lower half of the bits that differ, then by the upper half.
"use strict";
let means, depths, bits, byLower, near, width;
const starts = [0, 1].map(() => new Uint32Array(1 << 16)); // of each value of a half

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
  const half = (33 - Math.clz32(high - low)) >> 1, mask = (1 << half) - 1, [lower, upper] = starts;
  for (const table of starts) table.fill(0);
  for (let i = begin; i < end; i++) {
    if (!(depths[i] > near)) continue;
    lower[(bits[i] - low) & mask]++;
    upper[(bits[i] - low) >>> half]++;
  }
  for (const table of starts) {
    for (let key = 0, sum = 0; key <= mask; key++) {
      const size = table[key];
      table[key] = sum;
      sum += size;
    }
  }
  const order = new Uint32Array(width * Math.ceil(seen / width)); // whole rows of a texture
  for (let i = begin; i < end; i++) if (depths[i] > near) byLower[lower[(bits[i] - low) & mask]++] = i;
  for (let k = 0; k < seen; k++) order[upper[(bits[byLower[k]] - low) >>> half]++] = byLower[k];
  return [order, seen];
}

onmessage = ({ data }) => {
  if (data.total !== undefined) {
    ({ near, width } = data);
    means = new Float32Array(3 * data.total);
    depths = new Float32Array(data.total);
    bits = new Uint32Array(depths.buffer);
    byLower = new Uint32Array(data.total);
  } else if (data.means) {
    means.set(data.means, 3 * data.first);
  } else {
    const start = performance.now(), { version, range } = data;
    const [order, visible] = sort(data.position, data.forward, ...range);
    postMessage({ order, visible, version, range, milliseconds: performance.now() - start }, [order.buffer]);
  }
};
