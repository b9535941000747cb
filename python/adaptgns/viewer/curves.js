// A curve per step under the particles, with a cursor at the step that is shown.

class Curve {
  // `values` [[step, value], ...] without null; `seek` is called with the step under the pointer.
  constructor(canvas, values, { steps, colour, logarithmic, palette, seek }) {
    Object.assign(this, { canvas, values, steps, colour, logarithmic, palette });
    const seen = values.map(([, value]) => value).filter((value) => !logarithmic || value > 0);
    this.high = seen.reduce((a, b) => Math.max(a, b), 0) || 1;
    // The first steps' errors are orders of magnitude below what can be seen.
    this.low = logarithmic ? Math.max(seen.reduce((a, b) => Math.min(a, b), this.high), 1e-6 * this.high) : 0;
    if (logarithmic && this.low === this.high) this.low = this.high / 10;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      seek(this.stepAt(event.offsetX));
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) seek(this.stepAt(event.offsetX));
    });
  }

  get left() { return 52; }
  get right() { return this.canvas.clientWidth - 6; }
  get bottom() { return this.canvas.clientHeight - 17; }

  stepAt(x) {
    const share = (x - this.left) / (this.right - this.left);
    return Math.round(Math.min(1, Math.max(0, share)) * this.steps);
  }

  x(step) {
    return this.left + (this.right - this.left) * step / Math.max(1, this.steps);
  }

  y(value) {
    const share = this.logarithmic
      ? Math.log(Math.max(value, this.low) / this.low) / Math.log(this.high / this.low)
      : value / this.high;
    return this.bottom - (this.bottom - 6) * share;
  }

  ticks() {
    if (!this.logarithmic) {
      const rough = this.high / 2, power = 10 ** Math.floor(Math.log10(rough));
      const unit = power * [1, 2, 5].filter((k) => k * power <= rough).pop();
      return [0, 1, 2, 3].map((k) => k * unit).filter((value) => value <= this.high);
    }
    const powers = [];
    const span = Math.max(1, Math.ceil(Math.log10(this.high / this.low) / 3));
    for (let p = Math.floor(Math.log10(this.high)); 10 ** p >= this.low; p -= span) powers.push(10 ** p);
    return powers;
  }

  draw(step) {
    const { canvas, palette } = this;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.font = "10px system-ui, 'DejaVu Sans', sans-serif";
    pen.fillStyle = palette.text;
    pen.strokeStyle = palette.line;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (const value of this.ticks()) {
      pen.fillText(formatted(value), this.left - 6, this.y(value));
      line(pen, [[this.left, this.y(value)], [this.right, this.y(value)]]);
    }
    pen.textBaseline = "alphabetic";
    for (const at of [0, Math.round(this.steps / 2), this.steps]) {
      pen.textAlign = at === 0 ? "left" : at === this.steps ? "right" : "center";
      pen.fillText(at === 0 ? "step 0" : String(at), this.x(at), this.bottom + 14);
    }
    pen.lineWidth = 1.5;
    pen.strokeStyle = this.colour;
    line(pen, this.values.map(([at, value]) => [this.x(at), this.y(value)]));
    pen.lineWidth = 1;
    pen.strokeStyle = palette.text;
    line(pen, [[this.x(step), 2], [this.x(step), this.bottom]]);
    const here = this.values.find(([at]) => at === step);
    if (!here) return;
    pen.fillStyle = "#ffffff";
    pen.beginPath();
    pen.arc(this.x(step), this.y(here[1]), 3, 0, 2 * Math.PI);
    pen.fill();
  }
}

function line(pen, points) {
  pen.beginPath();
  points.forEach(([x, y]) => pen.lineTo(x, y));
  pen.stroke();
}

function formatted(value) {
  if (value === 0) return "0";
  if (value >= 1000) return Math.round(value).toLocaleString("en");
  if (value < 0.01) return value.toExponential(1).replace(".0", "");
  return String(Number(value.toPrecision(3)));
}
