// One 2D Gaussian over one pixel; blending keeps (r, g, b) and the transmittance, front to back.
flat in vec2 mean;
flat in vec3 root;
flat in vec4 color;
out vec4 blended; // (alpha r, alpha g, alpha b, alpha)

void main() {
  vec2 d = gl_FragCoord.xy - mean;
  float u = d.x * root.x + d.y * root.y, v = d.y * root.z;
  float raw = color.a * exp2(-(u * u + v * v));
  if (raw < ALPHA_MIN) discard;
  float alpha = min(raw, ALPHA_MAX);
  blended = vec4(alpha * color.rgb, alpha);
}
