// The blended image over the background as a screen shows it, from its first row at the bottom to ours at the top,
// enlarged if it is smaller.
uniform highp sampler2D image;
uniform vec2 size; // px of the target
uniform float detail; // pixels of the image for one of the target
out vec4 color;

vec3 to_srgb(vec3 linear) { // as color.py
  return mix(1.055 * pow(max(linear, TOE), vec3(1.0 / 2.4)) - 0.055, 12.92 * linear, lessThanEqual(linear, vec3(TOE)));
}

void main() {
  vec2 place = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) * detail;
  vec4 blended = texelFetch(image, ivec2(place), 0);
  vec3 shown = clamp(blended.rgb + blended.a * BACKGROUND, 0.0, 1.0);
  color = vec4(LINEAR ? to_srgb(shown) : shown, 1);
}
