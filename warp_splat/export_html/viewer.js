// The page: unpacks the Gaussians, sorts and draws them as the camera moves, follows mouse, fingers and keys.

const MOVING = 200; // ms after the last input until the image is drawn in full detail
const FRAME = 50; // ms that a frame should take while moving; its detail is chosen so
const element = (id) => document.getElementById(id);
const say = (text) => { element("message").textContent = text; };

async function unpack(scene) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This page needs a browser of 2023 or later (DecompressionStream).");
  }
  const text = atob(source("gaussians"));
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const width = 16 * scene.stride, packed = new Uint8Array(planes.length);
  for (let plane = 0, from = 0; plane < width; plane++) {
    for (let to = plane; to < packed.length; to += width) packed[to] = planes[from++];
  }
  const numbers = new Float32Array(packed.buffer), means = new Float32Array(3 * scene.count);
  for (let i = 0; i < scene.count; i++) {
    for (let k = 0; k < 3; k++) means[3 * i + k] = numbers[4 * scene.stride * i + k];
  }
  return [packed, means];
}

class Viewer {
  constructor(scene, packed, means) {
    this.scene = scene;
    this.means = means;
    this.canvas = element("canvas");
    this.renderer = new Renderer(this.canvas, scene, packed);
    this.canvas.addEventListener("webglcontextlost", () => say("The graphics card was reset: load this page again."));
    this.worker = new Worker(URL.createObjectURL(new Blob([source("sort.js")], { type: "text/javascript" })));
    this.worker.postMessage({ means, near: scene.near, room: this.renderer.width * this.renderer.rows });
    this.worker.onmessage = ({ data }) => this.sorted(data);
    this.worker.onerror = () => say("The Gaussians could not be sorted: this browser refuses workers.");
    this.version = this.sortedVersion = 0; // of the camera
    this.sorting = this.requested = false;
    this.lastInput = -Infinity;
    this.waiting = [];
    new ResizeObserver(() => this.request()).observe(this.canvas);
  }

  // Shows what `camera` sees (world coordinates; see camera.js); resolves once it is sorted and drawn in full detail.
  setCamera(camera) {
    this.lastInput = -Infinity;
    this.move({ ...camera, position: sum(camera.position, this.scene.origin, -1) });
    this.pivot = sum(this.camera.position, axis(this.camera, 2), focusDepth(this.camera, this.means));
    return new Promise((resolve) => this.waiting.push(resolve));
  }

  // Shows one of the model's cameras, counted around.
  step(to) {
    const { cameras } = this.scene;
    this.chosen = (to + cameras.length) % cameras.length;
    element("camera").textContent = `${cameras[this.chosen].name} (${this.chosen + 1} of ${cameras.length})`;
    return this.setCamera(cameras[this.chosen]);
  }

  move(camera) {
    this.camera = camera;
    this.version++;
    if (!this.sorting) this.sort();
    this.request();
  }

  sort() {
    this.sorting = true;
    const { position } = this.camera;
    this.worker.postMessage({ position, forward: axis(this.camera, 2), version: this.version });
  }

  sorted({ order, visible, version, milliseconds }) {
    this.renderer.setOrder(order, visible);
    this.sorting = false;
    this.sortedVersion = version;
    this.sortTime = milliseconds;
    if (version !== this.version) this.sort();
    this.request();
  }

  request() {
    if (!this.requested) requestAnimationFrame((now) => this.frame(now));
    this.requested = true;
  }

  frame(now) {
    this.requested = false;
    if (!this.renderer.ready) return this.request(); // nothing piles up before a slow card
    const { canvas } = this, ratio = window.devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(1, Math.round(size * ratio)));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const rest = this.lastInput + MOVING - now;
    if (rest <= 0 && this.sortedVersion !== this.version) return; // the sort's end draws it
    if (rest > 0) {
      clearTimeout(this.sharpen);
      this.sharpen = setTimeout(() => this.request(), rest + 1);
    }
    const detail = rest > 0 ? this.renderer.detailFor(FRAME) : 1;
    this.renderer.draw(fitted(this.camera, Math.ceil(width * detail), Math.ceil(height * detail)), detail);
    if (rest <= 0) for (const resolve of this.waiting.splice(0)) resolve();
  }

  // Of the last sort and of the last frame [ms], and the share of the canvas's pixels in a row that it had.
  get times() {
    const { frameTime, detail } = this.renderer;
    return { sort: this.sortTime, frame: frameTime, detail };
  }

  // What the hand does: `dx`, `dy` in px of the page.
  orbit(dx, dy) {
    const angle = Math.PI / Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.input(orbited(this.camera, this.pivot, this.scene.up, -dx * angle, -dy * angle));
  }

  pan(dx, dy) {
    const { fx } = fitted(this.camera, this.canvas.clientWidth, this.canvas.clientHeight);
    const depth = dot(sum(this.pivot, this.camera.position, -1), axis(this.camera, 2));
    const shift = [0, 1, 2].map((i) => (-depth / fx) * (axis(this.camera, 0)[i] * dx + axis(this.camera, 1)[i] * dy));
    this.pivot = sum(this.pivot, shift);
    this.input({ ...this.camera, position: sum(this.camera.position, shift) });
  }

  dolly(factor) {
    const arm = sum(this.camera.position, this.pivot, -1);
    this.input({ ...this.camera, position: sum(this.pivot, arm, factor) });
  }

  input(camera) {
    this.lastInput = performance.now();
    this.move(camera);
  }
}

// Mouse and touch: one pointer orbits, or moves with another button or Shift; two pinch and move.
function follow(viewer) {
  const { canvas } = viewer, pointers = new Map();
  const middle = () => [...pointers.values()].reduce((a, b) => sum(a, b, 1), [0, 0]).map((value) => value / pointers.size);
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId) || pointers.size > 2) return;
    const before = [middle(), pointers.size === 2 ? spread() : 0];
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const [dx, dy] = sum(middle(), before[0], -1);
    if (pointers.size === 1 && event.buttons === 1 && !event.shiftKey) return viewer.orbit(dx, dy);
    if (pointers.size === 2) viewer.dolly(Math.max(before[1], 1) / Math.max(spread(), 1));
    viewer.pan(dx, dy);
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    viewer.dolly(Math.exp(0.0015 * event.deltaY * (event.deltaMode ? 20 : 1)));
  }, { passive: false });
  const steps = { previous: -1, next: 1, ArrowLeft: -1, ArrowRight: 1 };
  for (const id of ["previous", "next"]) element(id).onclick = () => viewer.step(viewer.chosen + steps[id]);
  document.addEventListener("keydown", (event) => {
    if (event.key in steps) viewer.step(viewer.chosen + steps[event.key]);
  });
}

try {
  const scene = JSON.parse(source("scene"));
  const viewer = new Viewer(scene, ...(await unpack(scene)));
  element("gaussians").remove(); // megabytes of text
  follow(viewer);
  element("bar").hidden = false;
  element("previous").hidden = element("next").hidden = scene.cameras.length < 2;
  element("count").textContent = `${scene.count.toLocaleString("en")} Gaussians`;
  await viewer.step(0);
  window.warpSplat = {
    cameras: scene.cameras, setCamera: (camera) => viewer.setCamera(camera), get times() { return viewer.times; },
  };
  say(scene.count ? "" : "This model holds no Gaussians.");
} catch (error) {
  say(error.message);
}
