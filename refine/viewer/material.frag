#version 300 es
// nets/render.py, pixel by pixel: Cook-Torrance under a point light. The target encodes with the sRGB curve.
precision highp float;
precision highp int;
precision highp sampler2D;

//CONVENTIONS
const float PI = 3.14159265358979;

uniform sampler2D normalMap, diffuseMap, specularMap, roughnessMap;
uniform int shown;            // 0 rendering, 1 normal, 2 diffuse, 3 roughness, 4 specular
uniform vec3 lightPosition, lightIntensity;
uniform bool inverseSquare;
uniform vec4 eye;             // w = 1: a position; w = 0: a direction
uniform float exposure;
out vec4 result;

// High bytes in the upper half of the picture, low bytes in the lower.
vec3 stored(sampler2D map) {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  int rows = textureSize(map, 0).y / 2;
  vec3 high = round(texelFetch(map, pixel, 0).rgb * 255.0);
  vec3 low = round(texelFetch(map, pixel + ivec2(0, rows), 0).rgb * 255.0);
  return (high * 256.0 + low) / 65535.0;
}

vec3 linear(vec3 encoded) {
  return mix(encoded / 12.92, pow((encoded + 0.055) / 1.055, vec3(2.4)), step(0.04045, encoded));
}

vec3 unit(vec3 vector) {
  return vector * inversesqrt(max(dot(vector, vector), LENGTH_FLOOR * LENGTH_FLOOR));
}

void main() {
  vec2 size = vec2(textureSize(normalMap, 0)) * vec2(1.0, 0.5);
  vec3 encodedNormal = stored(normalMap);
  vec3 diffuse = linear(stored(diffuseMap)), specular = linear(stored(specularMap));
  float roughness = stored(roughnessMap).r;

  vec3 normal = encodedNormal * 2.0 - 1.0;
  normal = normalize(vec3(normal.xy, max(normal.z, 0.0)));
  vec2 centred = gl_FragCoord.xy - size / 2.0;
  vec3 point = vec3(centred.x, -centred.y, 0.0) * 2.0 / max(size.x, size.y);

  vec3 toLight = lightPosition - point;
  vec3 lightDirection = unit(toLight);
  vec3 view = eye.w > 0.5 ? unit(eye.xyz - point) : eye.xyz;
  vec3 halfVector = unit(lightDirection + view);
  float nDotL = max(dot(normal, lightDirection), 0.0);
  float nDotV = max(dot(normal, view), 0.0);
  float vDotH = max(dot(view, halfVector), 0.0);

  vec3 irradiance = PI * lightIntensity;
  if (inverseSquare)
    irradiance *= dot(lightPosition, lightPosition) / max(dot(toLight, toLight), LENGTH_FLOOR * LENGTH_FLOOR);

  float alpha = max(roughness, ROUGHNESS_FLOOR);
  alpha *= alpha;
  float k = alpha / 2.0;
  vec3 chord = normal - halfVector;
  float chordSquared = min(dot(chord, chord), 2.0);
  float nDotH = 1.0 - chordSquared / 2.0;
  float denominator = chordSquared * (1.0 - chordSquared / 4.0) + nDotH * alpha * nDotH * alpha;
  float ratio = alpha / max(denominator, DISTRIBUTION_FLOOR);
  float distribution = ratio * ratio / PI;
  float smithL = max(nDotL * (1.0 - k) + k, VISIBILITY_FLOOR);
  float smithV = max(nDotV * (1.0 - k) + k, VISIBILITY_FLOOR);
  vec3 fresnel = specular + (1.0 - specular) * exp2((-5.55473 * vDotH - 6.98316) * vDotH);
  vec3 brdf = diffuse * (1.0 - specular) / PI + distribution * fresnel / (4.0 * smithL * smithV);

  vec3 color = brdf * nDotL * irradiance * exposure;
  if (shown == 1) color = linear(encodedNormal);
  if (shown == 2) color = diffuse;
  if (shown == 3) color = linear(vec3(roughness));
  if (shown == 4) color = specular;
  result = vec4(clamp(color, 0.0, 1.0), 1.0);
}
