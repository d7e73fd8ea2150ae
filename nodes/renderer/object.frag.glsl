#version 330

uniform bool flat_shading;
uniform bool grid;
uniform float grid_pitch_m;
uniform int places_axis;  // 1 or 2: paint each point with the x or y at which the eye should see it
uniform vec3 eye;
uniform vec3 light_direction;
uniform vec3 object_colour;
uniform vec4 fingertip_mark;  // point of the object at rest, radius; radius 0: none
uniform vec4 target_mark;

in vec3 rest_point;
in vec3 true_point;
in vec3 surface_normal;
in float valid;

out vec4 colour;

const float PLACES_PERIOD_M = 0.02;
const float PLACES_RANGE_M = 0.24;

void main() {
    if (valid < 0.9999) discard;  // a triangle with a vertex that could not be corrected
    if (grid) {
        vec2 from_line = abs(fract(rest_point.xy / grid_pitch_m + 0.5) - 0.5) * grid_pitch_m;
        vec2 softness = fwidth(rest_point.xy);
        vec2 line = 1.0 - smoothstep(vec2(0.0005), vec2(0.0005) + softness, from_line);
        colour = vec4(vec3(max(line.x, line.y)), 1.0);
        return;
    }
    if (places_axis > 0) {
        // On the imaginary screen, coded: fine by a phase in red and green, coarse in blue.
        vec2 seen = eye.xy + (true_point.xy - eye.xy) * (eye.z / (eye.z - true_point.z));
        float place = places_axis == 1 ? seen.x : seen.y;
        float phase = 6.283185307 * place / PLACES_PERIOD_M;
        float coarse = clamp(place / PLACES_RANGE_M + 0.5, 0.0, 1.0);
        colour = vec4(0.5 + 0.5 * cos(phase), 0.5 + 0.5 * sin(phase), 0.2 + 0.8 * coarse, 1.0);
        return;
    }
    if (flat_shading) {
        colour = vec4(1.0);
    } else {
        float facing = dot(normalize(surface_normal), light_direction);
        colour = vec4(object_colour * (0.25 + 0.75 * max(facing, 0.0)), 1.0);
    }
    float from_target = distance(rest_point, target_mark.xyz) / max(target_mark.w, 1e-6);
    float from_finger = distance(rest_point, fingertip_mark.xyz) / max(fingertip_mark.w, 1e-6);
    if (target_mark.w > 0.0 && from_target < 1.0 && from_target > 0.6)
        colour = vec4(0.1, 0.35, 0.9, 1.0);
    if (fingertip_mark.w > 0.0 && from_finger < 1.0) colour = vec4(0.85, 0.1, 0.1, 1.0);
}
