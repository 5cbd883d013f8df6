// From 3D Gaussians to 2D ones, a pixel for each: the mathematics of warp_splat/kernels/project/.
uniform highp usampler2D gaussians, harmonics; // 2 and HARMONICS texels each, as warp_splat/export_html/pack.py has them
uniform int end; // of those to project
uniform mat3 rotation; // camera from world
uniform vec3 center; // of the camera, from the origin of the positions
uniform vec2 focal, principal, size; // px

layout(location = 0) out uvec4 meanAndRoot; // mean [px], root xx and xy [1/px], float bits
layout(location = 1) out uvec4 rootAndColor; // root yy, half floats (r, g) and (b, 0), opacity: 0 where nothing is seen

int low(uint word) {
  return int(word << 16) >> 16;
}

int high(uint word) {
  return int(word) >> 16;
}

// Of (x, y, z) / (1 + w)
mat3 rotationMatrix(vec3 p) {
  float n = dot(p, p);
  vec3 v = 2.0 * p / (1.0 + n);
  float w = (1.0 - n) / (1.0 + n);
  return mat3(
    1.0 - 2.0 * (v.y * v.y + v.z * v.z), 2.0 * (v.x * v.y + w * v.z), 2.0 * (v.x * v.z - w * v.y),
    2.0 * (v.x * v.y - w * v.z), 1.0 - 2.0 * (v.x * v.x + v.z * v.z), 2.0 * (v.y * v.z + w * v.x),
    2.0 * (v.x * v.z + w * v.y), 2.0 * (v.y * v.z - w * v.x), 1.0 - 2.0 * (v.x * v.x + v.y * v.y)
  );
}

vec4 signedBytes(uint word) {
  return vec4(ivec4(word << 24, word << 16, word << 8, word) >> 24);
}

// The five coefficients of a texel, times their weights
vec3 weighted(uvec4 t, float w0, float w1, float w2, float w3, float w4) {
  vec4 a = signedBytes(t.x), b = signedBytes(t.y), c = signedBytes(t.z), d = signedBytes(t.w);
  vec3 sum = w0 * a.xyz + w1 * vec3(a.w, b.xy) + w2 * vec3(b.zw, c.x) + w3 * c.yzw + w4 * d.xyz;
  return sum * (exp2(float(t.w >> 24)) / HARMONIC_STEPS);
}

vec3 colorAlong(vec3 d, int index, vec3 base) {
  vec3 color = C0 * base + 0.5;
  int first = index * HARMONICS;
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  if (HARMONICS > 0) {
    color += weighted(texel(harmonics, first), -C1 * y, C1 * z, -C1 * x, C2A * x * y, -C2A * y * z);
  }
  if (HARMONICS > 1) {
    color += weighted(
      texel(harmonics, first + 1), C2B * (2.0 * zz - xx - yy), -C2A * x * z, C2C * (xx - yy), -C3A * y * (3.0 * xx - yy),
      C3B * x * y * z
    );
  }
  if (HARMONICS > 2) {
    color += weighted(
      texel(harmonics, first + 2), -C3C * y * (4.0 * zz - xx - yy), C3D * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
      -C3C * x * (4.0 * zz - xx - yy), C3E * z * (xx - yy), -C3A * x * (xx - 3.0 * yy)
    );
  }
  return max(color, 0.0);
}

void main() {
  meanAndRoot = uvec4(0);
  rootAndColor = uvec4(0);
  int index = int(gl_FragCoord.y) * WIDTH + int(gl_FragCoord.x);
  if (index >= end) return;
  uvec4 t = texel(gaussians, 2 * index), u = texel(gaussians, 2 * index + 1);
  vec3 offset = uintBitsToFloat(t.xyz) - center;
  vec3 p = rotation * offset;
  if (!(p.z > NEAR)) return;

  vec2 slope = p.xy / p.z, bounded = slope;
  if (!ELLIPSOID) {
    vec2 margin = FRUSTUM_MARGIN * 0.5 * size / focal;
    bounded = clamp(slope, -principal / focal - margin, (size - principal) / focal + margin);
  }
  vec3 scale = exp(vec3(low(t.w), high(t.w), low(u.x)) / LOG_STEPS);
  mat3 axes = rotation * rotationMatrix(vec3(low(u.y), high(u.y), low(u.z)) / ROTATION_STEPS);
  mat3 rows = transpose(axes);
  vec3 a1 = focal.x / p.z * scale * (rows[0] - bounded.x * rows[2]);
  vec3 a2 = focal.y / p.z * scale * (rows[1] - bounded.y * rows[2]);
  vec2 mean = focal * slope + principal;
  if (ELLIPSOID) {
    vec3 a3 = OUTLINE / p.z * scale * rows[2];
    float rest = 1.0 - dot(a3, a3), reach = OUTLINE / OUTLINE_REACH;
    if (!(rest > 1.0 - reach * reach)) return;
    vec2 shift = vec2(dot(a1, a3), dot(a2, a3));
    mean -= OUTLINE / rest * shift;
    float stretch = 1.0 / (rest + sqrt(rest));
    a1 = (a1 + stretch * shift.x * a3) / sqrt(rest);
    a2 = (a2 + stretch * shift.y * a3) / sqrt(rest);
  }
  vec3 area = cross(a1, a2);
  float xx = dot(a1, a1), yy = dot(a2, a2), sharp = dot(area, area);
  float det = sharp + BLUR * (xx + yy) + BLUR * BLUR;
  float opacity = float(u.x >> 16) / 65535.0;
  if (ANTIALIASED) opacity *= sqrt(max(sharp / det, COMPENSATION_MIN));
  if (!(det < 1e38) || opacity < ALPHA_MIN) return;

  vec3 root; // upper triangular, root' root = conic log2(e) / 2
  root.x = sqrt(0.5 * LOG2_E * (yy + BLUR) / det);
  root.y = -0.5 * LOG2_E * dot(a1, a2) / det / root.x;
  root.z = sqrt(0.5 * LOG2_E / (yy + BLUR));
  vec3 color = colorAlong(normalize(offset), index, vec3(high(u.z), low(u.w), high(u.w)) / COLOR_STEPS);
  meanAndRoot = floatBitsToUint(vec4(mean, root.xy));
  rootAndColor = uvec4(
    floatBitsToUint(root.z), packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0)), floatBitsToUint(opacity)
  );
}
