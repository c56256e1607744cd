// State, input, and the loop that draws when something has changed. Text from outside is only ever textContent.

const $$ = (id) => document.getElementById(id);
const {shaders, materials} = JSON.parse($$("data").textContent);
const canvas = $$("canvas"), stage = $$("stage");
const given = new URLSearchParams(location.hash.slice(1));
const bare = given.has("bare"); // a pixel of the maps for a pixel of the screen, and nothing else
const title = (text) => text[0].toUpperCase() + text.slice(1);
const signed = (value) => {
  const size = Math.abs(value).toFixed(1);
  return Number(size) ? `${value < 0 ? "−" : "+"}${size}` : size;
};
const numbers = (text, count) => {
  const values = (text ?? "").split(",").map((part) => (part.trim() ? Number(part) : NaN)); // Number("") is 0
  return values.length === count && values.every(Number.isFinite) ? values : null;
};

const state = {
  index: 0, map: "rendering", mode: "light", compare: "none", split: 0.5,
  zoom: 1, center: [0, 0], azimuth: 0, tilt: 0, exposure: 0, light: null, circling: false,
};
let renderer, current, other, view, loading = 0, scheduled = false, written = 0;

const photoLight = (index) => structuredClone(materials[index].light);
const everyday = (index) => {
  const {position: [x, y, z], falloff} = materials[index].light;
  return {position: [x, y, z], intensity: [...materials[index].light.intensity], falloff};
};

function reset() {
  Object.assign(state, {zoom: 1, center: [0, 0], azimuth: 0, tilt: state.mode === "orbit" ? 0.9 : 0, exposure: 0});
  state.light = everyday(state.index);
  circle(false);
  refresh();
}

// ---- drawing

function eyeOf(material) {
  if (view.eye) return [...view.eye, 1];
  const {kind, position} = material.described.camera;
  if (kind === "orthographic") return [0, 0, 1, 0];
  return [...(kind === "collocated" ? state.light.position : position), 1];
}

function draw() {
  scheduled = false;
  if (!current) return;
  const ratio = bare ? 1 : Math.min(devicePixelRatio || 1, 2);
  const [width, height] = bare
    ? [current.described.width, current.described.height]
    : [Math.max(1, Math.round(stage.clientWidth * ratio)), Math.max(1, Math.round(stage.clientHeight * ratio))];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
  const scale = bare ? Math.max(width, height) / 2 : null;
  view = state.mode === "orbit"
    ? orbitView(canvas, state.zoom, state.center, state.azimuth, state.tilt)
    : flatView(halfSize(current.described), canvas, state.zoom, state.center, scale);
  const compared = state.compare === "photo" ? current.photo : other?.shaded;
  const showing = {map: state.map, light: state.light, exposure: 2 ** state.exposure};
  if (other) renderer.shade(other, {...showing, eye: eyeOf(other)});
  renderer.shade(current, {...showing, eye: eyeOf(current)});
  renderer.draw(current, view.matrix, compared, state.split * width);
  if (!bare) overlay(compared);
}

function overlay(compared) {
  const [w, h] = [stage.clientWidth, stage.clientHeight];
  const [u, v, depth] = project(view, state.light.position[0], state.light.position[1]);
  const marker = $$("light");
  marker.hidden = state.map !== "rendering" || depth <= 0;
  const [x, y] = [clamp(((u + 1) / 2) * w, 14, w - 14), clamp(((1 - v) / 2) * h, 14, h - 14)];
  marker.style.transform = `translate(${x}px, ${y}px)`;
  marker.classList.toggle("beyond", Math.abs(u) > 1 || Math.abs(v) > 1);
  const divider = $$("divider");
  divider.hidden = $$("left-label").hidden = $$("right-label").hidden = !compared;
  divider.style.left = `${state.split * 100}%`;
  divider.setAttribute("aria-valuenow", Math.round(state.split * 100));
  $$("left-label").textContent = state.compare === "photo" ? "Photo" : other?.described.label ?? "";
  $$("right-label").textContent = state.compare === "photo" ? title(state.map) : current.described.label;
}

function schedule() {
  if (!scheduled) requestAnimationFrame(draw);
  scheduled = true;
}

// Controls say what the state is; then everything is drawn.
function refresh() {
  for (const button of $$("maps").children) button.setAttribute("aria-pressed", button.value === state.map);
  for (const button of $$("modes").children) button.setAttribute("aria-pressed", button.value === state.mode);
  for (const button of $$("gallery").children) button.setAttribute("aria-pressed", Number(button.value) === state.index);
  $$("falloff").setAttribute("aria-pressed", state.light.falloff === "inverse_square");
  $$("circle").setAttribute("aria-pressed", state.circling);
  $$("compare").value = state.compare;
  $$("height").value = Math.log(state.light.position[2]);
  $$("height-value").value = state.light.position[2].toFixed(2);
  $$("exposure").value = state.exposure;
  $$("exposure-value").value = signed(state.exposure);
  canvas.dataset.mode = state.mode;
  schedule();
  clearTimeout(written);
  if (!bare) written = setTimeout(remember, 400);
}

function remember() {
  const round = (values) => values.map((value) => Number(value.toFixed(4))).join(",");
  const told = new URLSearchParams({
    material: state.index, map: state.map, mode: state.mode, compare: state.compare, falloff: state.light.falloff,
    light: round(state.light.position), exposure: state.exposure, split: state.split.toFixed(3),
    view: round([state.zoom, ...state.center, state.azimuth, state.tilt]),
  });
  try { history.replaceState(null, "", `#${told}`); } catch { /* some browsers refuse it for files */ }
}

function recall() {
  if (MAPS.includes(given.get("map"))) state.map = given.get("map");
  if (["light", "orbit"].includes(given.get("mode"))) state.mode = given.get("mode");
  const index = Number(given.get("material"));
  if (Number.isInteger(index) && materials[index]) state.index = index;
  state.light = everyday(state.index);
  const light = numbers(given.get("light"), 3), split = numbers(given.get("split"), 1), exposure = numbers(given.get("exposure"), 1);
  const seen = numbers(given.get("view"), 5);
  if (light && light[2] > 0) state.light.position = light;
  if (["none", "inverse_square"].includes(given.get("falloff"))) state.light.falloff = given.get("falloff");
  if (split) state.split = clamp(split[0], 0, 1);
  if (exposure) state.exposure = clamp(exposure[0], -3, 3);
  state.tilt = state.mode === "orbit" ? 0.9 : 0;
  if (seen) {
    [state.zoom, state.azimuth, state.tilt] = [clamp(seen[0], 0.2, 40), seen[3], clamp(seen[4], 0, 1.5)];
    state.center = seen.slice(1, 3);
  }
}

// ---- what is shown

async function choose(index, keep) {
  const ticket = ++loading;
  const loaded = await renderer.load(materials[index]);
  if (ticket !== loading) return renderer.release(loaded);
  if (current) renderer.release(current);
  current = loaded;
  const comparison = state.compare;
  state.index = index;
  if (!keep) state.light = everyday(index);
  const {described} = current, {light} = described;
  $$("name").textContent = described.label;
  const fitted = `light at (${light.position.map((value) => value.toFixed(2)).join(", ")})`;
  const [before, after] = described.rmse.map((value) => value.toFixed(4));
  $$("facts").textContent = `${described.size.join(" × ")} px · ${fitted} · re-rendering RMSE ${before === after ? after : `${before} → ${after}`}`;
  $$("facts").title = `${described.source}, recipe ${described.recipe}`;
  const options = [["none", "Nothing"], ...(described.photo ? [["photo", "Photo"]] : [])];
  materials.forEach((each, i) => i !== index && options.push([String(i), each.label]));
  $$("compare").replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  $$("compare").disabled = options.length < 2;
  await compare(options.some(([value]) => value === comparison) ? comparison : "none");
}

async function compare(value) {
  const ticket = ++loading;
  const loaded = ["none", "photo"].includes(value) ? null : await renderer.load(materials[Number(value)]);
  if (ticket !== loading) return loaded && renderer.release(loaded);
  if (other) renderer.release(other);
  other = loaded;
  if (value === "photo" && state.compare !== "photo" && !given.has("light")) {
    Object.assign(state, {light: photoLight(state.index), exposure: 0, map: "rendering"});
  }
  state.compare = value;
  refresh();
}

async function thumbnails() {
  const side = 96;
  for (const button of $$("gallery").children) {
    const material = await renderer.load(materials[Number(button.value)]);
    const {described} = material;
    const picture = Object.assign(document.createElement("canvas"), {width: side, height: side});
    const size = halfSize(described), square = {width: side, height: side};
    const {matrix} = flatView([Math.min(...size), Math.min(...size)], square, 1 / MARGIN, [0, 0]);
    const from = Math.max(canvas.width, side), to = Math.max(canvas.height, side);
    if (canvas.width !== from || canvas.height !== to) Object.assign(canvas, {width: from, height: to});
    renderer.shade(material, {map: "rendering", light: described.light, eye: [0, 0, 2.14, 1], exposure: 1});
    renderer.draw(material, matrix, null, 0, [side, side]);
    picture.getContext("2d").drawImage(canvas, 0, canvas.height - side, side, side, 0, 0, side, side);
    renderer.release(material);
    button.prepend(picture);
    draw();
  }
}

// ---- moving things

function setMode(mode) {
  if (mode !== state.mode) Object.assign(state, {mode, tilt: mode === "orbit" ? 0.9 : 0, azimuth: 0, center: [0, 0]});
  refresh();
}

function moveLight(x, y) {
  circle(false);
  state.light.position = [clamp(x, -6, 6), clamp(y, -6, 6), state.light.position[2]];
  refresh();
}

function turn(dx, dy) {
  state.azimuth += dx;
  state.tilt = clamp(state.tilt + dy, 0, 1.45);
  refresh();
}

function zoomBy(factor, u = 0, v = 0) {
  const before = unproject(view, u, v);
  state.zoom = clamp(state.zoom * factor, 0.3, 40);
  if (state.mode === "light" && before) {
    const kept = 1 / factor;
    if (state.zoom > 0.3 && state.zoom < 40) state.center = state.center.map((value, i) => before[i] + (value - before[i]) * kept);
  }
  refresh();
}

function pan(from, to) {
  const [a, b] = [unproject(view, ...from), unproject(view, ...to)];
  if (a && b) state.center = state.center.map((value, i) => clamp(value + a[i] - b[i], -1.5, 1.5));
  refresh();
}

function circle(on) {
  if (on && !state.circling) {
    const [x, y] = state.light.position;
    let [radius, angle, last] = [Math.max(Math.hypot(x, y), 0.6), Math.atan2(y, x), performance.now()];
    const step = (now) => {
      if (!state.circling) return;
      angle += ((now - last) / 1000) * 0.9;
      last = now;
      state.light.position = [radius * Math.cos(angle), radius * Math.sin(angle), state.light.position[2]];
      schedule();
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }
  state.circling = on;
}

const raise = (factor) => {
  state.light.position[2] = clamp(state.light.position[2] * factor, 0.1, 8);
  refresh();
};
const expose = (stops) => { state.exposure = clamp(state.exposure + stops, -3, 3); refresh(); };
const slide = (amount) => { state.split = clamp(state.split + amount, 0, 1); refresh(); };
const show = (map) => { state.map = map; refresh(); };
const flash = () => { circle(false); state.light = photoLight(state.index); refresh(); };
const fall = () => { state.light.falloff = state.light.falloff === "none" ? "inverse_square" : "none"; refresh(); };
const step = (by) => materials.length > 1 && choose((state.index + by + materials.length) % materials.length);
const spin = () => { circle(!state.circling); refresh(); };
const comparison = () => {
  const values = [...$$("compare").options].map((option) => option.value);
  compare(values[(values.indexOf(state.compare) + 1) % values.length]);
};
const help = () => ($$("help").open ? $$("help").close() : $$("help").showModal());
const arrow = (dx, dy) => {
  if (state.mode === "orbit") return turn(dx * 0.08, -dy * 0.08);
  const [x, y] = state.light.position;
  moveLight(x + dx * 0.06, y + dy * 0.06);
};

// ---- keys

const KEYS = [
  ["1 – 5", "rendering, normal, diffuse, roughness, specular"],
  ["L  O", "dragging moves the light, or walks around the surface"],
  ["← → ↑ ↓", "the same, by keys"],
  ["Page ↑ ↓", "raise or lower the light"],
  [",  .", "darker, brighter"],
  ["+  −", "zoom; wheel and pinch, too"],
  ["Shift + drag", "move the view; in orbit, Alt + drag moves the light"],
  ["C", "compare with the photo or another material"],
  ["Shift + ← →", "move the divider"],
  ["N  P", "next or previous material"],
  ["F", "the light of the photo"],
  ["I", "falloff with the squared distance, or none"],
  ["Space", "let the light circle"],
  ["0", "everything as it was"],
  ["?", "this help"],
];
const ACTIONS = {
  1: () => show(MAPS[0]), 2: () => show(MAPS[1]), 3: () => show(MAPS[2]), 4: () => show(MAPS[3]), 5: () => show(MAPS[4]),
  l: () => setMode("light"), o: () => setMode("orbit"), c: comparison, n: () => step(1), p: () => step(-1),
  f: flash, i: fall, " ": spin, 0: reset, "?": help, h: help,
  "+": () => zoomBy(1.2), "=": () => zoomBy(1.2), "-": () => zoomBy(1 / 1.2), "−": () => zoomBy(1 / 1.2),
  ",": () => expose(-0.25), ".": () => expose(0.25), PageUp: () => raise(1.1), PageDown: () => raise(1 / 1.1),
  ArrowLeft: () => arrow(-1, 0), ArrowRight: () => arrow(1, 0), ArrowUp: () => arrow(0, 1), ArrowDown: () => arrow(0, -1),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || !view || ($$("help").open && !"?h".includes(event.key))) return;
  const target = event.target.tagName;
  if (target === "SELECT" || (target === "INPUT" && /^(Arrow|Page)/.test(event.key))) return;
  if (target === "BUTTON" && event.key === " ") return;
  const sideways = {ArrowLeft: -0.02, ArrowRight: 0.02}[event.key];
  if (sideways && (event.shiftKey || event.target === $$("divider"))) slide(sideways);
  else {
    const action = ACTIONS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    action();
  }
  event.preventDefault();
}

// ---- pointers

const pointers = new Map();
const place = (event) => {
  const box = stage.getBoundingClientRect();
  return [((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2];
};

function onMove(event) {
  const from = pointers.get(event.pointerId);
  if (!from || !view) return;
  const to = place(event);
  if (pointers.size > 1) {
    const [, {at: fixed}] = [...pointers].find(([id]) => id !== event.pointerId);
    const width = stage.clientWidth, height = stage.clientHeight;
    const apart = (a) => Math.hypot((a[0] - fixed[0]) * width, (a[1] - fixed[1]) * height) || 1;
    const middle = (a) => [(a[0] + fixed[0]) / 2, (a[1] + fixed[1]) / 2];
    pan(middle(from.at), middle(to));
    draw();
    zoomBy(apart(to) / apart(from.at), ...middle(to));
  } else if (from.pans) pan(from.at, to);
  else if (state.mode === "orbit" && !event.altKey) turn((from.at[0] - to[0]) * 2, (to[1] - from.at[1]) * 1.6);
  else {
    const point = unproject(view, ...to);
    if (point) moveLight(...point);
  }
  pointers.set(event.pointerId, {...from, at: to});
}

function listen() {
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, {at: place(event), pans: event.shiftKey || event.button > 0});
    onMove(event);
  });
  canvas.addEventListener("pointermove", onMove);
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", () => { Object.assign(state, {zoom: 1, center: [0, 0]}); refresh(); });
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (view) zoomBy(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event));
  }, {passive: false});
  const divider = $$("divider");
  divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener("pointermove", (event) => {
    if (divider.hasPointerCapture(event.pointerId)) slide((place(event)[0] + 1) / 2 - state.split);
  });
  document.addEventListener("keydown", onKey);
  $$("height").addEventListener("input", (event) => raise(Math.exp(event.target.value) / state.light.position[2]));
  $$("exposure").addEventListener("input", (event) => expose(event.target.value - state.exposure));
  $$("compare").addEventListener("change", (event) => compare(event.target.value));
  for (const [id, action] of Object.entries({flash, falloff: fall, circle: spin, reset, "help-button": help})) {
    $$(id).addEventListener("click", action);
  }
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => location.reload());
  new ResizeObserver(draw).observe(stage);
}

function build() {
  const names = materials.map(({name}) => name);
  materials.forEach((material, i) => {
    const same = names.slice(0, i).filter((name) => name === material.name).length;
    material.label = same ? `${material.name} (${same + 1})` : material.name;
  });
  const button = (value, text, action, hint) => {
    const made = Object.assign(document.createElement("button"), {value, textContent: text, title: hint});
    made.addEventListener("click", action);
    return made;
  };
  $$("maps").append(...MAPS.map((map, i) => button(map, title(map), () => show(map), `${title(map)} (${i + 1})`)));
  $$("modes").append(
    button("light", "Light", () => setMode("light"), "Dragging moves the light (L)"),
    button("orbit", "Orbit", () => setMode("orbit"), "Dragging walks around the surface (O)"),
  );
  $$("gallery").hidden = materials.length < 2;
  if (materials.length > 1) {
    $$("gallery").append(...materials.map(({label}, i) => {
      const made = button(i, "", () => choose(i), label);
      made.append(Object.assign(document.createElement("span"), {textContent: label}));
      return made;
    }));
  }
  $$("keys").append(...KEYS.flatMap(([keys, meaning]) => [
    Object.assign(document.createElement("dt"), {textContent: keys}),
    Object.assign(document.createElement("dd"), {textContent: meaning}),
  ]));
}

async function main() {
  document.body.classList.toggle("bare", bare);
  build();
  recall();
  renderer = new Renderer(canvas, shaders);
  state.compare = given.get("compare") ?? "none";
  listen();
  await choose(state.index, true);
  given.delete("light");
  if (!bare && materials.length > 1) await thumbnails();
  document.body.dataset.ready = "";
}

main().catch((error) => {
  $$("message").textContent = error.message;
  $$("message").hidden = false;
});
