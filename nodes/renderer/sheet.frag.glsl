#version 330

// What the eye should see where it sees this point of the sheet.

uniform vec3 eye;
uniform vec3 projector;
uniform sampler2D picture;
uniform vec4 window;  // of the picture on the imaginary screen: left, bottom, width, height
uniform float grazing_sine;
uniform float near_m;

in vec3 point;

out vec4 colour;

void main() {
    vec3 normal = normalize(cross(dFdx(point), dFdy(point)));
    vec3 to_eye = eye - point;
    vec3 light = point - projector;
    if (dot(normal, to_eye) < 0.0) normal = -normal;
    // Edge-on to the eye or the projector, or both on one side of it: no light there is of use.
    if (dot(normal, to_eye) < grazing_sine * length(to_eye)) discard;
    if (dot(normal, light) < grazing_sine * length(light)) discard;
    if (to_eye.z < near_m) discard;
    vec2 seen = eye.xy + (point.xy - eye.xy) * (eye.z / to_eye.z);
    vec2 place = (seen - window.xy) / window.zw;
    bool inside = all(greaterThanEqual(place, vec2(0.0))) && all(lessThanEqual(place, vec2(1.0)));
    colour = inside ? vec4(texture(picture, place).rgb, 1.0) : vec4(0.0, 0.0, 0.0, 1.0);
}
