// Particles, edges and the box of one or two panels, pixel by pixel: as fast on a machine without a
// graphics card, and the same everywhere.

const MARKER = 0.62;  // diameter of a particle, in radii of the graph
const HALO = 2.3;     // radius of the glow, in diameters of a particle
const PLAIN = -1, KINEMATIC = -2;  // values of particles that are not on the colour scale

function rgb(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

class Scene {
  constructor(canvas, rollout) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d", { alpha: false });
    this.rollout = rollout;
    this.solid = rollout.dim === 3;
    this.panel = rgb(rollout.palette.panel);
    this.kinematic = rgb(rollout.palette.kinematic);
    this.centre = rollout.bounds.map(([low, high]) => (low + high) / 2);
    this.box = this.makeBox();
    this.reset();
  }

  // Pan and zoom, and in 3D the direction of the view, at first from an elevated corner.
  reset() {
    this.zoom = 1;
    this.pan = [0, 0];  // in heights of the canvas
    this.yaw = this.solid ? 0.52 : 0;
    this.pitch = this.solid ? 0.38 : 0;
  }

  // Corners of the bounds as codes, and the pairs of them that differ along one axis.
  makeBox() {
    const { bounds, lower, extent, dim } = this.rollout;
    const codes = [], pairs = [];
    for (let corner = 0; corner < 1 << dim; corner++) {
      for (let axis = 0; axis < dim; axis++) {
        const end = bounds[axis][(corner >> axis) & 1];
        codes.push(Math.round((end - lower[axis]) / extent[axis] * LARGEST));
        if (!((corner >> axis) & 1)) pairs.push(corner, corner | (1 << axis));
      }
    }
    return { codes, pairs };
  }

  setRamp(bytes) {
    this.ramp = bytes;
  }

  // Panels: { x, width, clouds }, in shares of the canvas; a cloud: { codes, values, plain, opacity,
  // glow, edges: [[pairs, colour, opacity], ...] }.
  draw(panels) {
    const { canvas, rollout } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
    if (this.width !== width || this.height !== height) {
      Object.assign(canvas, { width, height });
      Object.assign(this, { width, height });
      this.image = this.pen.createImageData(width, height);
      this.bytes = this.image.data;  // whose values stay within 0 and 255
      this.words = new Uint32Array(this.bytes.buffer);
    }
    const [red, green, blue] = this.panel;
    this.words.fill(0xff000000 | (blue << 16) | (green << 8) | red);
    for (const panel of panels) {
      this.left = Math.round(panel.x * width);
      this.right = Math.round((panel.x + panel.width) * width);
      this.scale = this.fit() * this.zoom;
      this.radius = Math.min(Math.max(MARKER * rollout.radius * this.scale, 2.2 * ratio), 40 * ratio) / 2;
      this.lines(this.project(this.box.codes), this.box.pairs, rollout.palette.line, 1);
      for (const cloud of panel.clouds) this.drawCloud(cloud);
    }
    this.pen.putImageData(this.image, 0, 0);
  }

  // Pixels per length that show the whole box in a panel, from any side.
  fit() {
    const sides = this.rollout.bounds.map(([low, high]) => high - low);
    const [wide, high] = this.solid ? [Math.hypot(sides[0], sides[2]), Math.hypot(...sides)] : sides;
    return 0.92 * Math.min((this.right - this.left) / wide, this.height / high);
  }

  // { x, y, near } of codes [N, d]: pixels, and nearness from 0 to 1; x is NaN out of sight.
  project(codes) {
    const { rollout, centre, scale, height, pan } = this, { dim, lower, extent } = rollout;
    const [sinYaw, cosYaw, sinPitch, cosPitch] =
      [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const middle = [(this.left + this.right) / 2 + pan[0] * height, (0.5 - pan[1]) * height];
    const step = extent.map((length) => length / LARGEST), depth = Math.hypot(...extent);
    const n = codes.length / dim;
    const x = new Float32Array(n), y = new Float32Array(n), near = new Float32Array(n).fill(1);
    for (let i = 0; i < n; i++) {
      const a = lower[0] + codes[i * dim] * step[0] - centre[0];
      const b = lower[1] + codes[i * dim + 1] * step[1] - centre[1];
      const c = dim === 3 ? lower[2] + codes[i * dim + 2] * step[2] - centre[2] : 0;
      const front = sinYaw * a + cosYaw * c;  // towards the viewer, before the camera is raised
      x[i] = codes[i * dim] === OUTSIDE ? NaN : middle[0] + scale * (cosYaw * a - sinYaw * c);
      y[i] = middle[1] - scale * (cosPitch * b - sinPitch * front);
      if (dim === 3) near[i] = 0.5 + (sinPitch * b + cosPitch * front) / depth;
    }
    return { x, y, near };
  }

  drawCloud(cloud) {
    const seen = this.project(cloud.codes), count = seen.x.length;
    const order = new Uint32Array(count).map((_, i) => i);
    if (this.solid) order.sort((i, j) => seen.near[i] - seen.near[j]);
    const plain = rgb(cloud.plain), halo = cloud.glow && this.halo();
    // In 2D all glows lie under all edges and particles; in 3D what is nearer hides what is behind.
    if (halo && !this.solid) for (const i of order) this.glow(seen, i, cloud, halo);
    for (const [pairs, colour, opacity] of cloud.edges) this.lines(seen, pairs, colour, opacity);
    for (const i of order) {
      if (halo && this.solid) this.glow(seen, i, cloud, halo);
      this.disc(seen, i, cloud.values[i], plain, cloud.opacity);
    }
  }

  colourOf(value, plain) {
    if (value <= KINEMATIC) return this.kinematic;
    if (value <= PLAIN) return plain;
    const at = 3 * Math.round(255 * value);
    return [this.ramp[at], this.ramp[at + 1], this.ramp[at + 2]];
  }

  blend(x, y, red, green, blue, opacity) {
    if (x < this.left || x >= this.right || y < 0 || y >= this.height) return;
    const at = 4 * (y * this.width + x), { bytes } = this;
    bytes[at] += (red - bytes[at]) * opacity;
    bytes[at + 1] += (green - bytes[at + 1]) * opacity;
    bytes[at + 2] += (blue - bytes[at + 2]) * opacity;
  }

  // A disc with a soft rim; in 3D a lit sphere, paler the farther it is.
  disc(seen, i, value, plain, opacity) {
    const x = seen.x[i], y = seen.y[i], { radius, solid, panel } = this;
    if (!(x > this.left - radius && x < this.right + radius)) return;
    let [red, green, blue] = this.colourOf(value, plain);
    if (solid) {
      const own = 0.35 + 0.65 * seen.near[i];
      [red, green, blue] = [red, green, blue].map((c, k) => panel[k] + (c - panel[k]) * own);
    }
    const reach = radius + 0.5;
    for (let v = Math.ceil(y - reach - 0.5); v <= y + reach - 0.5; v++) {
      for (let u = Math.ceil(x - reach - 0.5); u <= x + reach - 0.5; u++) {
        const dx = u + 0.5 - x, dy = v + 0.5 - y;
        const cover = reach - Math.sqrt(dx * dx + dy * dy);
        if (cover <= 0) continue;
        const light = solid ? 0.8 - 0.3 * (dx + dy) / radius : 1;
        this.blend(u, v, red * light, green * light, blue * light, opacity * Math.min(1, cover));
      }
    }
  }

  // [side, side] of the glow's strength around a particle.
  halo() {
    const reach = Math.ceil(2 * this.radius * HALO), side = 2 * reach + 1;
    const fall = Float32Array.from({ length: side * side }, (_, k) => {
      const square = ((k % side - reach) ** 2 + (Math.floor(k / side) - reach) ** 2) / reach ** 2;
      return Math.max(0, 1 - square) ** 2;
    });
    return { reach, side, fall };
  }

  // Light that adds up, more the higher the value.
  glow(seen, i, cloud, { reach, side, fall }) {
    const value = cloud.values[i], strength = cloud.glow * value * value;
    if (!(value > 0) || strength < 0.02) return;
    const x = Math.floor(seen.x[i]), y = Math.floor(seen.y[i]), { bytes, width, height } = this;
    const [red, green, blue] = this.colourOf(value);
    const from = Math.max(this.left, x - reach), to = Math.min(this.right - 1, x + reach);
    for (let v = Math.max(0, y - reach); v <= Math.min(height - 1, y + reach); v++) {
      let k = (v - y + reach) * side + from - x + reach;
      for (let u = from; u <= to; u++, k++) {
        const share = strength * fall[k], at = 4 * (v * width + u);
        bytes[at] += red * share;
        bytes[at + 1] += green * share;
        bytes[at + 2] += blue * share;
      }
    }
  }

  // Along its longer direction a line covers two pixels at a time, each by its nearness.
  lines({ x, y, near }, pairs, colour, opacity) {
    const [red, green, blue] = rgb(colour);
    for (let k = 0; k < pairs.length; k += 2) {
      const i = pairs[k], j = pairs[k + 1], dx = x[j] - x[i], dy = y[j] - y[i];
      if (Math.max(x[i], x[j]) < this.left || Math.min(x[i], x[j]) > this.right) continue;
      const count = Math.ceil(Math.max(Math.abs(dx), Math.abs(dy))) || 1;
      const share = opacity * (this.solid ? 0.2 + 0.4 * (near[i] + near[j]) : 1);
      const steep = Math.abs(dy) > Math.abs(dx);
      let u = x[i] - 0.5, v = y[i] - 0.5;
      for (let s = 0; s <= count; s++, u += dx / count, v += dy / count) {
        const across = steep ? u : v, first = Math.floor(across), rest = across - first;
        const along = Math.round(steep ? v : u);
        if (steep) {
          this.blend(first, along, red, green, blue, share * (1 - rest));
          this.blend(first + 1, along, red, green, blue, share * rest);
        } else {
          this.blend(along, first, red, green, blue, share * (1 - rest));
          this.blend(along, first + 1, red, green, blue, share * rest);
        }
      }
    }
  }
}
