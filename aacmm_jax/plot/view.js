// The arm in three dimensions: a few hundred strokes, sorted by depth, drawn with a pen. Live captures use a canvas,
// reports SVG, which prints and follows the colours of the page. Neither needs WebGL, which a computer in a
// laboratory or at the end of a remote desktop may lack, and all of it is a hundredth of a library's weight.

const usable = (point) => point?.length === 3 && point.every(Number.isFinite);
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

// Colours are named as the page's style names them. Both pens draw lines, dots, areas and words in pixels.
class CanvasPen {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.colours = {}; });
    this.colours = {};
  }

  #colour(name) {
    this.style ??= getComputedStyle(document.documentElement);
    return (this.colours[name] ??= this.style.getPropertyValue(`--${name}`).trim());
  }

  begin(width, height) {
    const ratio = window.devicePixelRatio || 1, canvas = this.canvas;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, width, height);
  }

  #path(points) {
    this.context.beginPath();
    points.forEach(([x, y], i) => (i ? this.context.lineTo(x, y) : this.context.moveTo(x, y)));
  }

  line(points, colour, width, dash = []) {
    this.#path(points);
    Object.assign(this.context, { strokeStyle: this.#colour(colour), lineWidth: width, lineCap: "round",
      lineJoin: "round" });
    this.context.setLineDash(dash);
    this.context.stroke();
    this.context.setLineDash([]);
  }

  area(points, colour) {
    this.#path(points);
    Object.assign(this.context, { fillStyle: this.#colour(colour), globalAlpha: 0.3 });
    this.context.fill();
    this.context.globalAlpha = 1;
  }

  dot([x, y], radius, fill, edge, width = 2) {
    this.context.beginPath();
    this.context.arc(x, y, radius, 0, 2 * Math.PI);
    if (fill) { this.context.fillStyle = this.#colour(fill); this.context.fill(); }
    if (!edge) return;
    Object.assign(this.context, { strokeStyle: this.#colour(edge), lineWidth: width });
    this.context.stroke();
  }

  words(text, x, y, colour) {
    Object.assign(this.context, { font: FONT, lineWidth: 4, strokeStyle: this.#colour("page"),
      fillStyle: this.#colour(colour) });
    this.context.strokeText(text, x, y);
    this.context.fillText(text, x, y);
  }

  width(text) {
    this.context.font = FONT;
    return this.context.measureText(text).width;
  }

  end() {}
}

const FONT = "600 13px system-ui, 'DejaVu Sans', sans-serif";
const FLAT = 1.5708;

export class View {
  // On a canvas, or with another pen in any other element.
  constructor(element, pen) {
    this.element = element;
    this.pen = pen ?? new CanvasPen(element);
    this.turn = -0.9;
    this.tilt = 0.4;
    this.zoom = 1;
    this.low = [-1, -1, 0];
    this.high = [1, 1, 1];
    this.over = null; // whether the first axis points down, so that the picture is turned over
    this.frames = 0;
    this.scene = { places: [], poses: [], links: [], tip: null, ghost: null, others: [], things: [] };
    new ResizeObserver(() => this.draw()).observe(element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
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
    Object.assign(this.element.dataset, { turn: this.turn.toFixed(3), tilt: this.tilt.toFixed(3) });
    if (this.pen.immediate) { this.#paint(); return; }
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.#paint(); });
  }

  // By a key or a button: left, right, up, down, larger, smaller.
  move(what) {
    const turned = { left: -0.15, right: 0.15 }[what] ?? 0, tilted = { up: 0.1, down: -0.1 }[what] ?? 0;
    const grown = { larger: 1.15, smaller: 1 / 1.15 }[what] ?? 1;
    this.turn += turned;
    this.tilt = clamp(this.tilt + tilted, -FLAT, FLAT);
    this.zoom = clamp(this.zoom * grown, 0.3, 12);
    this.draw();
  }

  #listen() {
    const canvas = this.element, fingers = new Map();
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
        this.tilt = clamp(this.tilt + (event.clientY - before.clientY) * 0.008, -FLAT, FLAT);
      }
      fingers.set(event.pointerId, event);
      this.draw();
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      if (this.pen.immediate && !event.ctrlKey) return; // a report is scrolled
      event.preventDefault();
      this.zoom = clamp(this.zoom * Math.exp(-event.deltaY * 0.0015), 0.3, 12);
      this.draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const keys = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "larger",
        "=": "larger", "-": "smaller" };
      if (!keys[event.key]) return;
      event.preventDefault();
      this.move(keys[event.key]);
    });
  }

  // A box about all that was ever shown: it grows, so that the picture does not jump.
  #enclose() {
    const { places, poses, links, ghost, others, things } = this.scene;
    const known = [...places.map((place) => place.position), ...poses.map((pose) => pose.tip), ...others.flat(),
      ...things.flatMap((thing) => thing.points)];
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
    [this.width, this.height] = [this.element.clientWidth, this.element.clientHeight];
    if (!this.width) return;
    this.pen.begin(this.width, this.height);
    this.#enclose();
    this.scale = 1.12 * this.zoom * Math.min(this.width, this.height) / 2;
    [this.strokes, this.labels] = [[], []];
    this.enlarged = this.#enlarged();
    this.#floor();
    this.#base();
    this.#things();
    this.#marks();
    for (const other of this.scene.others) {
      const seen = other.map((point) => this.#project(point));
      this.strokes.push({ depth: 9, paint: () => this.pen.line(seen, "line", 1) });
    }
    const { links, ghost, tip } = this.scene, short = Math.min(this.width, this.height);
    const thick = clamp(short * 0.03, 7, 22) * this.zoom ** 0.5;
    if (ghost) {
      this.#chain(ghost.links, thick, true);
      if (tip) this.#line([tip, ghost.links.at(-1)], "ghost", 2, [3, 6]);
    }
    this.#chain(links, thick, false);
    this.strokes.sort((a, b) => b.depth - a.depth).forEach((stroke) => stroke.paint());
    this.#label();
    this.pen.end();
    this.frames += 1;
    this.element.dataset.frames = this.frames;
  }

  #line(points, colour, width, dash = [], lift = 0) {
    const [a, b] = points.map((point) => this.#project(point));
    this.strokes.push({ depth: (a[2] + b[2]) / 2 - lift, paint: () => this.pen.line([a, b], colour, width, dash) });
  }

  // The floor below everything, with a line every 100, 200 or 500 mm and so on, and the shadow of the arm.
  #floor() {
    const z = this.floor, size = 10 ** Math.floor(Math.log10(this.extent));
    const step = [0.1, 0.2, 0.5, 1].map((part) => part * size).find((s) => this.extent / s < 7) ?? size;
    const from = this.low.map((low) => Math.floor(low / step - 0.5) * step);
    const to = this.high.map((high) => Math.ceil(high / step + 0.5) * step);
    const put = (a, b) => this.pen.line([this.#project(a), this.#project(b)], "faint", 1);
    for (let x = from[0]; x <= to[0] + step / 2; x += step) put([x, from[1], z], [x, to[1], z]);
    for (let y = from[1]; y <= to[1] + step / 2; y += step) put([from[0], y, z], [to[0], y, z]);
    const shadow = this.scene.links.map(([x, y]) => this.#project([x, y, z]));
    if (shadow.length > 1) this.pen.line(shadow, "floor", clamp(this.scale * 0.05, 4, 18));
  }

  // The axes of the base frame.
  #base() {
    for (const [axis, name] of ["x", "y", "z"].entries()) {
      const end = [0, 1, 2].map((i) => (i === axis ? 0.3 * this.extent : 0));
      this.#line([[0, 0, 0], end], "soft", 1.5, [5, 3]);
      const [x, y] = this.#project(end.map((value) => 1.13 * value));
      this.strokes.push({ depth: 0, paint: () => this.pen.words(name, x - 4, y + 4, "soft") });
    }
  }

  // What else stands there: bars, plates and targets, balls, and the lines of sight of cameras.
  #things() {
    for (const { kind, points, radius = 0, name, faint } of this.scene.things) {
      const seen = points.map((point) => this.#project(point));
      const depth = seen.reduce((sum, point) => sum + point[2], 0) / seen.length;
      const middle = [0, 1].map((i) => seen.reduce((sum, point) => sum + point[i], 0) / seen.length);
      const size = Math.max(3, radius * this.scale / this.extent * seen[0][3]);
      this.strokes.push({ depth, paint: () => {
        if (faint) this.pen.line(seen, "soft", 1.2);
        else if (kind === "bar") {
          this.pen.line(seen, "page", 9);
          this.pen.line(seen, "thing", 6);
          this.pen.line(seen, "page", 1);
        } else if (kind === "plate") {
          this.pen.area(seen, "thing");
          this.pen.line([...seen, seen[0]], "thing", 1.5);
        } else if (kind === "ball") this.pen.dot(seen[0], size, "thing", "page", 1.5);
        else this.pen.line(seen, "warm", 1.8);
      } });
      if (name) this.labels.push({ name, at: middle, colour: "thing" });
    }
  }

  #chain(points, thick, ghost) {
    const seen = points.map((point) => this.#project(point)), last = seen.length - 1;
    for (let i = 0; i < last; i++) {
      const [a, b] = [seen[i], seen[i + 1]], width = thick * (1 - 0.55 * i / last) * (a[3] + b[3]) / 2;
      this.strokes.push({ depth: (a[2] + b[2]) / 2, paint: () => {
        if (ghost) { this.pen.line([a, b], "ghost", 3, [7, 7]); return; }
        this.pen.line([a, b], "page", width + 3);
        this.pen.line([a, b], "arm", width);
        const lit = [a, b].map(([x, y]) => [x - width * 0.14, y - width * 0.18]);
        this.pen.line(lit, "arm-light", width * 0.28);
      } });
    }
    seen.forEach((at, i) => this.strokes.push({ depth: at[2] - 0.02, paint: () => {
      const radius = (i === last ? 0.3 : 0.62 - 0.3 * i / last) * thick * at[3];
      if (ghost) this.pen.dot(at, i === last ? 6 : 4, i === last ? "ghost" : "page", "ghost");
      else this.pen.dot(at, radius, i === last ? "warm" : "page", "arm", 2.5);
    } }));
  }

  #marks() {
    const { places, poses } = this.scene, { pen } = this;
    for (const place of places) {
      if (!usable(place.position)) continue;
      const at = this.#project(place.position);
      if (place.faint) {
        this.strokes.push({ depth: at[2], paint: () => pen.dot(at, 2.5, "page", "soft", 1.2) });
        continue;
      }
      const foot = this.#project([place.position[0], place.position[1], this.floor]);
      pen.line([at, foot], "line", 1, [2, 4]);
      this.strokes.push({ depth: at[2], paint: () => {
        const done = place.wanted && place.poses >= place.wanted, next = place.name === this.scene.next;
        pen.dot(at, 7, done ? "good" : "page", next ? "ghost" : "ink", next ? 4 : 2);
      } });
      this.labels.push({ name: place.name, at, colour: place.name === this.scene.next ? "ghost" : "ink" });
    }
    const colour = (pose) => (pose.shade !== undefined ? `v${pose.shade}`
      : pose.outlier ? "bad" : pose.excluded ? "soft" : "warm");
    for (const pose of poses) {
      if (!usable(pose.tip)) continue;
      const from = this.#project(pose.tip);
      const radius = 2 + 0.5 * (pose.shade ?? 0);
      this.strokes.push({ depth: from[2] - 0.001, paint: () => pen.dot(from, radius, colour(pose)) });
      if (!usable(pose.residual)) continue;
      const size = Math.min(this.enlarged, 0.4 * this.extent / Math.hypot(...pose.residual)); // an outlier's has an end
      const to = pose.tip.map((value, i) => value + size * pose.residual[i]);
      this.#line([pose.tip, to], colour(pose), pose.outlier ? 3.5 : 2, pose.excluded ? [2, 3] : [], 0.001);
    }
  }

  // Names in front of everything, from the top down, each in the first free place around its mark; a name without a
  // place is left out, its mark is not.
  #label() {
    const line = 16, labels = [...this.labels].sort((one, other) => one.at[1] - other.at[1]);
    const taken = labels.map(({ at: [x, y] }) => [x - 7, y - 7, x + 7, y + 7]);
    const free = (box) => box[0] >= 2 && box[1] >= 2 && box[2] <= this.width - 2 && box[3] <= this.height - 2 &&
      !taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3]);
    for (const { name, at: [x, y], colour } of labels) {
      const text = name.length > 24 ? `${name.slice(0, 23)}…` : name, wide = this.pen.width(text) + 4, places = [];
      for (const far of [0, 1, 2, 3, 4, 5, 6]) {
        for (const [left, way] of [[x + 9, -1], [x + 9, 1], [x - 9 - wide, -1], [x - 9 - wide, 1]]) {
          const middle = y + way * (far ? 6 + far * line : 0);
          places.push([left, middle - line / 2, left + wide, middle + line / 2]);
        }
      }
      const box = places.find(free);
      if (!box) continue;
      taken.push(box);
      const near = box[0] > x ? box[0] : box[2], middle = (box[1] + box[3]) / 2;
      if (Math.abs(middle - y) > line) this.pen.line([[x, y], [near, middle]], colour, 0.7);
      this.pen.words(text, box[0] + 2, box[3] - 4, colour);
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
