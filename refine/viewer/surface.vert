#version 300 es
// The surface as a rectangle in space.
uniform mat4 projection;
uniform vec2 halfSize;
out vec2 place;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  place = vec2(corner.x, -corner.y) * 0.5 + 0.5;
  gl_Position = projection * vec4(corner * halfSize, 0.0, 1.0);
}
