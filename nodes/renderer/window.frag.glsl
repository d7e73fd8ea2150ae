#version 330

// Show an image pixel for pixel.

uniform sampler2D image;
uniform ivec2 origin;  // position of the image's lower left pixel in the window

out vec4 colour;

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy) - origin;
    bool inside = all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, textureSize(image, 0)));
    colour = vec4(inside ? texelFetch(image, at, 0).rgb : vec3(0.0), 1.0);
}
