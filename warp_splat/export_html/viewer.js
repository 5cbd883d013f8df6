// The page: unpacks the Gaussians, part by part as the browser reads it, sorts and draws them as the camera moves,
// follows mouse, fingers and keys.

const MOVING = 200; // ms after the last input until the image is drawn in full detail
const FRAME = 50; // ms that a frame should take while moving; its detail is chosen so
const PATIENCE = 5; // times of a frame between pictures while the page loads: a slow card must not hold that up
const LOOK = 10; // ms between looks for a part that is on its way
const element = (id) => document.getElementById(id);
const say = (text) => { element("message").textContent = text; };

// The text of a part, once the browser has read past it; it is megabytes, and leaves the page.
async function partText(id) {
  for (;;) {
    const found = element(id);
    if (found?.nextSibling) {
      found.remove();
      return found.textContent;
    }
    if (document.readyState !== "loading") throw new Error("This page ends too early: copy or load it again.");
    await new Promise((resolve) => setTimeout(resolve, LOOK));
  }
}

// A part as numbers for whole rows of `width` texels, from what pack.py made of it.
async function unpack(base64, texels, width) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This page needs a browser of 2023 or later (DecompressionStream).");
  }
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const row = 16 * width, packed = new Uint8Array(row * Math.ceil(planes.length / row)), each = 16 * texels;
  for (let plane = 0, from = 0; plane < each; plane++) {
    for (let to = plane; to < planes.length; to += each) packed[to] = planes[from++];
  }
  return new Uint32Array(packed.buffer);
}

class Viewer {
  constructor(scene) {
    this.scene = scene;
    this.canvas = element("canvas");
    this.renderer = new Renderer(this.canvas, scene);
    this.canvas.addEventListener("webglcontextlost", () => say("The graphics card was reset: load this page again."));
    this.worker = new Worker(URL.createObjectURL(new Blob([source("sort.js")], { type: "text/javascript" })));
    this.worker.postMessage({ total: scene.coarse + scene.count, near: scene.near, width: this.renderer.width });
    this.worker.onmessage = ({ data }) => this.sorted(data);
    this.worker.onerror = () => say("The Gaussians could not be sorted: this browser refuses workers.");
    this.version = this.loaded = this.shown = 0; // of the camera; how many Gaussians came and are to be drawn
    this.missing = scene.parts.length;
    [this.sortedVersion, this.sortedRange] = [-1, [0, -1]];
    this.sorting = this.requested = false;
    this.lastInput = -Infinity;
    this.waiting = [];
    this.mostPixels = Infinity;
    new ResizeObserver(() => this.request()).observe(this.canvas);
  }

  // Adds these parts of the page as they come.
  async load(parts) {
    const { scene, renderer } = this;
    for (const part of parts) {
      const [, table, chunk] = part.match(/(\D+)(\d+)/), first = chunk * scene.chunk;
      const texels = table === "gaussians" ? 2 : scene.harmonics;
      const numbers = await unpack(await partText(part), texels, renderer.width);
      renderer.fill(table, first * texels, numbers);
      if (table === "gaussians") this.addMeans(first, new Float32Array(numbers.buffer));
      this.missing--;
      this.show();
    }
    const count = `${scene.count.toLocaleString("en")} Gaussians`;
    element("count").textContent = this.missing ? `${scene.coarse.toLocaleString("en")} for ${count}` : count;
  }

  // Draws what came; while more is to come, in a while, if the card is slow.
  show() {
    clearTimeout(this.showing);
    const wait = this.missing ? this.renderer.started + PATIENCE * this.renderer.frameTime - performance.now() : 0;
    if (wait > 0) {
      this.showing = setTimeout(() => this.show(), wait);
      return;
    }
    this.shown = this.loaded;
    this.request();
  }

  addMeans(first, numbers) {
    this.loaded = Math.min(first + this.scene.chunk, this.scene.coarse + this.scene.count);
    const means = new Float32Array(3 * (this.loaded - first));
    for (let i = 0; i < this.loaded - first; i++) for (let k = 0; k < 3; k++) means[3 * i + k] = numbers[8 * i + k];
    this.worker.postMessage({ means, first });
    this.means ??= means; // enough to find what the camera looks at
  }

  // Shows what `camera` sees (world coordinates; see camera.js); resolves once what came is sorted and drawn in full
  // detail.
  setCamera(camera) {
    this.lastInput = -Infinity;
    const axes = [0, 1, 2].map((column) => camera.rotation.map((row) => row[column]));
    this.move({ ...camera, axes, position: sum(camera.position, this.scene.origin, -1) });
    this.pivot = sum(this.camera.position, axes[2], focusDepth(this.camera, this.means));
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
    this.sort();
    this.request();
  }

  // How long the camera still counts as moving [ms].
  get rest() {
    return this.lastInput + MOVING - performance.now();
  }

  // Which Gaussians to draw: all; while they come, those that are there, and the coarse ones that stand for others;
  // while the camera moves, the coarse ones, if there are many or the card is slow.
  get wanted() {
    const { scene: { coarse, count, chunk, moving, replaced }, shown, renderer } = this;
    const few = !this.missing && count <= moving && count * renderer.pace <= FRAME;
    if (!coarse || (this.rest > 0 && !few)) return [0, coarse || shown];
    return [replaced[Math.ceil((shown - coarse) / chunk)], shown];
  }

  // Whether what is sorted is what is wanted.
  get current() {
    return this.sortedRange.join() === this.wanted.join();
  }

  sort() {
    if (this.sorting || (this.sortedVersion === this.version && this.current)) return;
    this.sorting = true;
    const { position, axes: [, , forward] } = this.camera;
    this.worker.postMessage({ position, forward, version: this.version, range: this.wanted });
  }

  sorted({ order, visible, version, range, milliseconds }) {
    this.renderer.setOrder(order, visible, range);
    this.sorting = false;
    [this.sortedVersion, this.sortedRange, this.sortTime] = [version, range, milliseconds];
    this.sort();
    this.request();
  }

  request() {
    if (!this.requested) requestAnimationFrame(() => this.frame());
    this.requested = true;
  }

  frame() {
    this.requested = false;
    if (!this.camera) return;
    if (!this.renderer.ready) return this.request(); // nothing piles up before a slow card
    const { canvas } = this, [wide, high] = [canvas.clientWidth, canvas.clientHeight];
    const most = Math.min(this.renderer.mostEdge / Math.max(wide, high), Math.sqrt(this.mostPixels / (wide * high)));
    const ratio = Math.min(window.devicePixelRatio, most);
    const [width, height] = [wide, high].map((size) => Math.max(1, Math.round(size * ratio)));
    if (canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
      const { drawingBufferWidth, drawingBufferHeight } = this.renderer.gl; // a browser may give less
      if (drawingBufferWidth && (drawingBufferWidth < width || drawingBufferHeight < height)) {
        this.mostPixels = 0.99 * drawingBufferWidth * drawingBufferHeight;
        return this.request();
      }
    }
    const { rest } = this;
    this.sort();
    const right = rest > 0 ? this.current : this.sortedVersion === this.version && (this.missing || this.current);
    if (!right) return; // the sort's end draws it
    if (rest > 0) {
      clearTimeout(this.sharpen);
      this.sharpen = setTimeout(() => this.request(), rest + 1);
    }
    const detail = rest > 0 ? this.renderer.detailFor(FRAME) : 1;
    this.renderer.draw(fitted(this.camera, Math.ceil(width * detail), Math.ceil(height * detail)), detail, rest <= 0);
    this.watch();
    if (rest <= 0) for (const resolve of this.waiting.splice(0)) resolve();
  }

  // Sees when the frame is done, whether or not another follows.
  watch() {
    if (!this.renderer.ready) requestAnimationFrame(() => this.watch());
  }

  // What the hand does: `dx`, `dy` in px of the page.
  orbit(dx, dy) {
    const angle = Math.PI / Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.input(orbited(this.camera, this.pivot, this.scene.up, -dx * angle, -dy * angle));
  }

  pan(dx, dy) {
    const { fx, position, axes } = fitted(this.camera, this.canvas.clientWidth, this.canvas.clientHeight);
    const perPixel = -dot(sum(this.pivot, position, -1), axes[2]) / fx;
    const shift = [0, 1, 2].map((i) => perPixel * (axes[0][i] * dx + axes[1][i] * dy));
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
  const viewer = new Viewer(scene);
  await viewer.load(scene.parts.slice(0, scene.before));
  follow(viewer);
  element("bar").hidden = false;
  element("previous").hidden = element("next").hidden = scene.cameras.length < 2;
  const first = viewer.step(0).then(() => say(scene.count ? "" : "This model holds no Gaussians."));
  const all = viewer.load(scene.parts.slice(scene.before));
  window.warpSplat = {
    cameras: scene.cameras,
    get times() { // docs/page.md says of what
      const { frameTime, detail, drawn } = viewer.renderer;
      return { sort: viewer.sortTime, frame: frameTime, detail, drawn };
    },
    setCamera: (camera) => all.then(() => viewer.setCamera(camera)),
  };
  await Promise.allSettled([first, all]);
  await all;
} catch (error) {
  say(error.message);
}
