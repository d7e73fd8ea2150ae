#version 330

// Colour a pixel of the object or of a pattern on the imaginary screen; docs/renderer.md has the
// formulas.  LOOK and TEXTURE are macros, because a software driver computes all branches of a
// shader for each pixel.

// LOOK: 0: object with soft shading, 1: object without shading, 2 or 3: object coloured by the x or
// y of the point on the imaginary screen at which the eye should see it, 4: grid, 5: checker,
// 6: white.  TEXTURE of the object: 0: none, 1: speckle, 2: grid, 3: image.
// MARKS: 1: draw the marks of fingertip and target.  GREY: 1: draw without colour.
uniform float grid_pitch_m;
uniform vec3 eye;
uniform vec3 object_colour;
uniform float texture_pitch_m;
uniform mat4 object_from_world;
uniform mat4 image_from_world;
uniform sampler2D image;
uniform vec4 fingertip_mark;  // centre on the object at rest, and radius; radius 0: no mark
uniform vec4 target_mark;

in vec3 rest_point;
in vec3 true_point;
in vec3 light;
in vec3 sheen;
in float valid;

out vec4 colour;

const float RAMP_PERIOD_M = 0.02;
const float RAMP_RANGE_M = 0.24;

const mat3 ASLANT = mat3(0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6);  // oblique rotation

// Return which fraction of a pixel is covered by lines at all multiples of the pitch.
vec2 lines(vec2 place, float pitch, float half_width) {
    vec2 from_line = abs(fract(place / pitch + 0.5) - 0.5) * pitch;
    vec2 half_px = max(0.5 * fwidth(place), 1e-9);
    vec2 covered = min(from_line + half_px, half_width) - max(from_line - half_px, -half_width);
    return clamp(0.5 * covered / half_px, 0.0, 1.0);
}

vec3 on_screen(vec2 place) {
#if LOOK == 4
    vec2 line = lines(place, grid_pitch_m, 0.0005);
    return vec3(max(line.x, line.y));
#elif LOOK == 5
    // Use a steep triangle wave: +1 on even squares, -1 on odd ones, antialiased over a pixel.
    vec2 wave = 1.0 - 2.0 * abs(2.0 * fract(place / (2.0 * grid_pitch_m) + 0.25) - 1.0);
    vec2 steep = 0.5 * grid_pitch_m / max(fwidth(place), vec2(1e-9));
    vec2 side = clamp(wave * steep, -1.0, 1.0);
    return vec3(0.5 + 0.5 * side.x * side.y);
#else
    return vec3(1.0);
#endif
}

// Return a pseudo-random number from 0 to 1 for each cell of a lattice.
float scattered(ivec3 cell, uint which) {
    uint h = uint(cell.x) * 0x8da6b343u + uint(cell.y) * 0xd8163841u + uint(cell.z) * 0xcb1ab31fu;
    h = (h ^ (h >> 15) ^ (which * 0x9e3779b9u)) * 0x2c1b3c6du;
    h = (h ^ (h >> 12)) * 0x297a2d39u;
    return float((h ^ (h >> 15)) & 0xffffu) / 65535.0;
}

vec3 albedo() {
#if TEXTURE == 0
    return object_colour;
#elif TEXTURE == 3
    return texture(image, (image_from_world * vec4(rest_point, 1.0)).xy).rgb;
#else
    vec3 place = (object_from_world * vec4(rest_point, 1.0)).xyz;
#if TEXTURE == 2
    vec2 line = lines(place.xy, texture_pitch_m, 0.0004);
    return mix(object_colour, 0.45 * object_colour, max(line.x, line.y));
#else
    // Place a ball at a random position in each cell of half a pitch.  Where the surface cuts a
    // ball, there is a spot.
    vec3 in_cells = ASLANT * place / (0.5 * texture_pitch_m);
    ivec3 cell = ivec3(floor(in_cells));
    float radius = 0.25 + 0.2 * scattered(cell, 4u);
    vec3 middle = vec3(scattered(cell, 1u), scattered(cell, 2u), scattered(cell, 3u));
    middle = radius + middle * (1.0 - 2.0 * radius);
    float away = distance(in_cells - vec3(cell), middle);
    float softness = length(fwidth(place)) / (0.5 * texture_pitch_m);
    float spot = 1.0 - smoothstep(radius - softness, radius + softness, away);
    return mix(object_colour, 0.5 * object_colour, spot * clamp(0.3 / softness, 0.0, 1.0));
#endif
#endif
}

// Return how much a ring-shaped mark covers this point, antialiased over a pixel.  inner: ratio of
// the inner radius to the outer one.
float ring(vec4 mark, float inner) {
    float away = distance(rest_point, mark.xyz) / max(mark.w, 1e-6);
    float softness = max(0.5 * fwidth(away), 1e-6);
    float covered = smoothstep(inner - softness, inner + softness, away)
        * (1.0 - smoothstep(1.0 - softness, 1.0 + softness, away));
    return mark.w > 0.0 ? covered : 0.0;
}

void main() {
    if (valid < 0.9999) discard;  // A vertex of the triangle could not be corrected.
#if LOOK >= 4
    colour = vec4(on_screen(rest_point.xy), 1.0);
#elif LOOK >= 2
    // Code the position on the imaginary screen: red and green show the phase of a short period,
    // blue the coarse position.
    vec2 seen = eye.xy + (true_point.xy - eye.xy) * (eye.z / (eye.z - true_point.z));
    float place = LOOK == 2 ? seen.x : seen.y;
    float phase = 6.283185307 * place / RAMP_PERIOD_M;
    float coarse = clamp(place / RAMP_RANGE_M + 0.5, 0.0, 1.0);
    colour = vec4(0.5 + 0.5 * cos(phase), 0.5 + 0.5 * sin(phase), 0.2 + 0.8 * coarse, 1.0);
#else
    vec3 painted = LOOK == 1 ? vec3(1.0) : albedo() * light + sheen;
#if MARKS
    painted = mix(painted, vec3(0.1, 0.35, 0.9), ring(target_mark, 0.6));
    painted = mix(painted, vec3(0.85, 0.1, 0.1), ring(fingertip_mark, -1.0));
#endif
    colour = vec4(painted, 1.0);
#endif
#if GREY
    colour.rgb = vec3(dot(colour.rgb, vec3(0.299, 0.587, 0.114)));
#endif
}
