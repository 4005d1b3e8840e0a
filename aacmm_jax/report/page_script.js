"use strict";
(() => {
  const parsed = (id) => JSON.parse(document.getElementById(id).textContent);

  // Charts: drawn by Plotly, and again as a picture of fixed width for paper.
  const charts = parsed("charts");
  const narrow = () => document.documentElement.clientWidth < 600;
  async function draw(container) {
    const { data, layout } = charts[container.dataset.chart];
    const config = { responsive: true, displaylogo: false, displayModeBar: narrow() ? false : "hover",
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };
    const size = narrow() ? 11 : 13;
    await Plotly.newPlot(container, data, { ...layout, autosize: true, font: { ...layout.font, size } }, config);
    const height = Math.round(container.clientHeight);
    const image = { format: "svg", width: 700, height };
    const url = await Plotly.toImage({ data, layout: { ...layout, autosize: false } }, image);
    const picture = new Image();
    picture.className = "paper";
    picture.alt = container.getAttribute("aria-label");
    picture.src = url;
    container.append(picture);
    await picture.decode().catch(() => {});
    container.dataset.drawn = "yes";
  }

  // Lists of files and the tables of parts are collapsed on the screen and open on paper.
  const folded = () => [...document.querySelectorAll(".origin details:not([open]), details[data-print]:not([open])")];
  let opened = [];
  window.addEventListener("beforeprint", () => { opened = folded(); for (const one of opened) one.open = true; });
  window.addEventListener("afterprint", () => { for (const one of opened) one.open = false; });

  // Tables: a click on a heading sorts by its column, a second click in reverse.
  for (const button of document.querySelectorAll("button.sort")) {
    button.addEventListener("click", () => {
      const heading = button.closest("th"), row = heading.parentElement, table = heading.closest("table");
      const column = [...row.children].indexOf(heading);
      const down = heading.getAttribute("aria-sort") === "ascending";
      for (const other of row.children) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (line) => {
        const cell = line.children[column];
        return cell.dataset.value === undefined ? null : Number(cell.dataset.value);
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
    const { marks, from, poses, reach } = parsed("scenes")[container.dataset.scene];
    const view = { turn: -0.9, tilt: 0.45, size: 1, pose: 0 };
    const svg = document.createElementNS(SVG, "svg");
    container.append(svg);
    const all = [[0, 0, 0], ...marks.map((mark) => mark.at), ...poses.flatMap((p) => p.points)];
    const middle = [0, 1, 2].map((i) => (Math.min(...all.map((p) => p[i])) + Math.max(...all.map((p) => p[i]))) / 2);
    const extent = Math.max(...all.map((p) => Math.hypot(...p.map((x, i) => x - middle[i]))), 1);
    const shadows = poses.filter((_, i) => i % Math.max(1, Math.ceil(poses.length / 24)) === 0);

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
        add("polyline", { points: path(ring), fill: "none", stroke: "#d5dae0", "stroke-width": 1 });
      }
      for (const [axis, name] of [[[1, 0, 0], "x"], [[0, 1, 0], "y"], [[0, 0, 1], "z"]]) {
        const end = axis.map((v) => v * 0.3 * reach);
        const points = path([[0, 0, 0], end]);
        add("polyline", { points, stroke: "#333", "stroke-width": 1.5, "stroke-dasharray": "5 3" });
        const [x, y] = project(axis.map((v) => v * 0.34 * reach));
        add("text", { x, y, "font-size": 13, "font-style": "italic", "text-anchor": "middle" }, name);
      }
      for (const pose of shadows) {
        add("polyline", { points: path(pose.points), fill: "none", stroke: "#9aa3ad", "stroke-width": 1,
          "stroke-opacity": 0.55, "stroke-linejoin": "round" });
      }
      const now = poses[view.pose];
      add("polyline", { points: path(now.points), fill: "none", stroke: "#1b3a6b", "stroke-width": 5,
        "stroke-linejoin": "round", "stroke-linecap": "round" });
      for (const point of now.points) {
        const [cx, cy] = project(point);
        add("circle", { cx, cy, r: 4, fill: "#fff", stroke: "#1b3a6b", "stroke-width": 2 });
      }
      // From the lowest mark upwards: a label that would cover an earlier one moves up and is joined to its mark.
      const labelled = marks.length <= 30, labels = [], line = 15;
      const projected = marks.map(({ name, at }) => [name, ...project(at)]).sort((one, other) => other[2] - one[2]);
      for (const [name, x, y] of projected) {
        add("path", { d: `M${x - 6},${y}h12M${x},${y - 6}v12`, stroke: "#c8560a", "stroke-width": 2.5 });
        if (!labelled) continue;
        const style = { "font-size": 13, fill: "#7a3400", stroke: "#fff", "stroke-width": 3, "paint-order": "stroke" };
        const text = add("text", { x: x + 9, y: y - 7, ...style }, name);
        const left = x + 9, right = left + text.getComputedTextLength();
        let height = y - 7;
        const covers = (label) => Math.abs(label.height - height) < line && label.left < right && left < label.right;
        while (labels.some(covers)) height -= line;
        labels.push({ left, right, height });
        text.setAttribute("y", height);
        if (height < y - 7) add("path", { d: `M${x},${y}L${left},${height}`, stroke: "#7a3400", "stroke-width": 0.7 });
      }
      container.dataset.turn = view.turn.toFixed(3);
      container.dataset.tilt = view.tilt.toFixed(3);
      container.dataset.drawn = "yes";
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
  (async () => {
    for (const container of document.querySelectorAll("[data-chart]")) await draw(container);
    document.body.dataset.ready = "yes";
  })();
})();
