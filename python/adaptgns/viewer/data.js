"use strict";
// What Python left in the page: a scene in JSON, and tensors as gzipped differences of 16 bits.

async function bytesOf(id) {
  const element = document.getElementById(`data-${id}`);
  const text = atob(element.textContent);
  element.textContent = "";
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// The inverse of encoded() in encoding.py: rows of `width` codes, summed `order` times.
async function readTensor(id, width, order) {
  const packed = new Blob([await bytesOf(id)]).stream();
  const stream = packed.pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = bytes.length / 2;
  const codes = new Uint16Array(count);  // whose sums wrap at 2^16, as they must
  for (let i = 0; i < count; i++) codes[i] = bytes[i] | (bytes[count + i] << 8);
  for (let pass = 0; pass < order; pass++) {
    for (let i = width; i < count; i++) codes[i] += codes[i - width];
  }
  return codes;
}

const OUTSIDE = 0xffff, LARGEST = 0xfffe;

class Rollout {
  static async read() {
    if (!window.DecompressionStream) {
      throw new Error("This page needs a browser of 2023 or later, which can unpack its data (DecompressionStream).");
    }
    const rollout = new Rollout();
    const scene = JSON.parse(new TextDecoder().decode(await bytesOf("scene")));
    Object.assign(rollout, scene);
    const width = scene.particles * scene.dim;
    rollout.positions = {
      true: await readTensor("true", width, 2),
      predicted: await readTensor("predicted", width, 2),
    };
    rollout.sigmaCodes = scene.log_sigma && await readTensor("sigma", scene.particles, 1);
    rollout.steps = scene.frames[scene.frames.length - 1];
    rollout.extent = scene.upper.map((high, axis) => high - scene.lower[axis]);
    rollout.period = rollout.extent.map((length, axis) => (scene.periodic[axis] ? length : 0));
    return rollout;
  }

  // The codes [N, d] of the positions in a frame; `side` is "true" or "predicted".
  codes(side, frame) {
    const width = this.particles * this.dim;
    return this.positions[side].subarray(frame * width, (frame + 1) * width);
  }

  // [N] sigma that the step to this frame predicted; null before the first step.
  sigma(frame) {
    if (!this.sigmaCodes || frame === 0) return null;
    const [low, high] = this.log_sigma, n = this.particles;
    const row = this.sigmaCodes.subarray(frame * n, (frame + 1) * n);
    return Float64Array.from(row, (code) => Math.exp(low + (high - low) * code / LARGEST));
  }

  // [N] distances between two frames' positions, to the nearest image; NaN out of sight.
  distance(a, b) {
    const { dim, extent, period } = this;
    const result = new Float64Array(this.particles);
    for (let i = 0; i < this.particles; i++) {
      let square = a[i * dim] === OUTSIDE || b[i * dim] === OUTSIDE ? NaN : 0;
      for (let axis = 0; axis < dim; axis++) {
        let d = (a[i * dim + axis] - b[i * dim + axis]) * extent[axis] / LARGEST;
        if (period[axis]) d -= period[axis] * Math.round(d / period[axis]);
        square += d * d;
      }
      result[i] = Math.sqrt(square);
    }
    return result;
  }

  error(frame) {
    return this.distance(this.codes("predicted", frame), this.codes("true", frame));
  }

  // [N] length per time, over the frames that are here; those before the first step are unknown.
  speed(side, frame) {
    if (frame === 0) return null;
    const time = (this.frames[frame] - this.frames[frame - 1]) * this.dt;
    return this.distance(this.codes(side, frame), this.codes(side, frame - 1)).map((d) => d / time);
  }
}
