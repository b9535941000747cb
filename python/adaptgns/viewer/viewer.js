// The state of the page, and what changes it.

const element = (id) => document.getElementById(id);
const RATES = [8, 15, 30, 60, 120];  // steps per second

class Viewer {
  constructor(rollout) {
    this.rollout = rollout;
    this.frame = 0;
    this.playing = false;
    this.draws = 0;
    const { palette } = rollout;
    for (const name of ["background", "panel", "line", "text", "true", "predicted", "base", "extra", "kinematic"]) {
      document.documentElement.style.setProperty(`--${name}`, palette[name]);
    }
    this.scene = new Scene(element("particles"), rollout);
    this.makeCurves();
    this.makeControls();
    this.describe();
    this.refresh();
    new ResizeObserver(() => this.refresh()).observe(element("stage"));
  }

  describe() {
    const { label, policy, name, particles, steps, radius, adaptive, every, dt } = this.rollout;
    element("title").textContent = `${label}, ${policy} graph`;
    const facts = [
      `trajectory ${name}`, `${particles.toLocaleString("en")} particles`, `${steps.toLocaleString("en")} steps`,
      `dt ${formatted(dt)}`, `r ${radius}`,
    ];
    if (adaptive) facts.push(`τ ${adaptive.tau}`, `factor ${adaptive.factor}`);
    if (every > 1) facts.push(`1 step in ${every} is shown, to keep the file small`);
    if (!["fixed", "adaptive"].includes(policy)) {
      facts.push(`the edges drawn are those within r: what the policy ${policy} chose is not recorded`);
    }
    element("facts").textContent = facts.join(" · ");
    element("mouse").textContent = this.rollout.dim === 3 ? "drag: orbit · wheel: zoom" : "drag: move · wheel: zoom";
  }

  makeCurves() {
    const { rollout } = this, { palette, steps } = rollout;
    const seek = (step) => this.seek(this.frameOf(step));
    // The graph of step k is that of the positions after step k - 1.
    const edges = rollout.edges.map((count, step) => [step, count]);
    const mse = rollout.mse.map((value, row) => [row + 1, value]).filter(([, value]) => value !== null);
    const shared = { steps, palette, seek, colour: palette.predicted };
    this.curves = [
      new Curve(element("curve-edges"), edges, { ...shared, logarithmic: false }),
      new Curve(element("curve-mse"), mse, { ...shared, logarithmic: true }),
    ];
  }

  makeControls() {
    const { rollout } = this;
    const choices = { sigma: "predicted σ", error: "error", speed: "speed", type: "type" };
    if (!rollout.log_sigma) delete choices.sigma;
    for (const [value, text] of Object.entries(choices)) element("colour").add(new Option(text, value));
    for (const rate of RATES) element("rate").add(new Option(`${rate} steps/s`, rate, rate === 30, rate === 30));
    element("time").max = rollout.frames.length - 1;
    element("extra").disabled = !rollout.adaptive;
    element("extra").checked = Boolean(rollout.adaptive);
    element("play").addEventListener("click", () => this.play(!this.playing));
    element("time").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    for (const id of ["colour", "layout", "edges", "extra"]) element(id).addEventListener("change", () => this.refresh());
    // A menu gives the keys back to the page once a choice is made.
    for (const id of ["rate", "colour", "layout"]) element(id).addEventListener("change", () => element(id).blur());
    document.addEventListener("keydown", (event) => this.key(event));
    const canvas = element("particles");
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => event.buttons && this.drag(event.movementX, event.movementY));
    canvas.addEventListener("dblclick", () => this.resetView());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.scene.zoom = Math.min(40, Math.max(0.3, this.scene.zoom * Math.exp(-event.deltaY / 500)));
      this.refresh();
    }, { passive: false });
  }

  drag(dx, dy) {
    const { scene } = this, height = scene.canvas.clientHeight;
    if (this.rollout.dim === 3) {
      scene.yaw -= dx / 200;
      scene.pitch = Math.min(1.55, Math.max(-1.55, scene.pitch + dy / 200));
    } else {
      scene.pan = [scene.pan[0] + dx / height, scene.pan[1] - dy / height];
    }
    this.refresh();
  }

  resetView() {
    this.scene.reset();
    this.refresh();
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    // What has the focus answers to some keys itself.
    const focus = event.target.tagName, toggles = focus === "BUTTON" || event.target.type === "checkbox";
    if (focus === "SELECT" || (toggles && event.key === " ")) return;
    const last = this.rollout.frames.length - 1, stride = event.shiftKey ? 10 : 1;
    const cycle = (id, by) => {
      const select = element(id), count = select.options.length;
      select.selectedIndex = (select.selectedIndex + by + count) % count;
      this.refresh();
    };
    const flip = (id) => {
      if (!element(id).disabled) element(id).checked = !element(id).checked;
      this.refresh();
    };
    const actions = {
      " ": () => this.play(!this.playing),
      ArrowRight: () => this.seek(this.frame + stride),
      ArrowLeft: () => this.seek(this.frame - stride),
      Home: () => this.seek(0),
      End: () => this.seek(last),
      "]": () => cycle("rate", element("rate").selectedIndex < RATES.length - 1 ? 1 : 0),
      "[": () => cycle("rate", element("rate").selectedIndex > 0 ? -1 : 0),
      c: () => cycle("colour", 1),
      o: () => cycle("layout", 1),
      e: () => flip("edges"),
      x: () => flip("extra"),
      0: () => this.resetView(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  // The last frame at or before a step.
  frameOf(step) {
    return Math.min(Math.floor(step / this.rollout.every), this.rollout.frames.length - 1);
  }

  seek(frame) {
    this.play(false);
    this.show(frame);
  }

  show(frame) {
    this.frame = Math.min(Math.max(0, frame), this.rollout.frames.length - 1);
    this.refresh();
  }

  play(playing) {
    if (playing === this.playing) return;
    this.playing = playing;
    element("play").textContent = playing ? "pause" : "play";
    if (!playing) return;
    const last = this.rollout.frames.length - 1;
    if (this.frame === last) this.frame = 0;
    let at = this.frame, before = null;
    const tick = (now) => {
      if (!this.playing) return;
      if (before !== null) at += (now - before) / 1000 * Number(element("rate").value) / this.rollout.every;
      before = now;
      if (Math.floor(at) !== this.frame) this.show(Math.min(Math.floor(at), last));
      if (this.frame === last) this.play(false);
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  // Draw at the next opportunity, once however much has changed.
  refresh() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
      this.draws++;
    });
  }

  draw() {
    const { rollout, frame } = this, { palette } = rollout;
    const colour = element("colour").value, over = element("layout").value === "over";
    const step = rollout.frames[frame];
    this.setScale(colour);
    const graph = element("edges").checked || element("extra").checked ? graphOf(rollout, frame) : null;
    const edges = [];
    if (graph && element("edges").checked) edges.push([graph.base, palette.base, 0.9]);
    if (graph && element("extra").checked) edges.push([graph.extra, palette.extra, 0.7]);
    const truth = {
      codes: rollout.codes("true", frame), edges: [], plain: palette.true, opacity: over ? 0.5 : 1, glow: 0,
      values: this.values(over || colour === "sigma" || colour === "error" ? "plain" : colour, "true"),
    };
    const prediction = {
      codes: rollout.codes("predicted", frame), edges, plain: palette.predicted, opacity: 1,
      glow: colour !== "sigma" ? 0 : rollout.dim === 3 ? 0.1 : 0.18, values: this.values(colour, "predicted"),
    };
    this.scene.draw(over
      ? [{ x: 0, width: 1, clouds: [truth, prediction] }]
      : [{ x: 0, width: 0.5, clouds: [truth] }, { x: 0.5, width: 0.5, clouds: [prediction] }]);
    element("stage").className = over ? "over" : "beside";
    element("time").value = frame;
    element("now").textContent = `step ${step.toLocaleString("en")} of ${rollout.steps.toLocaleString("en")}`;
    this.describeState(graph, colour, over, step);
    for (const curve of this.curves) curve.draw(step);
  }

  // [N] shares of the colour scale, or PLAIN or KINEMATIC.
  values(colour, side) {
    const { rollout, frame } = this, result = new Float32Array(rollout.particles).fill(PLAIN);
    if (colour === "type") return result.map((_, i) => (rollout.types[i] % 9 + 9) % 9 / 255);
    const measured = {
      plain: () => null,
      sigma: () => rollout.sigma(frame),
      error: () => rollout.error(frame),
      speed: () => rollout.speed(side, frame),
    }[colour]();
    const share = measured && this.share(colour);
    for (let i = 0; i < result.length; i++) {
      if (!rollout.mobile[i]) result[i] = KINEMATIC;
      else if (measured && measured[i] >= 0) result[i] = Math.min(1, Math.max(0, share(measured[i])));
    }
    return result;
  }

  share(colour) {
    const [low, high] = this.rollout.scales[colour];
    if (colour === "speed") return (value) => (value - low) / (high - low);
    return (value) => Math.log(Math.max(value, low) / low) / Math.log(high / low);
  }

  setScale(colour) {
    if (colour === this.scaled) return;
    this.scaled = colour;
    const { palette, scales, types, type_names } = this.rollout;
    const bytes = new Uint8Array(768);
    if (colour === "type") palette.types.forEach((hex, type) => bytes.set(rgb(hex), 3 * type));
    else bytes.set(palette.maps[colour]);
    this.scene.setRamp(bytes);
    element("scale").hidden = colour === "type";
    element("type-keys").hidden = colour !== "type";
    if (colour === "type") {
      element("type-keys").replaceChildren(...[...new Set(types)].sort((a, b) => a - b).map((type) => {
        const key = document.createElement("span"), dot = document.createElement("i");
        dot.className = "dot";
        dot.style.background = palette.types[(type % 9 + 9) % 9];
        key.append(dot, ["type " + type, type_names[type]].filter(Boolean).join(", "));
        return key;
      }));
      return;
    }
    const names = {
      sigma: "predicted σ of the acceleration, normalized",
      error: "distance to the truth, length",
      speed: "speed, length per time",
    };
    const [low, high] = scales[colour];
    element("scale-name").textContent = names[colour];
    element("scale-low").textContent = (colour === "speed" ? "" : "≤ ") + formatted(low);
    element("scale-high").textContent = "≥ " + formatted(high) + (colour === "speed" ? "" : ", logarithmic");
    const pen = element("ramp").getContext("2d"), image = pen.createImageData(256, 1);
    for (let i = 0; i < 256; i++) image.data.set([...bytes.subarray(3 * i, 3 * i + 3), 255], 4 * i);
    pen.putImageData(image, 0, 0);
  }

  describeState(graph, colour, over, step) {
    const { rollout, frame } = this, whole = (count) => count.toLocaleString("en");
    const plain = element("key-plain");
    plain.hidden = !(over || colour === "sigma" || colour === "error");
    plain.querySelector("b").textContent = over || colour === "error" ? "truth" : "truth, which has no σ";
    element("key-kinematic").hidden = colour === "type" || rollout.mobile.every(Boolean);
    for (const [id, box, count] of [["base", "edges", graph?.baseCount], ["extra", "extra", graph?.extraCount]]) {
      element(`key-${id}`).hidden = !element(box).checked;
      element(`key-${id}`).querySelector("b").textContent = graph ? whole(2 * count) : "";
    }
    const recorded = rollout.edges[step], mse = step > 0 ? rollout.mse[step - 1] : 0;
    element("edges-now").textContent = recorded === undefined ? "" : whole(recorded);
    element("mse-now").textContent = step === 0 ? "" : mse === null ? "not finite" : mse.toExponential(2);
    for (const side of ["true", "predicted"]) {
      const codes = rollout.codes(side, frame);
      let lost = 0;
      for (let i = 0; i < codes.length; i += rollout.dim) lost += codes[i] === OUTSIDE;
      element(`lost-${side}`).textContent = lost ? `${whole(lost)} out of sight` : "";
    }
    this.graph = graph;
  }
}

Rollout.read()
  .then((rollout) => { window.viewer = new Viewer(rollout); })
  .catch((error) => {
    element("message").hidden = false;
    element("message").textContent = error.message;
    throw error;
  });
