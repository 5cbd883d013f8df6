// Draws the Gaussians in three passes: project each to 2D, blend them front to back, resolve the image to the canvas.

const source = (name) => document.getElementById(name).textContent;

const LEAST_DETAIL = 0.2;
const BATCH = 1 << 16; // Gaussians drawn by one call

class Renderer {
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
    if (!gl) throw new Error("This page needs WebGL 2, which this browser lacks or has switched off.");
    this.gl = gl;
    this.mostEdge = gl.getParameter(gl.MAX_TEXTURE_SIZE); // px
    this.width = Math.min(4096, this.mostEdge);
    const rows = (texels) => Math.max(1, Math.ceil(((scene.coarse + scene.count) * texels) / this.width));
    if (rows(Math.max(2, scene.harmonics)) > this.mostEdge) {
      throw new Error(`${scene.count} Gaussians are more than this graphics card takes; export fewer.`);
    }
    this.gaussians = this.texture(gl.RGBA32UI, this.width, rows(2));
    this.harmonics = this.texture(gl.RGBA32UI, this.width, rows(scene.harmonics)); // 0 until they come: no harmonics
    this.projected = [0, 1].map(() => this.texture(gl.RGBA32UI, this.width, rows(1)));
    this.projectTarget = this.framebuffer(this.projected);
    this.programs = {
      project: this.program("screen.glsl", "project.glsl"),
      blend: this.program("outline.glsl", "blend.glsl"),
      resolve: this.program("screen.glsl", "resolve.glsl"),
    };
    this.order = this.texture(gl.R32UI, this.width, rows(1));
    [this.range, this.visible] = [[0, 0], 0];
    const corners = new Uint32Array(6 * BATCH); // two triangles of each four vertices
    for (let i = 0; i < corners.length; i++) corners[i] = 4 * Math.floor(i / 6) + [0, 1, 2, 1, 3, 2][i % 6];
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    [this.detail, this.drawn, this.frameTime, this.fence] = [1, 0, 0, null];
    [this.started, this.pace] = [-Infinity, 0]; // when the last frame was; ms for a Gaussian, at rest
    // blended in float32 where the card can (software renderers need half the time of float16), in float16, which costs
    // 4 dB, or in the last resort in 8 bits, which costs 20
    this.imageFormat = gl.getExtension("EXT_color_buffer_float")
      ? gl.getExtension("EXT_float_blend") ? gl.RGBA32F : gl.RGBA16F
      : gl.getExtension("EXT_color_buffer_half_float") ? gl.RGBA16F : gl.RGBA8;
  }

  texture(format, width, height) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  framebuffer(textures) {
    const { gl } = this, framebuffer = gl.createFramebuffer();
    const points = textures.map((_, index) => gl.COLOR_ATTACHMENT0 + index);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    textures.forEach((texture, index) => {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, points[index], gl.TEXTURE_2D, texture, 0);
    });
    gl.drawBuffers(points);
    return framebuffer;
  }

  program(...names) {
    const { gl } = this, handle = gl.createProgram();
    names.forEach((name, index) => {
      const shader = gl.createShader(index ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, `#version 300 es
        precision highp float;
        precision highp int;
        const int WIDTH = ${this.width};
        const float SNAP = ${0.5 ** (gl.getParameter(gl.SUBPIXEL_BITS) + 1)}; // px, by which corners are rounded
        uvec4 texel(highp usampler2D table, int index) { // of tables in rows of one width
          return texelFetch(table, ivec2(index % WIDTH, index / WIDTH), 0);
        }
        ${source("constants.glsl")}
        ${source(name)}`);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(handle, shader);
    });
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS)) throw new Error(`${names}: ${gl.getProgramInfoLog(handle)}`);
    return { handle, at: (name) => gl.getUniformLocation(handle, name) };
  }

  // A target for images of this size; one of another size is dropped.
  resize(width, height) {
    const { gl } = this;
    if (this.size?.[0] === width && this.size?.[1] === height) return;
    gl.deleteTexture(this.image);
    gl.deleteFramebuffer(this.blendTarget);
    this.image = this.texture(this.imageFormat, width, height);
    this.blendTarget = this.framebuffer([this.image]);
    this.size = [width, height];
  }

  // Numbers for whole rows of the "gaussians", the "harmonics" or the "order", from the texel `first` on.
  fill(table, first, numbers) {
    const { gl, width } = this;
    const [format, channels] = table === "order" ? [gl.RED_INTEGER, 1] : [gl.RGBA_INTEGER, 4];
    const [row, rows] = [first / width, numbers.length / channels / width];
    gl.bindTexture(gl.TEXTURE_2D, this[table]);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, rows, format, gl.UNSIGNED_INT, numbers);
  }

  // The Gaussians to draw, of those in `range`, nearest first: the first `visible` of `order`, which fills rows.
  setOrder(order, visible, range) {
    this.fill("order", 0, order);
    [this.visible, this.range] = [visible, range];
  }

  get count() {
    return this.range[1] - this.range[0];
  }

  // Draws what `camera` sees, which moves or is at rest; its size is that of the canvas times `detail`.
  draw(camera, detail, atRest) {
    const size = [camera.width, camera.height];
    this.resize(this.gl.canvas.width, this.gl.canvas.height);
    this.project(camera, size);
    this.blend(size);
    this.resolve(detail);
    [this.detail, this.drawn, this.atRest] = [detail, this.count, atRest];
    this.started = performance.now();
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
  }

  // Whether the last frame is done; then `frameTime` says how long it took, if somebody looks in time.
  get ready() {
    const { gl } = this;
    if (!this.fence) return true;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost()) return false;
    this.frameTime = performance.now() - this.started;
    if (this.atRest) this.pace = this.frameTime / Math.max(1, this.drawn);
    gl.deleteSync(this.fence);
    this.fence = null;
    return true;
  }

  // The detail at which a frame should take as long, judged by the last one [ms] and by how many each draws.
  detailFor(milliseconds) {
    const factor = Math.sqrt(milliseconds / Math.max(1, (this.frameTime * this.count) / Math.max(1, this.drawn)));
    return Math.min(1, Math.max(LEAST_DETAIL, this.detail * Math.min(1.1, factor)));
  }

  // Begins a pass of the program `name` over the textures of its samplers; returns where its uniforms are.
  begin(name, target, viewport, textures) {
    const { gl } = this, { handle, at } = this.programs[name];
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(...viewport);
    gl.useProgram(handle);
    Object.entries(textures).forEach(([sampler, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(at(sampler), unit);
    });
    return at;
  }

  project(camera, size) {
    const { gl, gaussians, harmonics } = this;
    const [row, end] = [Math.floor(this.range[0] / this.width), Math.ceil(this.range[1] / this.width)];
    const at = this.begin("project", this.projectTarget, [0, row, this.width, end - row], { gaussians, harmonics });
    gl.disable(gl.BLEND);
    gl.uniform1i(at("end"), this.range[1]);
    gl.uniformMatrix3fv(at("rotation"), true, camera.axes.flat());
    gl.uniform3fv(at("center"), camera.position);
    gl.uniform2f(at("focal"), camera.fx, camera.fy);
    gl.uniform2f(at("principal"), camera.cx, camera.cy);
    gl.uniform2fv(at("size"), size);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  blend(size) {
    const { gl, order, projected: [meanAndRoot, rootAndColor] } = this;
    const at = this.begin("blend", this.blendTarget, [0, 0, ...size], { order, meanAndRoot, rootAndColor });
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 1]);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniform2fv(at("size"), size);
    for (let first = 0; first < this.visible; first += BATCH) {
      gl.uniform1i(at("first"), first);
      gl.drawElements(gl.TRIANGLES, 6 * Math.min(BATCH, this.visible - first), gl.UNSIGNED_INT, 0);
    }
  }

  resolve(detail) {
    const { gl, image } = this, at = this.begin("resolve", null, [0, 0, ...this.size], { image });
    gl.disable(gl.BLEND);
    gl.uniform2fv(at("size"), this.size);
    gl.uniform1f(at("detail"), detail);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
