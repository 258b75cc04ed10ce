// The source of the viewer. The page contains bundle.js, which is built from this file and three.js:
//
//   npm ci --ignore-scripts && npm run build
//
// .ci/check_viewer_bundle checks that the bundle is up to date. The page has a JSON script "header", and a script of
// compressed base64 data for each array; __init__.py describes the layout.
import {
  BufferAttribute, BufferGeometry, Color, DataTexture, DoubleSide, LinearFilter, Mesh, PerspectiveCamera, RGBAFormat,
  Raycaster, Scene, ShaderMaterial, Vector2, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const MISSING = 65535; // stands for NaN and infinite values
const SECONDS = 12; // duration of the animation

const by = (id) => document.getElementById(id);

async function inflate(text) {
  const raw = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// The bytes are the low bytes and then the high bytes of the differences between successive frames: 0, -1, 1, -2, ... are
// stored as 0, 1, 2, 3, ...
function frames(bytes, count, size) {
  const values = new Uint16Array(count * size);
  const high = count * size;
  for (let i = 0; i < count * size; i++) {
    const code = bytes[i] | (bytes[high + i] << 8);
    const change = ((code >>> 1) ^ -(code & 1)) & 65535;
    values[i] = i < size ? change : (values[i - size] + change) & 65535;
  }
  return values;
}

function positions(bytes, header) {
  const whole = new Uint16Array(bytes.buffer);
  const points = new Float32Array(whole.length);
  for (let i = 0; i < whole.length; i++) {
    const axis = i % 3;
    points[i] = header.low[axis] + (header.span[axis] * whole[i]) / 65535;
  }
  return points;
}

function shades(rows) {
  const pixels = new Uint8Array(rows.length * 4);
  rows.forEach((row, i) => pixels.set([...row, 255], 4 * i));
  const texture = new DataTexture(pixels, rows.length, 1, RGBAFormat);
  texture.minFilter = texture.magFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

const VERTEX = `
  attribute float before;
  attribute float after;
  uniform float share;
  uniform float steps;
  varying float value;
  varying float missing;
  varying vec3 facing;
  varying vec3 seen;
  void main() {
    missing = max(step(0.99999, before), step(0.99999, after));
    value = mix(before, after, share) * 65535.0 / steps;
    vec4 viewed = modelViewMatrix * vec4(position, 1.0);
    facing = normalMatrix * normal;
    seen = -viewed.xyz;
    gl_Position = projectionMatrix * viewed;
  }`;
const FRAGMENT = `
  uniform sampler2D map;
  uniform float samples;
  varying float value;
  varying float missing;
  varying vec3 facing;
  varying vec3 seen;
  void main() {
    vec3 color = texture2D(map, vec2((clamp(value, 0.0, 1.0) * (samples - 1.0) + 0.5) / samples, 0.5)).rgb;
    color = mix(color, vec3(0.5), step(0.001, missing));
    float light = abs(dot(normalize(facing), normalize(seen)));
    gl_FragColor = vec4(color * (0.38 + 0.62 * pow(light, 0.8)), 1.0);
  }`;

function pretty(number) {
  if (!Number.isFinite(number)) return "NaN";
  const size = Math.abs(number);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? number.toExponential(3) : String(Number(number.toPrecision(4)));
}

async function start() {
  const header = JSON.parse(by("header").textContent);
  if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old to decompress the data");
  const array = (id) => inflate(by(id).textContent.trim());
  const size = header.vertices, count = header.times.length;
  const [points, corners, ...fields] = await Promise.all([
    array("positions"), array("faces"), ...header.species.map((_, s) => array(`field-${s}`)),
  ]);
  const states = fields.map((bytes) => frames(bytes, count, size));

  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions(points, header), 3));
  geometry.setIndex(new BufferAttribute(new Uint32Array(corners.buffer), 1));
  geometry.computeVertexNormals();
  geometry.computeBoundingSphere();
  const before = new BufferAttribute(new Uint16Array(size), 1, true);
  const after = new BufferAttribute(new Uint16Array(size), 1, true);
  geometry.setAttribute("before", before);
  geometry.setAttribute("after", after);
  const maps = Object.fromEntries(Object.entries(header.colormaps).map(([name, rows]) => [name, shades(rows)]));
  const uniforms = { map: { value: null }, samples: { value: 1 }, share: { value: 0 }, steps: { value: 1 } };
  const material = new ShaderMaterial({ uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT, side: DoubleSide });
  const mesh = new Mesh(geometry, material);
  const scene = new Scene();
  scene.add(mesh);

  const canvas = by("scene");
  const renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  renderer.outputColorSpace = "srgb-linear"; // no conversion, because the colour maps are in sRGB
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  const camera = new PerspectiveCamera(35, 1, 0.01, 1000);
  const controls = new OrbitControls(camera, canvas);
  controls.enableDamping = true;
  const { center, radius } = geometry.boundingSphere;

  const state = { at: 0, species: 0, colormap: header.colormap, playing: false, shown: [-1, -1, -1] };
  let stale = true, moved = false;
  // Marks the picture, and with it the value under the pointer, as out of date.
  const refresh = () => { stale = moved = true; };
  controls.addEventListener("change", refresh);

  function resetView() {
    const narrow = Math.min(1, canvas.clientWidth / Math.max(canvas.clientHeight, 1));
    const distance = (1.12 * radius) / Math.sin((camera.fov * Math.PI) / 360) / narrow;
    camera.near = distance / 100;
    camera.far = distance * 10;
    camera.position.copy(center).add(new Vector3(0.42, 0.28, 0.86).normalize().multiplyScalar(distance));
    controls.target.copy(center);
    camera.updateProjectionMatrix();
    controls.update();
    refresh();
  }

  function resize() {
    const { clientWidth: width, clientHeight: height } = canvas.parentElement;
    renderer.setSize(width, height, false);
    camera.aspect = width / Math.max(height, 1);
    camera.updateProjectionMatrix();
    refresh();
  }

  function load(attribute, species, frame) {
    attribute.array.set(states[species].subarray(frame * size, (frame + 1) * size));
    attribute.needsUpdate = true;
  }

  function show() {
    const first = Math.min(Math.floor(state.at), count - 1), second = Math.min(first + 1, count - 1);
    if (state.shown[0] !== first || state.shown[2] !== state.species) load(before, state.species, first);
    if (state.shown[1] !== second || state.shown[2] !== state.species) load(after, state.species, second);
    state.shown = [first, second, state.species];
    uniforms.share.value = state.at - first;
    by("time").textContent = `t = ${pretty(timeAt(state.at))}`;
    by("slider").value = String(state.at);
  }

  const timeAt = (at) => {
    const first = Math.floor(at), second = Math.min(first + 1, count - 1);
    return header.times[first] + (header.times[second] - header.times[first]) * (at - first);
  };

  function setFrame(at) {
    state.at = Math.min(Math.max(Number(at), 0), count - 1);
    show();
    refresh();
  }

  function setSpecies(name) {
    state.species = Math.max(0, header.species.findIndex((species) => species.name === name));
    const { low, high, steps } = header.species[state.species];
    uniforms.steps.value = steps;
    by("low").textContent = pretty(low);
    by("high").textContent = pretty(high);
    by("species").value = header.species[state.species].name;
    show();
    refresh();
  }

  function setColormap(name) {
    if (!(name in maps)) return;
    state.colormap = name;
    uniforms.map.value = maps[name];
    uniforms.samples.value = header.colormaps[name].length;
    const stops = header.colormaps[name].map((rgb) => `rgb(${rgb.join(",")})`);
    by("bar").style.background = `linear-gradient(to right, ${stops.join(",")})`;
    by("colormap").value = name;
    refresh();
  }

  function setPlaying(playing) {
    state.playing = playing && count > 1;
    if (state.playing && state.at >= count - 1) setFrame(0);
    by("play").textContent = state.playing ? "❚❚" : "▶";
    by("play").setAttribute("aria-label", state.playing ? "pause" : "play");
  }

  const raycaster = new Raycaster();
  function valueAt(x, y) {
    const box = canvas.getBoundingClientRect();
    const place = new Vector2((2 * (x - box.left)) / box.width - 1, 1 - (2 * (y - box.top)) / box.height);
    raycaster.setFromCamera(place, camera);
    const hit = raycaster.intersectObject(mesh)[0];
    if (!hit) return null;
    const { a, b, c } = hit.face;
    const spots = [a, b, c].map((i) => new Vector3().fromBufferAttribute(geometry.attributes.position, i));
    const total = new Vector3().subVectors(spots[1], spots[0]).cross(new Vector3().subVectors(spots[2], spots[0])).length();
    const weights = [0, 1, 2].map((i) => {
      const [p, q] = [spots[(i + 1) % 3], spots[(i + 2) % 3]];
      return new Vector3().subVectors(p, hit.point).cross(new Vector3().subVectors(q, hit.point)).length() / total;
    });
    const { low, high, steps } = header.species[state.species];
    let value = 0;
    [a, b, c].forEach((vertex, i) => {
      const [first, second] = [before.array[vertex], after.array[vertex]];
      const whole = first === MISSING || second === MISSING ? NaN : first + (second - first) * uniforms.share.value;
      value += weights[i] * (low + ((high - low) * whole) / steps);
    });
    return { value, vertex: [a, b, c][weights.indexOf(Math.max(...weights))] };
  }

  let pointer = null, asked = 0, answers = 0;
  function point(event) {
    pointer = [event.clientX, event.clientY];
    moved = true;
  }
  function tell(now) {
    if (pointer === null || !moved || now - asked < 60) return;
    asked = now;
    moved = false;
    answers += 1;
    const hit = valueAt(...pointer);
    const label = by("value");
    label.hidden = hit === null;
    if (hit === null) return;
    label.textContent = `${header.species[state.species].name} = ${pretty(hit.value)}`;
    label.style.left = `${Math.min(pointer[0] + 14, window.innerWidth - label.offsetWidth - 8)}px`;
    label.style.top = `${Math.max(pointer[1] - 34, 8)}px`;
  }

  function savePicture() {
    renderer.render(scene, camera);
    const link = document.createElement("a");
    link.download = `${header.title.replace(/[^\w-]+/g, "-") || "picture"}.png`;
    link.href = canvas.toDataURL("image/png");
    link.click();
    return link.href;
  }

  for (const { name } of header.species) by("species").add(new Option(name, name));
  for (const name of Object.keys(maps)) by("colormap").add(new Option(name, name));
  by("species").hidden = header.species.length < 2;
  by("timeline").hidden = count < 2;
  by("slider").max = String(count - 1);
  by("title").textContent = document.title = header.title;
  by("slider").addEventListener("input", (event) => { setPlaying(false); setFrame(event.target.value); });
  by("species").addEventListener("change", (event) => setSpecies(event.target.value));
  by("colormap").addEventListener("change", (event) => setColormap(event.target.value));
  by("play").addEventListener("click", () => setPlaying(!state.playing));
  by("reset").addEventListener("click", resetView);
  by("save").addEventListener("click", savePicture);
  canvas.addEventListener("pointermove", point);
  canvas.addEventListener("pointerdown", point);
  canvas.addEventListener("pointerleave", (event) => {
    if (event.pointerType === "touch") return; // the value stays when the finger is lifted
    pointer = null;
    by("value").hidden = true;
  });
  window.addEventListener("resize", resize);
  window.addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLSelectElement) return;
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.key === " ") setPlaying(!state.playing);
    else if (step) { setPlaying(false); setFrame(Math.round(state.at) + step); }
    else return;
    event.preventDefault();
  });

  let last = performance.now(), drawn = 0;
  function draw(now) {
    if (state.playing) {
      const at = state.at + ((now - last) / 1000) * ((count - 1) / SECONDS);
      setFrame(at);
      if (at >= count - 1) setPlaying(false);
    }
    last = now;
    controls.update();
    tell(now);
    if (stale) {
      stale = false;
      drawn += 1;
      renderer.render(scene, camera);
    }
    requestAnimationFrame(draw);
  }

  scene.background = new Color(0xf4f4f2);
  resize();
  resetView();
  setColormap(state.colormap);
  setSpecies(header.species[0].name);
  setFrame(count - 1);
  by("loading").hidden = true;
  requestAnimationFrame(draw);
  return {
    frames: count, setFrame, setSpecies, setColormap, setPlaying, resetView, valueAt, savePicture,
    get frame() { return state.at; },
    get playing() { return state.playing; },
    get drawn() { return drawn; },
    get answers() { return answers; },
    get distance() { return camera.position.distanceTo(controls.target); },
    // The stored value of a vertex in a frame.
    stored(species, frame, vertex) {
      const { low, high, steps } = header.species[species], whole = states[species][frame * size + vertex];
      return whole === MISSING ? NaN : low + ((high - low) * whole) / steps;
    },
  };
}

window.viewer = start().then(
  (viewer) => Object.assign(window, { viewer, viewerReady: true }).viewer,
  (error) => { by("loading").textContent = `The viewer cannot start: ${error.message}.`; throw error; },
);
