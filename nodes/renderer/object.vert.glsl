#version 330

// Equations (1)-(6) of the paper per vertex, as in nodes/renderer/correction.py.

uniform vec3 eye;
uniform vec3 projector;
uniform bool corrected;
uniform vec3 sheet_point;
uniform vec3 sheet_normals[4];
uniform vec3 sector_normals[4];
uniform mat3 clip_from_screen;
uniform float grazing_sine;
uniform float near_m;
uniform float far_m;

#include "lens.glsl"

in vec3 rest_position;
in vec3 rest_normal;
in vec3 position;
in vec3 normal;

out vec3 rest_point;
out vec3 true_point;  // A
out vec3 surface_normal;
out float sunk_m;  // depth below the surface at rest
out float valid;
out vec4 shifted;  // A', and 1 where it is valid

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
    if (!corrected) return vec4(a, ok ? 1.0 : 0.0);

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
}

void main() {
    shifted = shift(position);
    valid = shifted.w;
    rest_point = rest_position;
    true_point = position;
    surface_normal = normal;
    sunk_m = dot(rest_position - position, rest_normal);

    // From A' through the eye's pinhole onto z = 0, homogeneous: w is the depth before the eye.
    float w = eye.z - shifted.z;
    vec2 on_screen = eye.xy * w + (shifted.xy - eye.xy) * eye.z;
    vec3 clip = through_lens(clip_from_screen * vec3(on_screen, w));
    // At one pixel clip.z grows with the depth before the eye, so the depth test orders by it.
    float z = ((far_m + near_m) * clip.z - 2.0 * far_m * near_m) / (far_m - near_m);
    gl_Position = vec4(clip.xy, z, clip.z);
}
