// The arm in three dimensions, on a plain canvas: a few hundred strokes, sorted by depth. That needs no WebGL, which a
// computer in a laboratory or at the end of a remote desktop may lack, and is a hundredth of a library's weight.

const usable = (point) => point?.length === 3 && point.every(Number.isFinite);
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.turn = -0.9;
    this.tilt = 0.4;
    this.zoom = 1;
    this.low = [-1, -1, 0];
    this.high = [1, 1, 1];
    this.over = null; // whether the first axis points down, so that the picture is turned over
    this.frames = 0;
    this.scene = { places: [], poses: [], links: [], tip: null, ghost: null };
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.colours = null; this.draw(); });
    this.#listen();
  }

  show(change) {
    Object.assign(this.scene, change);
    this.draw();
  }

  look(turn, tilt) {
    Object.assign(this, { turn, tilt, zoom: 1, low: [-1, -1, 0], high: [1, 1, 1] });
    this.draw();
  }

  turnOver() {
    this.over = !this.over;
    this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.#paint(); });
  }

  #listen() {
    const canvas = this.canvas, fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      if (fingers.size === 2) {
        const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
        const apart = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        this.zoom = clamp(this.zoom * apart(event) / Math.max(apart(before), 1), 0.3, 12);
      } else {
        this.turn += (event.clientX - before.clientX) * 0.008;
        this.tilt = clamp(this.tilt + (event.clientY - before.clientY) * 0.008, -1.5708, 1.5708);
      }
      fingers.set(event.pointerId, event);
      this.draw();
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom = clamp(this.zoom * Math.exp(-event.deltaY * 0.0015), 0.3, 12);
      this.draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      const grow = { "+": 1.15, "=": 1.15, "-": 1 / 1.15 }[event.key];
      if (!step && !grow) return;
      event.preventDefault();
      if (step) [this.turn, this.tilt] = [this.turn + step[0], clamp(this.tilt + step[1], -1.5708, 1.5708)];
      if (grow) this.zoom = clamp(this.zoom * grow, 0.3, 12);
      this.draw();
    });
  }

  // A box about all that was ever shown: it grows, so that the picture does not jump.
  #enclose() {
    const { places, poses, links, ghost } = this.scene;
    const known = [...places.map((place) => place.position), ...poses.map((pose) => pose.tip)];
    const all = [...links, ...(ghost?.links ?? []), ...known];
    for (const point of all) {
      if (!usable(point)) continue;
      for (let i = 0; i < 3; i++) {
        this.low[i] = Math.min(this.low[i], point[i]);
        this.high[i] = Math.max(this.high[i], point[i]);
      }
    }
    // Some robots' first axis points down; few robots hang from a ceiling.
    if (this.over === null && links.length) this.over = this.low[2] + this.high[2] < 0;
    this.middle = this.low.map((low, i) => (low + this.high[i]) / 2);
    const heights = places.map((place) => place.position).filter(usable).map((point) => point[2]);
    this.floor = this.over ? Math.max(0, ...heights) : Math.min(0, ...heights);
    this.extent = Math.max(Math.hypot(...this.low.map((low, i) => this.high[i] - low)) / 2, 1);
  }

  #project(point) {
    const [x, y, z] = point.map((value, i) => (i && this.over ? -1 : 1) * (value - this.middle[i]) / this.extent);
    const c = Math.cos(this.turn), s = Math.sin(this.turn), ct = Math.cos(this.tilt), st = Math.sin(this.tilt);
    const across = c * x - s * y, away = s * x + c * y;
    const depth = ct * away - st * z, near = 1 / (1 + 0.22 * depth);
    const size = this.scale * near;
    return [this.width / 2 + size * across, this.height / 2 - size * (ct * z + st * away), depth, near];
  }

  #paint() {
    const { canvas, pen } = this, ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [canvas.clientWidth, canvas.clientHeight];
    if (!this.width) return;
    const [w, h] = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    if (!this.colours) {
      const style = getComputedStyle(document.documentElement);
      const names = ["ink", "soft", "line", "page", "arm", "arm-light", "ghost", "floor", "good", "bad", "warm"];
      this.colours = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
    }
    this.#enclose();
    this.scale = 1.35 * this.zoom * Math.min(this.width, this.height) / 2;
    [this.strokes, this.labels] = [[], []];
    this.enlarged = this.#enlarged();
    this.#floor();
    this.#marks();
    const { links, ghost, tip } = this.scene, short = Math.min(this.width, this.height);
    const thick = clamp(short * 0.03, 7, 22) * this.zoom ** 0.5;
    if (ghost) {
      this.#chain(ghost.links, thick, true);
      if (tip) this.#line([tip, ghost.links.at(-1)], this.colours.ghost, 2, [3, 6]);
    }
    this.#chain(links, thick, false);
    this.strokes.sort((a, b) => b.depth - a.depth).forEach((stroke) => stroke.paint());
    this.labels.forEach((paint) => paint());
    this.frames += 1;
    canvas.dataset.frames = this.frames;
  }

  #line(points, colour, width, dash = [], lift = 0) {
    const [a, b] = points.map((point) => this.#project(point));
    this.strokes.push({ depth: (a[2] + b[2]) / 2 - lift, paint: () => this.#stroke([a, b], colour, width, dash) });
  }

  #stroke(points, colour, width, dash = []) {
    const { pen } = this;
    pen.beginPath();
    points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    Object.assign(pen, { strokeStyle: colour, lineWidth: width, lineCap: "round", lineJoin: "round" });
    pen.setLineDash(dash);
    pen.stroke();
    pen.setLineDash([]);
  }

  #dot(at, radius, fill, edge, width = 2) {
    const { pen } = this;
    pen.beginPath();
    pen.arc(at[0], at[1], radius, 0, 2 * Math.PI);
    if (fill) { pen.fillStyle = fill; pen.fill(); }
    if (edge) { Object.assign(pen, { strokeStyle: edge, lineWidth: width }); pen.stroke(); }
  }

  // The floor below everything, with a line every 100, 200 or 500 mm and so on, and the shadow of the arm.
  #floor() {
    const z = this.floor, size = 10 ** Math.floor(Math.log10(this.extent));
    const step = [0.1, 0.2, 0.5, 1].map((part) => part * size).find((s) => this.extent / s < 7) ?? size;
    const from = this.low.map((low) => Math.floor(low / step - 0.5) * step);
    const to = this.high.map((high) => Math.ceil(high / step + 0.5) * step);
    const put = (a, b) => this.#stroke([this.#project(a), this.#project(b)], this.colours.line, 1);
    for (let x = from[0]; x <= to[0] + step / 2; x += step) put([x, from[1], z], [x, to[1], z]);
    for (let y = from[1]; y <= to[1] + step / 2; y += step) put([from[0], y, z], [to[0], y, z]);
    const shadow = this.scene.links.map(([x, y]) => this.#project([x, y, z]));
    if (shadow.length > 1) this.#stroke(shadow, this.colours.floor, clamp(this.scale * 0.05, 4, 18));
  }

  #chain(points, thick, ghost) {
    const seen = points.map((point) => this.#project(point)), last = seen.length - 1;
    for (let i = 0; i < last; i++) {
      const [a, b] = [seen[i], seen[i + 1]], width = thick * (1 - 0.55 * i / last) * (a[3] + b[3]) / 2;
      this.strokes.push({ depth: (a[2] + b[2]) / 2, paint: () => {
        if (ghost) { this.#stroke([a, b], this.colours.ghost, 3, [7, 7]); return; }
        this.#stroke([a, b], this.colours.page, width + 3);
        this.#stroke([a, b], this.colours.arm, width);
        const lit = [a, b].map(([x, y]) => [x - width * 0.14, y - width * 0.18]);
        this.#stroke(lit, this.colours["arm-light"], width * 0.28);
      } });
    }
    seen.forEach((at, i) => this.strokes.push({ depth: at[2] - 0.02, paint: () => {
      const radius = (i === last ? 0.3 : 0.62 - 0.3 * i / last) * thick * at[3];
      const { page, arm, warm, ghost: dashed } = this.colours;
      if (ghost) this.#dot(at, i === last ? 6 : 4, i === last ? dashed : page, dashed);
      else this.#dot(at, radius, i === last ? warm : page, arm, 2.5);
    } }));
  }

  #marks() {
    const { places, poses } = this.scene, { pen, colours } = this;
    for (const place of places) {
      if (!usable(place.position)) continue;
      const at = this.#project(place.position);
      const foot = this.#project([place.position[0], place.position[1], this.floor]);
      this.#stroke([at, foot], colours.line, 1, [2, 4]);
      this.strokes.push({ depth: at[2], paint: () => {
        const done = place.wanted && place.poses >= place.wanted, next = place.name === this.scene.next;
        this.#dot(at, 7, done ? colours.good : colours.page, next ? colours.ghost : colours.ink, next ? 4 : 2);
      } });
      this.labels.push(() => { // in front of everything
        const next = place.name === this.scene.next;
        Object.assign(pen, { font: "600 14px system-ui, 'DejaVu Sans', sans-serif", lineWidth: 4,
          strokeStyle: colours.page, fillStyle: next ? colours.ghost : colours.ink });
        const name = place.name.length > 24 ? `${place.name.slice(0, 23)}…` : place.name;
        pen.strokeText(name, at[0] + 12, at[1] - 9);
        pen.fillText(name, at[0] + 12, at[1] - 9);
      });
    }
    const colour = (pose) => (pose.outlier ? colours.bad : pose.excluded ? colours.soft : colours.warm);
    for (const pose of poses) {
      if (!usable(pose.tip)) continue;
      const from = this.#project(pose.tip);
      this.strokes.push({ depth: from[2] - 0.001, paint: () => this.#dot(from, 2, colour(pose)) });
      if (!usable(pose.residual)) continue;
      const size = Math.min(this.enlarged, 0.4 * this.extent / Math.hypot(...pose.residual)); // an outlier's has an end
      const to = pose.tip.map((value, i) => value + size * pose.residual[i]);
      this.#line([pose.tip, to], colour(pose), pose.outlier ? 3.5 : 2, pose.excluded ? [2, 3] : [], 0.001);
    }
  }

  // How much residuals are enlarged, so that the 90 % longest is about a twelfth of the picture.
  #enlarged() {
    const drawn = this.scene.poses.filter((pose) => usable(pose.residual) && !pose.outlier);
    // Few poses have residuals of almost nothing, which say less than those that are expected.
    const lengths = drawn.map((pose) => Math.max(Math.hypot(...pose.residual), pose.expected_mm || 0));
    lengths.sort((a, b) => a - b);
    const large = lengths[Math.floor(0.9 * (lengths.length - 1))];
    if (!(large > 1e-6 * this.extent)) return 1;
    const wanted = this.extent / 6 / large, power = 10 ** Math.floor(Math.log10(wanted));
    return Math.max(1, [5, 2, 1].find((digit) => digit * power <= wanted) * power);
  }
}
