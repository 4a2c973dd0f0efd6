"use strict";
const run = JSON.parse(document.getElementById("run").textContent);
const $ = id => document.getElementById(id);
const COLORS = ["#e02020", "#f08c00", "#2f9e44", "#9c36b5", "#1971c2", "#0c8599"];
const color = link => COLORS[link.link % COLORS.length];

// data ------------------------------------------------------------------------------------------------------------------------------------------------

function decodeArray(text, Kind) {
  return new Kind(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
}

// the number of sorted values that are at most x
function countUpTo(count, value, x) {
  let low = 0, high = count;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (value(middle) <= x) low = middle + 1; else high = middle;
  }
  return low;
}

const times = run.times, begin = times[0], end = times[times.length - 1];
const poses = decodeArray(run.poses, Float32Array), row = 7 * run.bodies.length;
const phaseAt = t => Math.max(0, countUpTo(run.phases.length, i => run.phases[i].start, t) - 1);
const formatQuantity = (x, unit, digits) => x === null ? "–" : (digits ? x.toPrecision(digits) : x === 0 ? "0" : x.toExponential(1)) + " " + unit;

// what the page shows at time t: poses interpolated between saved states a and b, numbers of one phase
function momentAt(t) {
  const a = Math.max(0, countUpTo(times.length, i => times[i], t) - 1), b = Math.min(a + 1, times.length - 1);
  const index = phaseAt(t), phase = run.phases[index];
  const inPhase = k => phaseAt(times[k]) === index;
  const [t0, e0] = inPhase(a) ? [times[a], run.energy[a]] : [phase.start, phase.energy[0]];
  const [t1, e1] = inPhase(b) ? [times[b], run.energy[b]] : [phase.stop, phase.energy[1]];
  const part = (from, to) => to > from ? (t - from) / (to - from) : 0;
  const energy = e0 === null || e1 === null ? null : e0 + (e1 - e0) * part(t0, t1);
  return { a, b, part: part(times[a], times[b]), phase, energy, gap: inPhase(a) ? run.gaps[a] : inPhase(b) ? run.gaps[b] : phase.gap };
}

// scene --------------------------------------------------------------------------------------------------------------------------------------------------

const scene = new THREE.Scene(), figure = new THREE.Group(), linkMarkers = new Map();
const bodies = run.bodies.map(name => Object.assign(new THREE.Group(), { name }));
figure.add(...bodies);
scene.add(figure);

const SHAPES = {
  plane: (x, y) => new THREE.PlaneGeometry(2 * x, 2 * y),
  sphere: r => new THREE.SphereGeometry(r, 32, 20),
  capsule: (r, half) => new THREE.CapsuleGeometry(r, 2 * half, 10, 24).rotateX(Math.PI / 2),
  ellipsoid: (x, y, z) => new THREE.SphereGeometry(1, 32, 20).scale(x, y, z),
  cylinder: (r, half) => new THREE.CylinderGeometry(r, r, 2 * half, 32).rotateX(Math.PI / 2),
  box: (x, y, z) => new THREE.BoxGeometry(2 * x, 2 * y, 2 * z),
};
const meshes = run.meshes.map(({ low, high, vertices, faces }) => {
  // coordinates are fractions of the bounding box, in 65535ths
  const fractions = decodeArray(vertices, Uint16Array), Index = fractions.length / 3 > 65536 ? Uint32Array : Uint16Array;
  const positions = Float32Array.from(fractions, (x, i) => low[i % 3] + x / 65535 * (high[i % 3] - low[i % 3]));
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(decodeArray(faces, Index), 1));
  // separate vertices for each face give sharp edges
  const flat = geometry.toNonIndexed();
  flat.computeVertexNormals();
  return flat;
});

function addGeom({ body, kind, size, pos, quat: [w, x, y, z], rgba: [r, g, b, alpha], mesh }) {
  if (mesh === undefined && !SHAPES[kind]) return;
  const material = new THREE.MeshStandardMaterial({
    color: new THREE.Color().setRGB(r, g, b, THREE.SRGBColorSpace), roughness: 0.7, opacity: alpha, transparent: alpha < 1,
  });
  // meshes may be open surfaces, planes are: draw both sides
  if (mesh !== undefined || kind === "plane") material.side = THREE.DoubleSide;
  const thing = new THREE.Mesh(mesh === undefined ? SHAPES[kind](...size) : meshes[mesh], material);
  thing.position.set(...pos);
  thing.quaternion.set(x, y, z, w);
  thing.castShadow = kind !== "plane";
  thing.receiveShadow = true;
  bodies[body].add(thing);
  return thing;
}

const from = new THREE.Quaternion(), to = new THREE.Quaternion();

function place({ a, b, part }) {
  bodies.forEach((body, i) => {
    const p = a * row + 7 * i, q = b * row + 7 * i;
    body.position.set(...[0, 1, 2].map(k => poses[p + k] + (poses[q + k] - poses[p + k]) * part));
    from.set(poses[p + 4], poses[p + 5], poses[p + 6], poses[p + 3]);
    to.set(poses[q + 4], poses[q + 5], poses[q + 6], poses[q + 3]);
    body.quaternion.copy(from).slerp(to, part);
  });
  figure.updateMatrixWorld(true);
}

// markers of a connected virtual link: a ball at the joint's point on the real link, and a rod from it to the joint's point on the parent
function linkMarker(link) {
  if (!linkMarkers.has(link.link)) {
    const material = new THREE.MeshBasicMaterial({ color: color(link), transparent: true, opacity: 0.85, depthTest: false });
    const ball = new THREE.Mesh(new THREE.SphereGeometry(0.13 * run.size, 24, 16), material);
    const rod = new THREE.Mesh(new THREE.CylinderGeometry(0.04 * run.size, 0.04 * run.size, 1, 12).rotateX(Math.PI / 2), material);
    ball.renderOrder = rod.renderOrder = 1;
    ball.name = link.name;
    scene.add(ball, rod);
    linkMarkers.set(link.link, [ball, rod]);
  }
  return linkMarkers.get(link.link);
}

function placeLinkMarkers({ phase }) {
  linkMarkers.forEach(parts => parts.forEach(part => { part.visible = false; }));
  phase.links.filter(link => link.ends).forEach(link => {
    const [ball, rod] = linkMarker(link), [parent, real] = link.ends.map(([body, pos]) => bodies[body].localToWorld(new THREE.Vector3(...pos)));
    const length = parent.distanceTo(real);
    ball.visible = true;
    ball.position.copy(real);
    rod.visible = length > 1e-3 * run.size;
    rod.scale.z = length || 1;
    rod.position.copy(real).add(parent).multiplyScalar(0.5);
    rod.lookAt(parent);
  });
}

// the bounding box of all geoms but planes, over the whole run
function extent() {
  const box = new THREE.Box3(), frames = Math.min(times.length, 40);
  for (let i = 0; i < frames; i++) {
    const a = Math.round(i * (times.length - 1) / Math.max(1, frames - 1));
    place({ a, b: a, part: 0 });
    bodies.forEach((body, k) => {
      if (k) box.expandByPoint(body.position);
      box.expandByObject(body);
    });
  }
  return box.isEmpty() || box.min.equals(box.max) ? box.expandByScalar(1) : box;
}

const [planes, solids] = [true, false].map(flat => run.geoms.filter(({ kind }) => (kind === "plane") === flat));
solids.forEach(addGeom);
const box = extent(), center = box.getCenter(new THREE.Vector3()), radius = box.getSize(new THREE.Vector3()).length() / 2;
const gridSpacing = 10 ** Math.floor(Math.log10(radius)), gridWidth = 2 * gridSpacing * Math.ceil(3 * radius / gridSpacing);

// a grid, on the infinite plane of the scene or, in a scene without planes, on a ground that shows shadows only
function addGround() {
  const grid = new THREE.GridHelper(gridWidth, gridWidth / gridSpacing, "#9aa5b4", "#9aa5b4").rotateX(Math.PI / 2);
  Object.assign(grid.material, { transparent: true, opacity: 0.5 });
  const drawn = planes.map(flat => addGeom({ ...flat, size: flat.size.map(x => x || gridWidth / 2) }));
  drawn.forEach(({ material }) => Object.assign(material, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }));
  const infinite = planes.findIndex(({ size }) => !size[0] && !size[1]);
  if (infinite >= 0) drawn[infinite].add(grid);
  if (planes.length) return;
  const shade = new THREE.Mesh(new THREE.PlaneGeometry(gridWidth, gridWidth), new THREE.ShadowMaterial({ opacity: 0.25 }));
  shade.receiveShadow = true;
  const ground = new THREE.Group().add(grid, shade);
  // the ground is at z = 0, or at the lowest point of bodies that move below it
  ground.position.set(center.x, center.y, box.min.z > -0.05 * radius ? Math.min(0, box.min.z) : box.min.z);
  scene.add(ground);
}

function addLights() {
  const sun = new THREE.DirectionalLight("#fff", 2);
  sun.target.position.copy(center);
  sun.position.copy(center).add(new THREE.Vector3(-0.5, -0.8, 2.2).multiplyScalar(radius));
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  Object.assign(sun.shadow.camera, { left: -1.5 * radius, right: 1.5 * radius, bottom: -1.5 * radius, top: 1.5 * radius, near: 0.1 * radius, far: 6 * radius });
  Object.assign(sun.shadow, { bias: -1e-3, normalBias: 0.004 * radius });
  scene.add(sun, sun.target, new THREE.HemisphereLight("#fff", "#b9b4ac", 1.7));
}

addGround();
addLights();
$("note").textContent = `grid ${gridSpacing >= 1e-3 && gridSpacing <= 1e3 ? gridSpacing : gridSpacing.toExponential()} m`;

// view ---------------------------------------------------------------------------------------------------------------------------------------------------

const camera = new THREE.PerspectiveCamera(35, 1, 0.01 * radius, 60 * radius);
camera.up.set(0, 0, 1);
let renderer = null, controls = null, cameraFitted = true, drawRequested = false;

// move the camera as near as the whole box is in view
function fit() {
  const viewAxis = new THREE.Vector3(0.5, -1, 0.25).normalize(), right = new THREE.Vector3().crossVectors(camera.up, viewAxis).normalize();
  const over = new THREE.Vector3().crossVectors(viewAxis, right), slope = Math.tan(camera.fov * Math.PI / 360);
  let distance = 0;
  for (let corner = 0; corner < 8; corner++) {
    const [x, y, z] = ["x", "y", "z"].map((axis, k) => (corner >> k & 1 ? box.max : box.min)[axis] - center[axis]), d = new THREE.Vector3(x, y, z);
    distance = Math.max(distance, d.dot(viewAxis) + 1.06 * Math.max(Math.abs(d.dot(over)), Math.abs(d.dot(right)) / camera.aspect) / slope);
  }
  camera.position.copy(center).addScaledVector(viewAxis, distance);
  controls.target.copy(center);
  controls.update();
  cameraFitted = true;
}

function draw() {
  if (drawRequested || !renderer) return;
  drawRequested = true;
  requestAnimationFrame(() => {
    drawRequested = false;
    renderer.render(scene, camera);
  });
}

function resize() {
  const { clientWidth: width, clientHeight: height } = $("view");
  if (!width || !height) return;
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(width, height, false);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  if (cameraFitted) fit();
  renderer.render(scene, camera); // not in the next frame: setSize clears the canvas, and this frame would be empty
}

try {
  renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  renderer.shadowMap.enabled = true;
  $("view").prepend(renderer.domElement);
  controls = new THREE.OrbitControls(camera, renderer.domElement);
  controls.addEventListener("start", () => { cameraFitted = false; });
  controls.addEventListener("change", draw);
  new ResizeObserver(resize).observe($("view"));
} catch (error) {
  $("note").textContent = `no picture: this browser gives no WebGL (${error.message})`;
}

// time ---------------------------------------------------------------------------------------------------------------------------------------------------

const element = (kind, parts, ...inside) => {
  const node = Object.assign(document.createElement(kind), parts);
  node.append(...inside);
  return node;
};
const percent = t => `${end > begin ? 100 * (t - begin) / (end - begin) : 0}%`;
const now = element("div", { id: "now" }), track = $("track");
let time = begin, playing = false, last = 0;

// a band of the time line for each phase; a mark on it, and a line of the list, for each event
run.phases.forEach((phase, i) => {
  const stop = i + 1 < run.phases.length ? run.phases[i + 1].start : end, start = Math.max(phase.start, begin);
  const band = element("div", { className: "phase" }, element("b", {}, element("span", { textContent: "mobility " }), phase.mobility));
  Object.assign(band.style, { left: percent(start), width: `calc(${percent(Math.max(stop, start))} - ${percent(start)})` });
  track.append(band);
});
const lines = run.events.map(event => {
  const text = `${event.time.toFixed(3)} s  ${event.text}${event.lost ? `, ${event.lost.toPrecision(3)} J lost` : ""}`;
  const mark = element("button", { className: event.time - begin > (end - begin) / 2 ? "mark late" : "mark", ariaLabel: text, onclick: () => seek(event.time) });
  mark.style.left = percent(event.time);
  track.append(mark);
  const line = element("button", { textContent: text, onclick: () => seek(event.time) });
  $("events").append(element("li", {}, line));
  return line;
});
track.append(now);
$("log").hidden = !lines.length;
Object.entries({ min: begin, max: end }).forEach(([name, t]) => track.setAttribute(`aria-value${name}`, t));

function seek(t) {
  time = Math.min(Math.max(t, begin), end);
  const shown = momentAt(time);
  place(shown);
  placeLinkMarkers(shown);
  now.style.left = percent(time);
  track.setAttribute("aria-valuenow", time.toFixed(3));
  $("time").textContent = `${time.toFixed(3)} s`;
  $("mobility").textContent = shown.phase.mobility;
  $("energy").textContent = formatQuantity(shown.energy, "J", 8);
  $("gap").textContent = `${formatQuantity(shown.gap[1], "m")}\n${formatQuantity(shown.gap[0], "rad")}`;
  const held = shown.phase.links.map(link => {
    const dot = element("i");
    dot.style.background = color(link);
    return element("li", {}, dot, link.name);
  });
  $("links").replaceChildren(...held.length ? held : ["nothing"]);
  lines.forEach((line, i) => line.classList.toggle("past", run.events[i].time <= time));
  draw();
}

function play(on) {
  playing = on && end > begin;
  $("play").textContent = playing ? "❚❚" : "▶";
  $("play").ariaLabel = playing ? "pause" : "play";
  if (!playing) return;
  if (time >= end) seek(begin);
  last = performance.now();
  requestAnimationFrame(tick);
}

function tick(at) {
  if (!playing) return;
  seek(time + Math.max(0, at - last) / 1000 * $("speed").value);
  last = at;
  if (time >= end) play(false);
  else requestAnimationFrame(tick);
}

function drag(event) {
  const { left, width } = track.getBoundingClientRect();
  seek(begin + (end - begin) * (event.clientX - left) / width);
}

$("play").onclick = () => play(!playing);
track.onpointerdown = event => {
  // a press on a mark is a click, not a drag
  if (event.target.className.startsWith("mark")) return;
  track.setPointerCapture(event.pointerId);
  drag(event);
};
track.onpointermove = event => { if (track.hasPointerCapture(event.pointerId)) drag(event); };
const frameBy = step => times[Math.min(Math.max(countUpTo(times.length, i => times[i], time) - 1 + step, 0), times.length - 1)];
const KEYS = {
  " ": () => play(!playing), Home: () => seek(begin), End: () => seek(end), ArrowRight: () => seek(frameBy(1)), ArrowLeft: () => seek(frameBy(-1)),
};
addEventListener("keydown", event => {
  // leave the space bar to buttons, and every key to menus
  if (!KEYS[event.key] || event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.(event.key === " " ? "button, select" : "select")) return;
  event.preventDefault();
  KEYS[event.key]();
});

seek(begin);
// for the browser's console and the tests
globalThis.svkc = { run, bodies, linkMarkers, camera, seek, play, get time() { return time; } };
