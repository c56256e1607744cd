// Where the surface is on the screen: x right, y up, z to the viewer, its longer side from -1 to 1.
"use strict";

const FIELD_OF_VIEW = (50 * Math.PI) / 180;
const MARGIN = 0.94; // share of the stage that the surface fills
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

const halfSize = ({width, height}) => [width / Math.max(width, height), height / Math.max(width, height)];

// Looked at straight on, without perspective: what a photo shows once it is rectified.
function flatView(size, canvas, zoom, center, pixelsPerUnit) {
  const fit = Math.min(canvas.width / size[0], canvas.height / size[1]) * 0.5 * MARGIN;
  const scale = pixelsPerUnit ?? fit * zoom;
  const [sx, sy] = [(2 * scale) / canvas.width, (2 * scale) / canvas.height];
  return {
    matrix: new Float32Array([sx, 0, 0, 0, 0, sy, 0, 0, 0, 0, 0, 0, -center[0] * sx, -center[1] * sy, 0, 1]),
    eye: null,
  };
}

// From `tilt` off the normal, turned by `azimuth`: a table one walks around.
function orbitView(canvas, zoom, center, azimuth, tilt) {
  const [st, ct, sa, ca] = [Math.sin(tilt), Math.cos(tilt), Math.sin(azimuth), Math.cos(azimuth)];
  const distance = 2.9 / zoom;
  const back = [st * sa, -st * ca, ct];
  const axes = [[ca, sa, 0], [-sa * ct, ca * ct, st], back];
  const eye = back.map((value, i) => value * distance + (center[i] ?? 0));
  const focus = 1 / Math.tan(FIELD_OF_VIEW / 2);
  const aspect = canvas.width / canvas.height;
  const [fx, fy] = aspect > 1 ? [focus / aspect, focus] : [focus, focus * aspect];
  const [near, far] = [0.01, 100];
  const rows = axes.map((axis) => [...axis, -(axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2])]);
  const clip = [
    rows[0].map((value) => value * fx),
    rows[1].map((value) => value * fy),
    rows[2].map((value, i) => (value * (far + near)) / (near - far) + (i === 3 ? (2 * far * near) / (near - far) : 0)),
    rows[2].map((value) => -value),
  ];
  return {matrix: new Float32Array([0, 1, 2, 3].flatMap((column) => clip.map((row) => row[column]))), eye};
}

// A point of the surface to [-1, 1] of the canvas, y up.
function project({matrix: m}, x, y) {
  const w = m[3] * x + m[7] * y + m[15];
  return [(m[0] * x + m[4] * y + m[12]) / w, (m[1] * x + m[5] * y + m[13]) / w, w];
}

// And back; null where the line of sight misses the plane.
function unproject({matrix: m}, u, v) {
  const [a, b, c] = [m[0] - u * m[3], m[4] - u * m[7], u * m[15] - m[12]];
  const [d, e, f] = [m[1] - v * m[3], m[5] - v * m[7], v * m[15] - m[13]];
  const determinant = a * e - b * d;
  const point = [(c * e - b * f) / determinant, (a * f - c * d) / determinant];
  return Number.isFinite(point[0]) && project({matrix: m}, ...point)[2] > 0 ? point : null;
}
