#version 300 es
// The shaded material on the surface, or what it is compared with left of the divider.
precision highp float;
uniform sampler2D material, compared;
uniform float divider;        // in pixels of the canvas; below 0: nothing is compared
in vec2 place;
out vec4 result;
void main() {
  vec3 here = texture(material, place).rgb, there = texture(compared, place).rgb;
  vec3 color = gl_FragCoord.x < divider ? there : here;
  vec3 encoded = mix(color * 12.92, 1.055 * pow(color, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, color));
  result = vec4(encoded, 1.0);
}
