// Particles, edges and the box of one or two panels, in WebGL 2.

const VERTEX = `#version 300 es
uniform vec3 lower, step, centre;  // of the codes and of the box, length
uniform mat3 turn;
uniform vec2 perLength, shift;     // clip space
uniform highp float size;          // pixels
uniform float reach;               // half the depth of the view, length
in vec3 code;
in float value;
out float shade, amount;
void main() {
  vec3 seen = turn * (lower + code * step - centre);
  gl_Position = vec4(seen.xy * perLength + shift, -seen.z / reach, 1.0);
  if (code.x > ${LARGEST}.5) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = size;
  shade = 0.5 + 0.5 * clamp(seen.z / reach, -1.0, 1.0);  // 1 is near
  amount = value;
}`;

const DISC = 0, GLOW = 1, LINE = 2;
const FRAGMENT = `#version 300 es
precision highp float;
uniform int mode;
uniform bool round;       // shaded as spheres, paler far away
uniform float strength;   // of the glow, or opacity
uniform float size;
uniform vec3 plain, kinematic, panel;
uniform sampler2D ramp;
in float shade, amount;
out vec4 colour;
void main() {
  vec3 own = amount < -1.5 ? kinematic : amount < 0.0 ? plain
    : texture(ramp, vec2((clamp(amount, 0.0, 1.0) * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  vec2 at = 2.0 * gl_PointCoord - 1.0;
  float square = dot(at, at);
  if (mode == ${LINE}) {
    colour = vec4(round ? mix(panel, plain, 0.3 + 0.7 * shade) : plain, strength);
  } else if (mode == ${GLOW}) {
    float fall = max(0.0, 1.0 - square);
    colour = vec4(own, strength * fall * fall * amount * amount);
    if (amount <= 0.0) discard;
  } else {
    if (square > 1.0) discard;
    if (round) {
      own *= 0.55 + 0.45 * sqrt(1.0 - square) * (1.0 + 0.25 * dot(at, vec2(-0.7, -0.7)));
      own = mix(panel, own, 0.35 + 0.65 * shade);
    }
    float edge = round ? 1.0 : 1.0 - smoothstep(1.0 - 4.0 / size, 1.0, square);
    colour = vec4(own, edge * strength);
  }
}`;

const MARKER = 0.62;  // diameter of a particle, in radii of the graph

function rgb(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
}

class Scene {
  constructor(canvas, rollout) {
    this.canvas = canvas;
    this.rollout = rollout;
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!gl) throw new Error("This page draws with WebGL 2, which this browser lacks or has switched off.");
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.uniform = (name) => gl.getUniformLocation(program, name);
    this.code = gl.getAttribLocation(program, "code");
    this.value = gl.getAttribLocation(program, "value");
    this.buffers = { codes: gl.createBuffer(), values: gl.createBuffer(), pairs: gl.createBuffer() };
    this.box = this.makeBox();
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
    gl.enable(gl.BLEND);
    const { palette, lower, extent } = rollout;
    const three = (v) => (v.length === 2 ? [...v, 0] : v);
    gl.uniform3fv(this.uniform("lower"), three(lower));
    gl.uniform3fv(this.uniform("step"), three(extent).map((length) => length / LARGEST));
    gl.uniform3fv(this.uniform("kinematic"), rgb(palette.kinematic));
    gl.uniform3fv(this.uniform("panel"), rgb(palette.panel));
    gl.uniform1i(this.uniform("round"), rollout.dim === 3);
    this.centre = three(rollout.bounds.map(([low, high]) => (low + high) / 2));
    gl.uniform3fv(this.uniform("centre"), this.centre);
    this.reset();
  }

  // Pan and zoom, and in 3D the direction of the view; see view.py for the first one.
  reset() {
    this.zoom = 1;
    this.pan = [0, 0];  // in panel heights
    this.yaw = this.rollout.dim === 3 ? 0.52 : 0;
    this.pitch = this.rollout.dim === 3 ? 0.38 : 0;
  }

  // Rows point right, up (the second axis, seen from the front), and towards the viewer.
  turn() {
    const [a, b, c, d] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    return [[b, 0, -a], [-c * a, d, -c * b], [d * a, c, d * b]];
  }

  makeBox() {
    const { bounds, lower, extent, dim } = this.rollout;
    const ends = bounds.map((pair, axis) => pair.map((x) => Math.round((x - lower[axis]) / extent[axis] * LARGEST)));
    const codes = [], pairs = [];
    for (let corner = 0; corner < 1 << dim; corner++) {
      for (let axis = 0; axis < dim; axis++) {
        codes.push(ends[axis][(corner >> axis) & 1]);
        if (!((corner >> axis) & 1)) pairs.push(corner, corner | (1 << axis));
      }
    }
    return { codes: Uint16Array.from(codes), pairs: Uint32Array.from(pairs) };
  }

  setRamp(bytes) {
    const { gl } = this;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes);
  }

  upload(codes, values) {
    const { gl, buffers, rollout } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.codes);
    gl.bufferData(gl.ARRAY_BUFFER, codes, gl.STREAM_DRAW);
    gl.enableVertexAttribArray(this.code);
    gl.vertexAttribPointer(this.code, rollout.dim, gl.UNSIGNED_SHORT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.values);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STREAM_DRAW);
    gl.enableVertexAttribArray(this.value);
    gl.vertexAttribPointer(this.value, 1, gl.FLOAT, false, 0, 0);
  }

  lines(pairs, colour, opacity) {
    const { gl } = this;
    if (!pairs.length) return;
    gl.uniform1i(this.uniform("mode"), LINE);
    gl.uniform1f(this.uniform("strength"), opacity);
    gl.uniform3fv(this.uniform("plain"), rgb(colour));
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.pairs);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, pairs, gl.STREAM_DRAW);
    gl.drawElements(gl.LINES, pairs.length, gl.UNSIGNED_INT, 0);
  }

  points(mode, size, strength, plain) {
    const { gl } = this;
    gl.uniform1i(this.uniform("mode"), mode);
    gl.uniform1f(this.uniform("size"), size);
    gl.uniform1f(this.uniform("strength"), strength);
    gl.uniform3fv(this.uniform("plain"), rgb(plain));
    gl.drawArrays(gl.POINTS, 0, this.rollout.particles);
  }

  // Pixels per length that show the whole box in a panel of this size.
  fit(width, height) {
    const length = this.rollout.bounds.map(([low, high]) => high - low);
    const wide = length.length === 2 ? length[0] : Math.hypot(length[0], length[2]);
    const high = length.length === 2 ? length[1] : Math.hypot(...length);
    return Math.min(width / wide, height / high) * 0.92;
  }

  // Panels: { x, width, clouds }, in shares of the canvas; a cloud: { codes, values, plain, opacity,
  // glow, edges: [[pairs, colour, opacity], ...] }.
  draw(panels) {
    const { gl, canvas, rollout } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const solid = rollout.dim === 3;
    gl.disable(gl.SCISSOR_TEST);
    gl.depthMask(true);
    gl.clearColor(...rgb(rollout.palette.panel), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    gl.uniformMatrix3fv(this.uniform("turn"), true, this.turn().flat());
    const length = Math.hypot(...rollout.extent);
    gl.uniform1f(this.uniform("reach"), solid ? length / 2 : 1);
    for (const panel of panels) {
      const x = Math.round(panel.x * width), w = Math.round(panel.width * width);
      gl.viewport(x, 0, w, height);
      gl.scissor(x, 0, w, height);
      const scale = this.fit(w, height) * this.zoom;
      gl.uniform2f(this.uniform("perLength"), 2 * scale / w, 2 * scale / height);
      gl.uniform2f(this.uniform("shift"), 2 * this.pan[0] * height / w, 2 * this.pan[1]);
      const size = Math.min(Math.max(MARKER * rollout.radius * scale, 2 * ratio), 40 * ratio);
      gl.disable(gl.DEPTH_TEST);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      this.upload(this.box.codes, new Float32Array(this.box.codes.length / rollout.dim));
      this.lines(this.box.pairs, rollout.palette.line, 1);
      for (const cloud of panel.clouds) this.drawCloud(cloud, size, solid);
    }
  }

  drawCloud(cloud, size, solid) {
    const { gl } = this;
    const edges = () => cloud.edges.forEach((list) => this.lines(...list));
    this.upload(cloud.codes, cloud.values);
    if (solid) gl.enable(gl.DEPTH_TEST); else edges();
    if (solid) this.points(DISC, size, cloud.opacity, cloud.plain);
    if (cloud.glow) {
      gl.depthMask(false);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE);
      this.points(GLOW, 4.5 * size, cloud.glow, cloud.plain);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.depthMask(true);
    }
    if (solid) edges(); else this.points(DISC, size, cloud.opacity, cloud.plain);
  }
}
