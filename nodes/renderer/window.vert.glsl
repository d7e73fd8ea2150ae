#version 330

// Draw one triangle that covers the whole window.

void main() {
    gl_Position = vec4(4.0 * vec2(gl_VertexID % 2, gl_VertexID / 2) - 1.0, 0.0, 1.0);
}
