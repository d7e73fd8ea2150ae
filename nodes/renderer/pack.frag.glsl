#version 330

// Pack both eyes' images for the projector, pixel for pixel, as nodes/renderer/output.py.

uniform sampler2D left;
uniform sampler2D right;
uniform int mode;  // 0: left alone, 1: side by side, 2: top and bottom, 3: anaglyph
uniform ivec2 origin;  // of the image in the window

out vec4 colour;

vec3 halved(sampler2D eye, ivec2 first, ivec2 step) {
    return 0.5 * (texelFetch(eye, first, 0).rgb + texelFetch(eye, first + step, 0).rgb);
}

float grey(vec3 rgb) { return dot(rgb, vec3(0.299, 0.587, 0.114)); }

void main() {
    ivec2 size = textureSize(left, 0);
    ivec2 at = ivec2(gl_FragCoord.xy) - origin;
    colour = vec4(0.0, 0.0, 0.0, 1.0);
    if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) return;
    ivec2 middle = size / 2;
    if (mode == 0) {
        colour.rgb = texelFetch(left, at, 0).rgb;
    } else if (mode == 1) {
        if (at.x < middle.x) colour.rgb = halved(left, ivec2(2 * at.x, at.y), ivec2(1, 0));
        else colour.rgb = halved(right, ivec2(2 * (at.x - middle.x), at.y), ivec2(1, 0));
    } else if (mode == 2) {
        if (at.y < middle.y) colour.rgb = halved(right, ivec2(at.x, 2 * at.y), ivec2(0, 1));
        else colour.rgb = halved(left, ivec2(at.x, 2 * (at.y - middle.y)), ivec2(0, 1));
    } else {
        float other = grey(texelFetch(right, at, 0).rgb);
        colour.rgb = vec3(grey(texelFetch(left, at, 0).rgb), other, other);
    }
}
