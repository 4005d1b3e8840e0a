"use strict";
(() => {
  const parsed = (id) => JSON.parse(document.getElementById(id).textContent);

  // What is said of the mark nearest to the pointer: positions are in thousandths of the axes.
  const points = parsed("points"), near = 24; // pixels
  const tip = document.createElement("div"), ring = document.createElement("div");
  tip.className = "tip";
  ring.className = "ring";
  for (const one of [tip, ring]) one.setAttribute("aria-hidden", "true");
  const hide = () => { tip.remove(); ring.remove(); };
  for (const container of document.querySelectorAll("[data-chart]")) {
    container.querySelectorAll(".axes").forEach((axes, number) => {
      const known = points[container.dataset.chart][number], svg = axes.querySelector("svg");
      if (!known.length) return;
      function show(event) {
        const box = svg.getBoundingClientRect(), outer = axes.getBoundingClientRect();
        const x = event.clientX - box.left, y = event.clientY - box.top;
        let best = null, least = near;
        for (const [a, b, words] of known) {
          const distance = Math.hypot((a / 1000) * box.width - x, (b / 1000) * box.height - y);
          if (distance < least) [best, least] = [[a, b, words], distance];
        }
        if (!best) { hide(); return; }
        const left = box.left - outer.left + (best[0] / 1000) * box.width;
        const top = box.top - outer.top + (best[1] / 1000) * box.height;
        tip.textContent = best[2];
        axes.append(ring, tip);
        Object.assign(ring.style, { left: `${left}px`, top: `${top}px` });
        const most = outer.width - tip.offsetWidth;
        tip.style.left = `${Math.max(0, Math.min(left + 10, most))}px`;
        tip.style.top = `${top > tip.offsetHeight + 14 ? top - tip.offsetHeight - 10 : top + 14}px`;
      }
      axes.addEventListener("pointermove", show);
      axes.addEventListener("pointerdown", show);
      axes.addEventListener("pointerleave", hide);
    });
  }

  // Lists of files and the tables of parts are collapsed on the screen and open on paper.
  const folded = () => [...document.querySelectorAll(".origin details:not([open]), details[data-print]:not([open])")];
  let opened = [];
  window.addEventListener("beforeprint", () => { opened = folded(); for (const one of opened) one.open = true; });
  window.addEventListener("afterprint", () => { for (const one of opened) one.open = false; });

  // A table that is scrolled is a Tab stop; its headings are one more, and the arrow keys go from one to the next.
  const scrolled = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      const over = target.scrollWidth > target.clientWidth + 1 || target.scrollHeight > target.clientHeight + 1;
      if (over) target.tabIndex = 0; else target.removeAttribute("tabindex");
    }
  });
  for (const region of document.querySelectorAll(".wide")) scrolled.observe(region);
  for (const heading of document.querySelectorAll("thead")) {
    const buttons = [...heading.querySelectorAll("button.sort")];
    buttons.forEach((button, i) => {
      button.tabIndex = i ? -1 : 0;
      button.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        const next = step && buttons[i + step];
        if (!next) return;
        event.preventDefault();
        button.tabIndex = -1;
        next.tabIndex = 0;
        next.focus();
      });
    });
  }

  // Tables: a click on a heading sorts by its column, a second click in reverse.
  for (const button of document.querySelectorAll("button.sort")) {
    button.addEventListener("click", () => {
      const heading = button.closest("th"), row = heading.parentElement, table = heading.closest("table");
      const column = [...row.children].indexOf(heading);
      const down = heading.getAttribute("aria-sort") === "ascending";
      for (const other of row.children) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (line) => {
        const number = parseFloat(line.children[column].textContent.replaceAll("−", "-"));
        return heading.classList.contains("number") && !Number.isNaN(number) ? number : null;
      };
      const body = table.tBodies[0], lines = [...body.rows];
      lines.sort((one, other) => {
        const a = key(one), b = key(other);
        if (a !== null && b !== null) return down ? b - a : a - b;
        if (a !== null || b !== null) return a === null ? 1 : -1; // rows without a number come last
        const [first, second] = [one, other].map((line) => line.children[column].textContent);
        const order = first.localeCompare(second, "en", { numeric: true });
        return down ? -order : order;
      });
      body.append(...lines);
    });
  }

  // The arm: lines in space, rotated about the vertical and tilted, as SVG, which prints and scales.
  const SVG = "http://www.w3.org/2000/svg";
  function scene(container) {
    const { marks, lines, from, poses, reach } = parsed("scenes")[container.dataset.scene];
    const view = { turn: -0.9, tilt: 0.45, size: 1, pose: 0 };
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", container.getAttribute("aria-label"));
    container.append(svg);
    const all = [[0, 0, 0], ...marks.map((mark) => mark.at), ...lines.flat(),
      ...poses.flatMap((p) => [...p.points, ...p.carried])];
    const middle = [0, 1, 2].map((i) => (Math.min(...all.map((p) => p[i])) + Math.max(...all.map((p) => p[i]))) / 2);
    const extent = Math.max(...all.map((p) => Math.hypot(...p.map((x, i) => x - middle[i]))), 1);
    // Not every so many: the chains of a robot may take turns.
    const shadows = poses.filter((_, i) => (0.618034 * i) % 1 < 24 / poses.length);

    function add(name, attributes, text) {
      const node = document.createElementNS(SVG, name);
      for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
      if (text !== undefined) node.textContent = text;
      svg.append(node);
      return node;
    }
    function project(point) {
      const [x, y, z] = point.map((value, i) => value - middle[i]);
      const c = Math.cos(view.turn), s = Math.sin(view.turn), ct = Math.cos(view.tilt), st = Math.sin(view.tilt);
      const across = c * x - s * y, away = s * x + c * y;
      const width = container.clientWidth || 640, height = container.clientHeight || 480;
      const scale = (view.size * 0.48 * Math.min(width, height)) / extent;
      return [width / 2 + scale * across, height / 2 - scale * (ct * z + st * away), ct * away - st * z];
    }
    const path = (points) => points.map((p) => project(p).slice(0, 2).map((x) => x.toFixed(1)).join(",")).join(" ");
    function render() {
      const width = container.clientWidth || 640, height = container.clientHeight || 480;
      svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      svg.replaceChildren();
      // The base plane: circles about the first axis at fractions of the reach, and the axes of the base.
      for (const fraction of [0.25, 0.5, 0.75, 1]) {
        const angles = Array.from({ length: 73 }, (_, i) => (i * Math.PI) / 36);
        const ring = angles.map((angle) => [fraction * reach * Math.cos(angle), fraction * reach * Math.sin(angle), 0]);
        add("polyline", { points: path(ring), class: "ring-line" });
      }
      for (const [axis, name] of [[[1, 0, 0], "x"], [[0, 1, 0], "y"], [[0, 0, 1], "z"]]) {
        const end = axis.map((v) => v * 0.3 * reach);
        const points = path([[0, 0, 0], end]);
        add("polyline", { points, class: "base-axis" });
        const [x, y] = project(axis.map((v) => v * 0.34 * reach));
        add("text", { x, y, class: "base-name" }, name);
      }
      for (const pose of shadows) {
        add("polyline", { points: path(pose.points), class: "other-pose" });
        add("polyline", { points: path(pose.carried), class: "other-pose" });
      }
      for (const line of lines) add("polyline", { points: path(line), class: "instrument" });
      const now = poses[view.pose];
      add("polyline", { points: path(now.points), class: "this-pose" });
      add("polyline", { points: path(now.carried), class: "instrument" });
      for (const point of now.points) {
        const [cx, cy] = project(point);
        add("circle", { cx, cy, r: 4, class: "joint" });
      }
      label(marks.map(({ name, at }) => [name, ...project(at)]), width, height);
      container.dataset.turn = view.turn.toFixed(3);
      container.dataset.tilt = view.tilt.toFixed(3);
      container.dataset.drawn = "yes";
    }
    // Names beside their marks, from the top down, each in the first free place around its mark;
    // where there is none, the mark has no name but is drawn.
    function label(projected, width, height) {
      const taken = projected.map(([, x, y]) => [x - 7, y - 7, x + 7, y + 7]), line = 16;
      const free = (box) => box[0] >= 2 && box[1] >= 2 && box[2] <= width - 2 && box[3] <= height - 2 &&
        !taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3]);
      for (const [name, x, y] of [...projected].sort((one, other) => one[2] - other[2])) {
        add("path", { d: `M${x - 6},${y}h12M${x},${y - 6}v12`, class: "mark" });
        const text = add("text", { x, y, class: "mark-name" }, name), wide = text.getComputedTextLength() + 4;
        const places = [];
        for (const far of [0, 1, 2, 3, 4, 5, 6]) {
          for (const side of [1, -1]) {
            for (const way of [-1, 1]) {
              const left = side > 0 ? x + 9 : x - 9 - wide, middle = y + way * (far ? 6 + far * line : 0);
              places.push([left, middle - line / 2, left + wide, middle + line / 2]);
            }
          }
        }
        const box = places.find(free);
        if (!box) { text.remove(); continue; }
        taken.push(box);
        text.setAttribute("x", box[0] + 2);
        text.setAttribute("y", box[3] - 4);
        const near = box[0] > x ? box[0] : box[2], middle = (box[1] + box[3]) / 2;
        if (Math.abs(middle - y) > line) add("path", { d: `M${x},${y}L${near},${middle}`, class: "leader" });
      }
    }
    function change(what) {
      if (what === "left") view.turn -= 0.15;
      if (what === "right") view.turn += 0.15;
      if (what === "up") view.tilt = Math.min(view.tilt + 0.1, Math.PI / 2);
      if (what === "down") view.tilt = Math.max(view.tilt - 0.1, -0.3);
      if (what === "larger") view.size = Math.min(view.size * 1.15, 6);
      if (what === "smaller") view.size = Math.max(view.size / 1.15, 0.4);
      render();
    }
    const keys = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down",
      "+": "larger", "=": "larger", "-": "smaller" };
    container.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      change(keys[event.key]);
    });
    let last = null;
    container.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY];
      container.setPointerCapture(event.pointerId);
    });
    container.addEventListener("pointermove", (event) => {
      if (!last) return;
      view.turn += (event.clientX - last[0]) * 0.008;
      view.tilt = Math.min(Math.max(view.tilt + (event.clientY - last[1]) * 0.008, -0.3), Math.PI / 2);
      last = [event.clientX, event.clientY];
      render();
    });
    for (const end of ["pointerup", "pointercancel"]) container.addEventListener(end, () => { last = null; });
    const figure = container.closest("figure");
    const slider = figure.querySelector("input"), output = figure.querySelector("output");
    for (const button of figure.querySelectorAll("button[data-do]")) {
      button.addEventListener("click", () => change(button.dataset.do));
    }
    slider.max = poses.length;
    const choose = () => {
      view.pose = Number(slider.value) - 1;
      const pose = poses[view.pose];
      const distance = pose.distance === null
        ? "the only pose of its socket" : `${pose.distance.toPrecision(3)} mm from its ${from}`;
      output.textContent = `${pose.label}: ${distance}`;
      render();
    };
    slider.addEventListener("input", choose);
    choose();
    new ResizeObserver(render).observe(container);
    for (const when of ["beforeprint", "afterprint"]) window.addEventListener(when, render);
  }

  for (const container of document.querySelectorAll("[data-scene]")) scene(container);
  document.body.dataset.ready = "yes";
})();
