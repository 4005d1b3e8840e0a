import { View } from "./view.js";

// Whatever comes from the session is data: it goes into textContent, never into markup.
const $ = (id) => document.getElementById(id);
const view = new View($("view"));
const token = location.hash.slice(1);
let state = null, here = null, chosen = null, sounds = null, loud = true, audio = null, finished = true;

const digits = (value, count = 3) => Number(value.toPrecision(count)).toString();
const known = (value) => typeof value === "number";
function length(mm) {
  if (!known(mm)) return "–";
  return Math.abs(mm) < 0.0995 ? `${digits(1000 * mm)} µm` : `${digits(mm)} mm`;
}
function put(node, text) {
  text = String(text ?? "");
  if (node.textContent !== text) node.textContent = text;
}
function element(name, text, className) {
  const node = document.createElement(name);
  if (text !== undefined) node.textContent = String(text ?? "");
  if (className) node.className = className;
  return node;
}

// --- Asking the session -------------------------------------------------------------------------------------------

async function ask(action, fields = {}) {
  put($("message"), "");
  try {
    const headers = { "Content-Type": "application/json", "X-Token": token };
    const answer = await fetch("do", { method: "POST", headers, body: JSON.stringify({ action, ...fields }) });
    if (!answer.ok) put($("message"), (await answer.json()).message);
  } catch {
    put($("message"), "The session does not answer; nothing was done.");
  }
}

async function openReport() {
  const tab = open("", "_blank"); // at once: later a browser would take it for an advertisement
  const answer = await fetch("ticket", { method: "POST", headers: { "X-Token": token } }).catch(() => null);
  const said = await answer?.json();
  if (answer?.ok && tab) tab.location.replace(said.path);
  else tab?.close();
  put($("message"), answer?.ok ? "" : said?.message ?? "The session does not answer.");
}

function choose(question, choices, answer) {
  const dialog = $("ask"), box = $("choices");
  if (dialog.open) return;
  put($("question"), question);
  $("answer").parentElement.hidden = answer === undefined;
  $("answer").value = answer ?? "";
  box.replaceChildren(...[...choices, ["Cancel", null]].map(([text, act], i) => {
    const button = element("button", text);
    button.type = i ? "button" : "submit"; // Enter in the text field does the first
    button.addEventListener("click", (event) => {
      event.preventDefault();
      dialog.close();
      act?.($("answer").value.trim());
    });
    return button;
  }));
  dialog.showModal();
  if (answer !== undefined) $("answer").select(); else box.firstChild.focus();
}

const actions = {
  take: () => ask("take"),
  undo: () => ask("undo"),
  skip: () => ask("skip"),
  exclude() {
    const pose = state?.poses.find((one) => one.number === chosen) ?? state?.poses.at(-1);
    if (pose) ask("exclude", { pose: pose.number, excluded: !pose.excluded });
  },
  mark: () => choose("What is different from now on?", [["Begin a new session", (text) => ask("mark", { text })]],
    "probe remounted"),
  auto: () => ask("auto", { on: !state?.auto }),
  sound() {
    loud = !loud;
    $("sound").setAttribute("aria-pressed", loud);
    if (loud) beep(false);
  },
  finish: () => choose("Write the capture, and calibrate the arm from it?", [
    ["Write and calibrate", () => ask("finish", { calibrate: true })],
    ["Write only", () => ask("finish", { calibrate: false })]]),
};
const keys = { " ": "take", u: "undo", x: "exclude", n: "skip", s: "mark", a: "auto", m: "sound", f: "finish" };

for (const [id, act] of Object.entries(actions)) {
  $(id).addEventListener("click", (event) => {
    if (event.detail) event.currentTarget.blur(); // or the next space would repeat it
    act();
  });
}
document.addEventListener("keydown", (event) => {
  audio ??= new AudioContext(); // a browser allows sound after a key or a click
  const inside = event.target.closest("input, dialog, button, summary");
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || $("ask").open) return;
  if (event.target.closest("input") || (event.key === " " && inside)) return;
  if (event.key === "ArrowUp" || event.key === "ArrowDown") {
    if (event.target.closest("canvas")) return;
    event.preventDefault();
    select(event.key === "ArrowUp" ? 1 : -1);
    return;
  }
  const action = keys[event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  actions[action]();
});
document.addEventListener("pointerdown", () => { audio ??= new AudioContext(); });
$("thermometer").addEventListener("submit", (event) => {
  event.preventDefault();
  const celsius = Number($("celsius").value.replace(",", ".").trim() || NaN);
  if (Number.isFinite(celsius)) { ask("temperature", { celsius }); $("celsius").blur(); }
  else put($("message"), "The temperature is not a number.");
});
for (const button of document.querySelectorAll("[data-view]")) {
  button.addEventListener("click", () => view.look(...button.dataset.view.split(" ").map(Number)));
}
$("report").addEventListener("click", openReport);
$("over").addEventListener("click", () => view.turnOver());

function select(step) {
  const numbers = (state?.poses ?? []).map((pose) => pose.number);
  if (!numbers.length) return;
  const at = numbers.indexOf(chosen);
  chosen = numbers[Math.max(0, Math.min(numbers.length - 1, at < 0 ? numbers.length - 1 : at + step))];
  poses();
  $("poses").querySelector('[aria-selected="true"]')?.scrollIntoView({ block: "nearest" });
}

function beep(low) {
  if (!loud || !audio) return;
  audio.resume();
  for (const [start, pitch] of low ? [[0, 330], [0.22, 247]] : [[0, 880]]) {
    const tone = audio.createOscillator(), volume = audio.createGain(), at = audio.currentTime + start;
    tone.frequency.value = pitch;
    volume.gain.setValueAtTime(0.0001, at);
    volume.gain.exponentialRampToValueAtTime(0.4, at + 0.01);
    volume.gain.exponentialRampToValueAtTime(0.0001, at + 0.18);
    tone.connect(volume).connect(audio.destination);
    tone.start(at);
    tone.stop(at + 0.2);
  }
}

// --- Showing it ---------------------------------------------------------------------------------------------------

function live(now) {
  if (!now) return;
  put($("stillness"), now.still ? `Still ${known(now.since) ? now.since.toFixed(1) : ""} s` : "Moving");
  $("now").classList.toggle("still", Boolean(now.still));
  [...$("joints").children].forEach((pair, i) => {
    const unit = { deg: "°" }[state?.arm.joints[i]?.unit] ?? ` ${state?.arm.joints[i]?.unit ?? ""}`;
    put(pair.children[1], known(now.q?.[i]) ? `${now.q[i].toFixed(3)}${unit}` : "–");
    const start = state?.next?.from?.[i];
    const next = known(start) ? `from ${start.toFixed(1)} to` : "next";
    put(pair.children[2], known(state?.next?.q?.[i]) ? `${next} ${state.next.q[i].toFixed(1)}${unit}` : "");
  });
  view.show({ links: now.links ?? [], tip: now.tip ?? null });
  put($("rate"), known(now.rate) ? `${digits(now.rate, 2)} readings a second` : "");
  if (now.place !== here) { here = now.place; if (state) places(); }
  const tip = now.tip?.map((value) => (known(value) ? value.toFixed(2) : "–"));
  put($("tip"), tip ? `Tip: ${tip.join(", ")} mm` : "");
  put($("legend"), [state?.next && "Dashed: next pose", state?.poses.some((pose) => pose.residual)
    && `thin lines: residuals, enlarged ${view.enlarged} times`].filter(Boolean).join("; "));
  const list = $("devices");
  while (list.children.length > (now.devices ?? []).length) list.lastChild.remove();
  (now.devices ?? []).forEach((device, i) => {
    const line = list.children[i] ?? list.appendChild(element("li"));
    if (!line.children.length) line.append(element("span"), " ", element("span", "", "text"));
    const bad = Object.entries(device.bad ?? {}).map(([reason, count]) => `, ${count} bad (${reason})`).join("");
    const there = device.connected ? "connected" : "not connected";
    put(line.children[0], `${device.name}: ${there}, ${device.lines} lines${bad}`);
    line.children[0].className = device.connected ? "" : "off";
    put(line.children[1], device.message);
  });
}

function poses() {
  const rows = [...state.poses].reverse().map((pose) => {
    const row = element("tr", undefined, pose.excluded ? "excluded" : pose.outlier ? "outlier" : "");
    const notes = [pose.outlier && "outlier", pose.excluded && "excluded",
      pose.session > 1 && `session ${pose.session}`];
    row.append(element("td", pose.number, "number"), element("td", pose.place),
      element("td", length(pose.residual_mm), "number"), element("td", length(pose.expected_mm), "number"),
      element("td", notes.filter(Boolean).join(", ")));
    row.setAttribute("aria-selected", pose.number === chosen);
    row.addEventListener("click", () => { chosen = chosen === pose.number ? null : pose.number; poses(); });
    return row;
  });
  $("poses").replaceChildren(...rows);
  const pose = state.poses.find((one) => one.number === chosen) ?? state.poses.at(-1);
  $("exclude").firstChild.textContent = pose?.excluded ? `Include ${pose.number} ` : `Exclude ${pose?.number ?? ""} `;
  for (const id of ["exclude", "undo"]) $(id).disabled = !pose;
}

function places() {
  $("places").replaceChildren(...state.places.map((place) => {
    const item = element("li"), button = element("button"), wanted = place.wanted || 0;
    button.type = "button";
    button.classList.toggle("here", place.name === here);
    button.classList.toggle("next", place.name === state.next?.place && place.name !== here);
    if (place.name === here) button.setAttribute("aria-current", "true");
    button.append(element("span", place.name));
    button.append(element("span", wanted ? `${place.poses} of ${wanted}` : `${place.poses}`));
    if (wanted) {
      const bar = element("progress", undefined, place.poses >= wanted ? "done" : "");
      [bar.max, bar.value] = [wanted, Math.min(place.poses, wanted)];
      bar.setAttribute("aria-label", `Poses in ${place.name}`);
      button.append(bar);
    }
    button.addEventListener("click", () => ask("place", { name: place.name }));
    item.append(button);
    return item;
  }));
}

function everything() {
  const { arm, progress = {}, next } = state;
  document.title = `${arm.name} – live capture`;
  put($("arm"), arm.name);
  put($("headline"), state.busy || state.headline);
  put($("why"), state.message || next?.why);
  put($("u-now"), length(progress.u_length_mm));
  put($("u-after"), length(progress.u_after_ten_mm));
  put($("u-target"), length(progress.u_target_mm));
  put($("count"), state.poses.filter((pose) => !pose.excluded).length);
  $("figures").classList.toggle("met", known(progress.u_length_mm) && progress.u_length_mm <= progress.u_target_mm);
  put($("limits"), progress.limits);
  $("auto").setAttribute("aria-pressed", Boolean(state.auto));
  if (document.activeElement !== $("celsius") && known(state.temperature)) $("celsius").value = state.temperature;
  if ($("joints").children.length !== arm.joints.length) {
    $("joints").replaceChildren(...arm.joints.map((one) => {
      const pair = element("div");
      pair.append(element("dt", one.name), element("dd", "–"), element("dd", "", "goal"));
      return pair;
    }));
  }
  places();
  poses();
  $("skip").disabled = !next;
  const said = { sentences: [...(state.says ?? []), ...(state.sentences ?? [])], paths: state.paths };
  for (const id of ["sentences", "paths"]) {
    $(id).replaceChildren(...(said[id] ?? []).map((text) => element("li", text)));
  }
  $("report").hidden = !state.paths?.at(-1)?.endsWith(".html");
  $("results").hidden = !said.sentences.length && !state.paths?.length;
  if (state.paths?.length && !finished) $("results").scrollIntoView({ block: "nearest" });
  finished = Boolean(state.paths?.length);
  view.show({ places: state.places, poses: state.poses, next: next?.place ?? null,
    ghost: next?.links?.length ? { links: next.links } : null });
}

function taken() {
  const last = state.poses.at(-1);
  if (sounds !== null && state.sound > sounds && last) {
    chosen = null;
    poses();
    beep(last.outlier);
    $("now").classList.remove("flash");
    requestAnimationFrame(() => $("now").classList.add("flash"));
  }
  sounds = state.sound;
  const bad = Boolean(last?.outlier && !last.excluded);
  put($("taken"), last ? `Pose ${last.number}: ${bad ? "outlier, " : ""}${length(last.residual_mm)}` : "");
  $("taken").classList.toggle("outlier", bad);
  $("now").classList.toggle("outlier", bad);
}

function connected(text) {
  document.body.classList.toggle("lost", Boolean(text));
  put($("connection"), text || "Connected");
}

// --- Listening ----------------------------------------------------------------------------------------------------

async function listen(signal) {
  const answer = await fetch("stream", { headers: { "X-Token": token }, signal });
  if (!answer.ok) throw new Error((await answer.json()).message);
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    let timer;
    const late = new Promise((_, fail) => { timer = setTimeout(() => fail(new Error("")), 5000); });
    const { done, value } = await Promise.race([reader.read(), late]).finally(() => clearTimeout(timer));
    if (done) return;
    const lines = (rest + value).split("\n");
    rest = lines.pop();
    for (const line of lines) {
      const news = JSON.parse(line);
      connected("");
      if (news.arm) { state = news; everything(); taken(); }
      live(news.live);
    }
    document.body.dataset.ready = "yes";
  }
}

for (let wait = 500; ; wait = Math.min(3000, wait * 1.5)) {
  let reason = "";
  const ending = new AbortController();
  try {
    await listen(ending.signal);
    wait = 500;
  } catch (error) {
    reason = error instanceof TypeError ? "" : error.message; // TypeError: nobody listens there
  }
  ending.abort();
  connected(reason || "No connection to the session; trying again");
  await new Promise((resolve) => setTimeout(resolve, wait));
}
