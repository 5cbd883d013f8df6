// The blended image over the background, from its first row at the bottom to ours at the top, enlarged if it is smaller.
uniform highp sampler2D image;
uniform vec2 size; // px of the target
uniform float detail; // pixels of the image for one of the target
out vec4 color;

void main() {
  vec2 place = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) * detail;
  vec4 blended = texelFetch(image, ivec2(place), 0);
  color = vec4(blended.rgb + blended.a * BACKGROUND, 1);
}
