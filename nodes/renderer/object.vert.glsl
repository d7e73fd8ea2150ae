#version 330

// Correct a vertex by equations (1)-(6) of Furukawa et al. 2007, as nodes/renderer/correction.py
// does, and compute soft shading; docs/renderer.md has the formulas.  CORRECTED: 1: correct.

uniform vec3 eye;
uniform vec3 projector;
uniform vec3 sheet_point;
uniform vec3 sheet_normals[4];
uniform vec3 sector_normals[4];
uniform mat3 clip_from_screen;
uniform float grazing_sine;
uniform float near_m;
uniform float far_m;
uniform vec3 light_direction;

#include "lens.glsl"

in vec3 rest_position;
in vec3 rest_normal;
in vec3 position;
in vec3 normal;

out vec3 rest_point;
out vec3 true_point;  // point A of the object, without correction
out vec3 light;  // factor on the surface's own colour
out vec3 sheen;
out float valid;
out vec4 shifted;  // corrected point A', and validity: 0 or 1

const float WRAP = 0.35;  // light extends beyond the lit side, to an incidence cosine of -0.35
const float AMBIENT = 0.25;
const vec3 GLOW = vec3(0.16, 0.03, 0.02);  // subsurface red light near the terminator
const float HALF_DARK_M = 0.025;  // depth at which half of the light is lost
const vec3 DARKENING = vec3(0.8, 1.0, 1.05);  // red is darkened less with depth than blue
const float SHEEN = 0.10;
const float SHEEN_EXPONENT = 20.0;

const vec3 n_o = vec3(0.0, 0.0, 1.0);  // the imaginary screen is z = 0: r_o is the origin

int triangle_of(vec3 line) {
    int best = 0;
    float deepest = -1e30;
    for (int i = 0; i < 4; i++) {
        float depth = min(dot(line, sector_normals[i]), -dot(line, sector_normals[(i + 1) % 4]));
        if (depth > deepest) {
            deepest = depth;
            best = i;
        }
    }
    return best;
}

vec4 shift(vec3 a) {
    bool ok = dot(eye - a, n_o) > near_m;
#if !CORRECTED
    return vec4(a, ok ? 1.0 : 0.0);
#else
    vec3 n_s = sheet_normals[triangle_of(a - eye)];
    float toward_eye = dot(eye - a, n_s);
    ok = ok && toward_eye > grazing_sine * length(eye - a);
    float s1 = dot(sheet_point - a, n_s) / toward_eye;
    ok = ok && s1 < 1.0;
    vec3 c = s1 * eye + (1.0 - s1) * a;

    vec3 light = c - projector;
    float grazing = grazing_sine * length(light);
    ok = ok && dot(light, n_o) > grazing && dot(light, n_s) > grazing;
    float s2 = -dot(projector, n_o) / dot(light, n_o);
    vec3 c_shifted = s2 * c + (1.0 - s2) * projector;

    float s3 = dot(a - c_shifted, n_o) / dot(eye - c_shifted, n_o);
    return ok ? vec4(s3 * eye + (1.0 - s3) * c_shifted, 1.0) : vec4(a, 0.0);
#endif
}

// Set `light` and `sheen`, which are smooth enough to be interpolated between vertices.
void shade() {
    vec3 outward = normal / max(length(normal), 1e-6);
    vec3 to_eye = normalize(eye - position);
    float sunk_m = dot(rest_position - position, rest_normal);  // depth below the surface at rest
    float wrapped = max((dot(outward, light_direction) + WRAP) / (1.0 + WRAP), 0.0);
    float turning = wrapped * max(1.0 - wrapped, 0.0) * 4.0;
    vec3 dark = pow(vec3(1.0 / (1.0 + max(sunk_m, 0.0) / HALF_DARK_M)), DARKENING);
    float aligned = max(dot(outward, normalize(light_direction + to_eye)), 0.0);
    light = (vec3(AMBIENT + (1.0 - AMBIENT) * wrapped) + GLOW * turning) * dark;
    sheen = SHEEN * pow(aligned, SHEEN_EXPONENT) * dark;
}

void main() {
    shifted = shift(position);
    valid = shifted.w;
    rest_point = rest_position;
    true_point = position;
    shade();

    // Project A' from the eye onto z = 0, homogeneous: w is the depth in front of the eye.
    float w = eye.z - shifted.z;
    vec2 on_screen = eye.xy * w + (shifted.xy - eye.xy) * eye.z;
    vec3 clip = through_lens(clip_from_screen * vec3(on_screen, w));
    // In a pixel, clip.z increases with the depth in front of the eye, as the depth test requires.
    float z = ((far_m + near_m) * clip.z - 2.0 * far_m * near_m) / (far_m - near_m);
    gl_Position = vec4(clip.xy, z, clip.z);
}
