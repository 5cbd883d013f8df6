// A parallelogram around the ellipse where a 2D Gaussian reaches ALPHA_MIN: a square in the coordinates of its root.
// Four vertices each, not an instance: software renderers take a millisecond for fifty of these.
uniform highp usampler2D order; // which Gaussian, nearest first
uniform highp usampler2D meanAndRoot, rootAndColor; // of project.glsl
uniform vec2 size; // px
uniform int first; // of the order, in this call
flat out vec2 mean;
flat out vec3 root;
flat out vec4 color; // and opacity

void main() {
  int index = int(texel(order, first + gl_VertexID / 4).x);
  uvec4 first = texel(meanAndRoot, index), second = texel(rootAndColor, index);
  mean = uintBitsToFloat(first.xy);
  root = uintBitsToFloat(uvec3(first.zw, second.x));
  color = vec4(unpackHalf2x16(second.y), unpackHalf2x16(second.z).x, uintBitsToFloat(second.w));
  gl_Position = vec4(2, 2, 2, 1); // outside
  if (color.a < ALPHA_MIN) return;
  float reach = sqrt(max(log2(color.a / ALPHA_MIN), 1e-6));
  vec2 wider = reach + SNAP * vec2(root.x + abs(root.y), root.z); // a corner that is rounded cuts no pixel off
  vec2 corner = wider * (2.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) - 1.0);
  float dy = corner.y / root.z;
  float dx = (corner.x - root.y * dy) / root.x;
  gl_Position = vec4(2.0 * (mean + vec2(dx, dy)) / size - 1.0, 0, 1);
}
