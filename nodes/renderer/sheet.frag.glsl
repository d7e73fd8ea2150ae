#version 330

// Colour a point of the sheet with the image that the eye should see.  GREY: 1: without colour.

uniform vec3 eye;
uniform vec3 projector;
uniform sampler2D picture;
uniform vec4 window;  // rectangle of the eye's image on z = 0: left, bottom, width, height
uniform float grazing_sine;

in vec3 point;

out vec4 colour;

void main() {
    vec3 normal = normalize(cross(dFdx(point), dFdy(point)));
    vec3 to_eye = eye - point;
    vec3 light = point - projector;
    vec2 seen = eye.xy + (point.xy - eye.xy) * (eye.z / to_eye.z);
    vec2 place = (seen - window.xy) / window.zw;
    vec2 right = dFdx(place), up = dFdy(place);
    if (dot(normal, to_eye) < 0.0) normal = -normal;
    // Discard points that eye or projector see edge-on, or that have both on one side of the sheet.
    if (dot(normal, to_eye) < grazing_sine * length(to_eye)) discard;
    if (dot(normal, light) < grazing_sine * length(light)) discard;
    // Average four samples in the pixel, no two in one row or column, which makes edges smooth.
    vec3 light_of = texture(picture, place + 0.125 * right + 0.375 * up).rgb
        + texture(picture, place - 0.125 * right - 0.375 * up).rgb
        + texture(picture, place + 0.375 * right - 0.125 * up).rgb
        + texture(picture, place - 0.375 * right + 0.125 * up).rgb;
    colour = vec4(0.25 * light_of, 1.0);
#if GREY
    colour.rgb = vec3(dot(colour.rgb, vec3(0.299, 0.587, 0.114)));
#endif
}
