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

  // The tables of parts are collapsed on the screen and open on paper.
  const folded = () => [...document.querySelectorAll("details[data-print]:not([open])")];
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

  // The arm: drawn by the engine that the live page uses.
  class SvgPen {
    constructor(container) {
      this.immediate = true; // so that what is printed is drawn before
      container.insertAdjacentHTML("beforeend", '<svg aria-hidden="true"></svg>');
      this.svg = container.lastElementChild;
      this.measure = document.createElement("canvas").getContext("2d");
      this.measure.font = FONT;
    }

    begin(width, height) {
      this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      this.parts = [];
    }

    #draw(name, attributes, style, text = "") {
      const given = Object.entries(attributes).map(([key, value]) => `${key}="${value}"`).join(" ");
      this.parts.push(`<${name} ${given} style="${style}">${text}</${name}>`);
    }

    #points(points) {
      return points.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join(" ");
    }

    line(points, colour, width, dash = []) {
      const style = `fill:none;stroke:var(--${colour});stroke-width:${width.toFixed(1)};stroke-linecap:round;`
        + "stroke-linejoin:round" + (dash.length ? `;stroke-dasharray:${dash}` : "");
      this.#draw("polyline", { points: this.#points(points) }, style);
    }

    area(points, colour) {
      this.#draw("polygon", { points: this.#points(points) }, `fill:var(--${colour});fill-opacity:0.3`);
    }

    dot([x, y], radius, fill, edge, width = 2) {
      const stroke = edge ? `;stroke:var(--${edge});stroke-width:${width}` : "";
      this.#draw("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: radius.toFixed(1) },
        `fill:${fill ? `var(--${fill})` : "none"}${stroke}`);
    }

    words(text, x, y, colour) {
      const escaped = text.replace(/[&<>"]/g, (sign) => `&#${sign.charCodeAt(0)};`);
      this.#draw("text", { x: x.toFixed(1), y: y.toFixed(1) }, `font:${FONT};fill:var(--${colour});`
        + "stroke:var(--page);stroke-width:4;paint-order:stroke;stroke-linejoin:round", escaped);
    }

    width(text) {
      return this.measure.measureText(text).width;
    }

    end() {
      this.svg.innerHTML = this.parts.join("");
    }
  }

  function scene(container) {
    const { marks, things, from, poses } = parsed("scenes")[container.dataset.scene];
    const view = new View(container, new SvgPen(container)), figure = container.closest("figure");
    const slider = figure.querySelector("input"), output = figure.querySelector("output");
    // Of many bars, only that of the selected pose stands out, and other poses are not drawn.
    const ends = new Set(things.flatMap((thing) => thing.ends ?? []));
    // Not every so many: the chains of a robot may take turns.
    const others = poses.filter((_, i) => !ends.size && (0.618034 * i) % 1 < 24 / poses.length)
      .map((pose) => pose.points);
    for (const button of figure.querySelectorAll("button[data-do]")) {
      button.addEventListener("click", () => view.move(button.dataset.do));
    }
    slider.max = poses.length;
    const choose = () => {
      const pose = poses[Number(slider.value) - 1];
      const distance = pose.distance === undefined ? "" : pose.distance === null ? ": the only pose of its socket"
        : `: ${pose.distance.toPrecision(3)} mm from its ${from}`;
      output.textContent = pose.label + distance;
      const carried = pose.carried.length ? [{ kind: "sight", points: pose.carried }] : [];
      const here = things.find((thing) => thing.ends?.includes(pose.mark))?.ends ?? [];
      const faint = (name) => ends.has(name) && !here.includes(name);
      view.show({
        links: pose.points,
        places: marks.map(({ name, at }) => ({ name, position: at, faint: faint(name) })),
        things: [...things.map((thing) => ({ ...thing, faint: faint(thing.ends?.[0]) })), ...carried],
      });
    };
    view.scene.others = others;
    view.scene.poses = poses.map((pose) => ({ tip: pose.points.at(-1), residual: pose.residual, shade: pose.shade }));
    slider.addEventListener("input", choose);
    choose();
    const enlarged = figure.querySelector("[data-enlarged]");
    if (enlarged) enlarged.textContent = view.enlarged;
    container.dataset.drawn = "yes";
    for (const when of ["beforeprint", "afterprint"]) window.addEventListener(when, () => view.draw());
  }

  for (const container of document.querySelectorAll("[data-scene]")) scene(container);
  document.body.dataset.ready = "yes";
})();
