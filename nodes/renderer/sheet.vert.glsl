#version 330

// A point of the sheet, as the projector sees it.

uniform vec3 projector;
uniform mat3 clip_from_screen;
uniform float near_m;
uniform float far_m;

in vec3 position;

out vec3 point;

void main() {
    point = position;
    // From the projector through the point onto the imaginary screen z = 0, homogeneous: w is the
    // distance from the projector's plane.
    float w = position.z - projector.z;
    vec2 on_screen = projector.xy * position.z - position.xy * projector.z;
    vec3 clip = clip_from_screen * vec3(on_screen, w);
    float z = ((far_m + near_m) * clip.z - 2.0 * far_m * near_m) / (far_m - near_m);
    gl_Position = vec4(clip.xy, z, clip.z);
}
