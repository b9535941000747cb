// The graph that the step after a frame sees, from what the page holds: a pair is an edge where its
// distance is at most r, or at most factor * r and one end is high. High is a sigma above the
// tau-th percentile of those of the mobile particles; kinematic ones never are.

// numpy's percentile, linear between the nearest ranks
function percentile(values, tau) {
  const sorted = Float64Array.from(values).sort();
  const at = (sorted.length - 1) * tau / 100, below = Math.floor(at);
  const above = Math.min(below + 1, sorted.length - 1);
  return sorted[below] + (sorted[above] - sorted[below]) * (at - below);
}

function highParticles(rollout, frame) {
  const high = new Uint8Array(rollout.particles);
  const sigma = rollout.adaptive && rollout.sigma(frame);
  if (!sigma) return high;
  const threshold = percentile(sigma.filter((_, i) => rollout.mobile[i]), rollout.adaptive.tau);
  for (let i = 0; i < high.length; i++) high[i] = rollout.mobile[i] && sigma[i] > threshold;
  return high;
}

// Particles sorted into cells no smaller than the cutoff; few along an axis, for the memory.
class Cells {
  constructor(rollout, codes, cutoff) {
    const { particles, dim, extent } = rollout;
    this.periodic = rollout.periodic;
    const most = dim === 2 ? 1024 : 64;
    this.counts = extent.map((length) => Math.max(1, Math.min(most, Math.floor(length / cutoff))));
    const total = this.counts.reduce((a, b) => a * b);
    this.of = new Int32Array(particles).fill(-1);
    this.start = new Int32Array(total + 1);
    for (let i = 0; i < particles; i++) {
      if (codes[i * dim] === OUTSIDE) continue;
      let cell = 0;
      for (let axis = 0; axis < dim; axis++) {
        const count = this.counts[axis];
        cell = cell * count + Math.min(count - 1, Math.floor(codes[i * dim + axis] / LARGEST * count));
      }
      this.of[i] = cell;
      this.start[cell + 1]++;
    }
    for (let cell = 0; cell < total; cell++) this.start[cell + 1] += this.start[cell];
    this.members = new Int32Array(this.start[total]);
    const next = this.start.slice();
    for (let i = 0; i < particles; i++) if (this.of[i] >= 0) this.members[next[this.of[i]]++] = i;
  }

  // The cells around one, itself among them, each once.
  around(cell) {
    let found = [0], rest = cell;
    const coordinates = [];
    for (let axis = this.counts.length - 1; axis >= 0; axis--) {
      coordinates[axis] = rest % this.counts[axis];
      rest = Math.floor(rest / this.counts[axis]);
    }
    this.counts.forEach((count, axis) => {
      let near = [-1, 0, 1].map((step) => coordinates[axis] + step);
      near = this.periodic[axis]
        ? [...new Set(near.map((c) => (c + count) % count))]
        : near.filter((c) => c >= 0 && c < count);
      found = found.flatMap((prefix) => near.map((c) => prefix * count + c));
    });
    return found;
  }
}

// Pairs of particles, each counted once. Those that run through a periodic boundary can't be drawn
// straight: they count, but are not in the lists `base` and `extra` of ends, one pair after another.
function graphOf(rollout, frame) {
  const { dim, extent, period, radius, particles } = rollout;
  const codes = rollout.codes("predicted", frame);
  const high = highParticles(rollout, frame);
  const anyHigh = high.includes(1);
  const far = anyHigh ? radius * rollout.adaptive.factor : radius;
  const cells = new Cells(rollout, codes, far), { of, start, members } = cells;
  const around = new Map();
  const at = Float64Array.from(codes, (code, k) => code * extent[k % dim] / LARGEST);
  const base = [], extra = [];
  let baseCount = 0, extraCount = 0;
  for (let i = 0; i < particles; i++) {
    const cell = of[i];
    if (cell < 0) continue;
    if (!around.has(cell)) around.set(cell, cells.around(cell));
    for (const other of around.get(cell)) {
      for (let k = start[other + 1] - 1; k >= start[other]; k--) {
        const j = members[k];
        if (j <= i) break;  // a cell's members are in their order
        let square = 0, wraps = false;
        for (let axis = 0; axis < dim; axis++) {
          let d = at[i * dim + axis] - at[j * dim + axis];
          if (period[axis] && Math.abs(d) > period[axis] / 2) {
            d = period[axis] - Math.abs(d);
            wraps = true;
          }
          square += d * d;
        }
        const near = square <= radius * radius;
        if (!near && !((high[i] || high[j]) && square <= far * far)) continue;
        if (near) baseCount++; else extraCount++;
        if (!wraps) (near ? base : extra).push(i, j);
      }
    }
  }
  return { base: Uint32Array.from(base), extra: Uint32Array.from(extra), baseCount, extraCount };
}
