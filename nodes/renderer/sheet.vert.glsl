#version 330

// Project a point of the sheet to the projector's image.

uniform vec3 projector;
uniform mat3 clip_from_screen;
uniform float near_m;
uniform float far_m;
uniform vec3 eye;
uniform vec4 window;  // rectangle of the eye's image on z = 0: left, bottom, width, height

#include "lens.glsl"

in vec3 position;

out vec3 point;

void main() {
    point = position;
    // Project the point from the projector onto the imaginary screen z = 0, homogeneous: w is the
    // distance from the projector, along z.
    float w = position.z - projector.z;
    vec2 on_screen = projector.xy * position.z - position.xy * projector.z;
    vec3 clip = through_lens(clip_from_screen * vec3(on_screen, w));
    float z = ((far_m + near_m) * clip.z - 2.0 * far_m * near_m) / (far_m - near_m);
    gl_Position = vec4(clip.xy, z, clip.z);

    // Draw only what the eye sees through the rectangle: clip by four planes through the eye, and
    // by depth.
    float before_eye = eye.z - position.z;
    vec2 seen = eye.xy * before_eye + (position.xy - eye.xy) * eye.z;
    vec2 low = seen - window.xy * before_eye;
    vec2 high = (window.xy + window.zw) * before_eye - seen;
    gl_ClipDistance[0] = low.x;
    gl_ClipDistance[1] = low.y;
    gl_ClipDistance[2] = high.x;
    gl_ClipDistance[3] = high.y;
    gl_ClipDistance[4] = before_eye - near_m;
}
