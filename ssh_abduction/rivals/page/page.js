"use strict";
// The page of rival maps. All texts of a trace are set as text, never as HTML.
const NS = "http://www.w3.org/2000/svg";
const $ = (id) => document.getElementById(id);
let data = JSON.parse($("content").textContent);
const served = data.served;
const assumed = { same: [], different: [] };
const state = { mode: "overview", map: 0, other: 1, step: 0, picked: [] };
let decoded = new Map();

function element(name, attributes = {}, text = null, parent = null) {
  const made = name.startsWith("svg:") ? document.createElementNS(NS, name.slice(4)) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== null) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

function stretches(steps) {
  const parts = [];
  for (const t of steps) {
    const last = parts.at(-1);
    if (last && last[1] === t - 1) last[1] = t; else parts.push([t, t]);
  }
  const told = parts.map(([a, b]) => (a === b ? `${a}` : `${a}–${b}`));
  const shown = told.length > 8 ? [...told.slice(0, 8), "…"] : told;
  return `${steps.length === 1 ? "step" : "steps"} ${shown.join(", ")}`;
}

function members(names) {
  const found = new Map();
  names.forEach((name, t) => {
    if (name === null) return;
    if (!found.has(name)) found.set(name, []);
    found.get(name).push(t);
  });
  return found;
}

// A map as it is drawn: the steps of its dstates and places, where these are, and the streets between them.
function mapOf(i) {
  if (decoded.has(i)) return decoded.get(i);
  const told = data.maps[i], { labels, views } = data.labelings[told.labeling];
  const first = data.places[0], raw = data.places[told.places];
  const where = Array.isArray(raw) ? raw : first.map((value, k) => raw[k] ?? value);
  const ofDstate = members(labels), ofPlace = members(labels.map((label) => where[label][0]));
  const layout = told.layout === undefined ? null : data.layouts[told.layout];
  const places = new Map(layout ? layout.places.map(([p, x, y]) => [p, [x, y]]) : []);
  for (const [p, steps] of ofPlace) if (!places.has(p)) places.set(p, middle(steps));
  const dstates = views.map((view, s) => {
    const steps = ofDstate.get(s) ?? [], spot = layout ? layout.dstates[s] : data.spots[steps[0]];
    const [place, path, direction] = where[s];
    const at = place !== null && places.has(place) ? places.get(place) : layout ? spot : middle(steps);
    return { id: s, view, steps, place, path, direction, at, heading: spot[2] };
  });
  const streets = [];
  for (const [path, order] of data.orders[told.orders])
    for (let k = 1; k < order.length; k++) if (places.has(order[k - 1]) && places.has(order[k])) streets.push({ path, from: order[k - 1], to: order[k] });
  const keys = new Set();
  for (const steps of ofDstate.values()) keys.add(`d${steps}`);
  for (const steps of ofPlace.values()) keys.add(`p${steps}`);
  for (const { from, to } of streets) keys.add(streetKey(ofPlace.get(from), ofPlace.get(to)));
  const made = { number: i, labels, dstates, places, ofPlace, streets, keys, faults: told.faults ?? [], chi2: told.chi2, id: told.id };
  decoded.set(i, made);
  return made;
}

function streetKey(a, b) { return `s${[`${a}`, `${b}`].sort().join("|")}`; }

function middle(steps) {
  let [x, y] = [0, 0];
  for (const t of steps) { x += data.spots[t][0]; y += data.spots[t][1]; }
  return [x / Math.max(1, steps.length), y / Math.max(1, steps.length)];
}

function share(count) {
  const part = count / data.maps.length;
  return part === 1 ? "" : part > 2 / 3 ? "most" : part > 1 / 3 ? "half" : "few";
}

function canvas(caption) {
  const figure = element("figure", {}, null, $("drawings"));
  element("figcaption", {}, caption, figure);
  const svg = element("svg:svg", { role: "img", "aria-label": caption, preserveAspectRatio: "xMidYMid meet" }, null, figure);
  zoomable(svg);
  return svg;
}

let view = null; // [left, top, width, height], common to all drawings
function fit(points) {
  const xs = points.map((p) => p[0]), ys = points.map((p) => -p[1]);
  const least = (v) => v.reduce((a, b) => Math.min(a, b), Infinity), most = (v) => v.reduce((a, b) => Math.max(a, b), -Infinity);
  const [l, t] = [least(xs) - 0.7, least(ys) - 0.7];
  return [l, t, Math.max(most(xs) + 0.7 - l, 2), Math.max(most(ys) + 0.7 - t, 2)];
}
function showView() { for (const svg of $("drawings").querySelectorAll("svg")) svg.setAttribute("viewBox", view.join(" ")); }
function zoomable(svg) {
  svg.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = svg.getBoundingClientRect(), factor = Math.exp(Math.sign(event.deltaY) * 0.15);
    const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    view = [view[0] + view[2] * u * (1 - factor), view[1] + view[3] * v * (1 - factor), view[2] * factor, view[3] * factor];
    showView();
  }, { passive: false });
  let from = null;
  svg.addEventListener("pointerdown", (event) => { from = [event.clientX, event.clientY, ...view]; });
  svg.addEventListener("pointermove", (event) => {
    if (!from || !event.buttons) { from = null; return; }
    const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
    if (Math.hypot(dx, dy) < 4) return;
    const box = svg.getBoundingClientRect(), scale = Math.max(from[4] / box.width, from[5] / box.height);
    view = [from[2] - dx * scale, from[3] - dy * scale, from[4], from[5]];
    showView();
  });
}

// A headed mark beside the middle of its place, or a dot where the heading is not known.
function mark(svg, at, heading, index, count, kind, title, steps, name) {
  const group = element("svg:g", {}, null, svg);
  let [x, y] = [at[0], -at[1]], angle = heading;
  if (angle === null) { if (count > 1) angle = (2 * Math.PI * index) / count; }
  const [c, s] = angle === null ? [0, 0] : [Math.cos(angle), -Math.sin(angle)];
  const r = count > 1 || heading !== null ? 0.24 : 0;
  x += c * r - s * 0.03 * (index % 2); y += s * r + c * 0.03 * (index % 2);
  const here = steps.includes(state.step) ? " here" : "", picked = state.picked.some((t) => steps.includes(t)) ? " picked" : "";
  const shape = angle === null ? element("svg:circle", { cx: x, cy: y, r: 0.09 }, null, group)
    : element("svg:path", { d: `M${x + c * 0.13},${y + s * 0.13} L${x - c * 0.08 - s * 0.09},${y - s * 0.08 + c * 0.09} L${x - c * 0.08 + s * 0.09},${y - s * 0.08 - c * 0.09} Z` }, null, group);
  shape.setAttribute("class", `dstate ${kind}${here}${picked}`);
  shape.setAttribute("data-step", steps[0]);
  shape.setAttribute("tabindex", "0");
  shape.setAttribute("role", "button");
  shape.setAttribute("aria-label", title);
  element("svg:title", {}, title, shape);
  if (name !== null) element("svg:text", { class: "name", x: x + c * 0.24, y: y + s * 0.24 + 0.06 }, name, group);
  const choose = () => pick(steps.includes(state.step) ? state.step : steps[0]);
  shape.addEventListener("click", choose);
  shape.addEventListener("keydown", (event) => { if (event.key === "Enter") choose(); });
}

function line(svg, a, b, kind, title) {
  const drawn = element("svg:line", { x1: a[0], y1: -a[1], x2: b[0], y2: -b[1], class: `street ${kind}` }, null, svg);
  element("svg:title", {}, title, drawn);
}

function drawOverview() {
  const all = data.maps.length, { nodes, dstates, streets } = data.overview;
  const svg = canvas(`What ${all === 1 ? "the map has" : `all ${all} maps share is solid; what some dispute is dashed, in colours that say how many have it`}`);
  const at = nodes.map((node) => [node.x, node.y]);
  const drawnStreets = streets.map(([a, b, count]) => ({ a, b, count })).sort((p, q) => p.count - q.count);
  for (const { a, b, count } of drawnStreets) line(svg, at[a], at[b], share(count), `a street that ${count} of ${all} maps have`);
  nodes.forEach((node, k) => {
    const title = `${dstates.length ? "place" : "dstate"} of ${stretches(node.steps)}: in ${node.maps} of ${all} maps`;
    if (!dstates.length) { mark(svg, at[k], node.heading, 0, 1, share(node.maps), title, node.steps, `${node.steps[0]}`); return; }
    const drawn = element("svg:circle", { cx: at[k][0], cy: -at[k][1], r: node.maps === all ? 0.15 : 0.2, class: `node ${share(node.maps)}` }, null, svg);
    element("svg:title", {}, title, drawn);
  });
  const crowd = new Map();
  for (const s of dstates) { const key = `${s.x} ${s.y}`; crowd.set(key, [...(crowd.get(key) ?? []), s]); }
  for (const together of crowd.values()) together.forEach((s, k) => mark(svg, [s.x, s.y], s.heading, k, together.length, share(s.maps),
    `dstate of ${stretches(s.steps)}: in ${s.maps} of ${all} maps`, s.steps, null));
  return at;
}

function drawMap(i, rival) {
  const ssh = mapOf(i), other = rival === null ? null : mapOf(rival);
  const svg = canvas(`Map ${i + 1} of ${data.maps.length}, ${ssh.id}${ssh.chi2 === undefined ? "" : `, chi-square ${ssh.chi2}`}${other ? "; dashed: not so in the other one" : ""}`);
  const differs = (key) => (other && !other.keys.has(key) ? "differs" : "");
  const points = [...ssh.places.values(), ...ssh.dstates.filter((s) => s.place === null).map((s) => s.at)];
  if (!ssh.places.size) for (const [s, action, x] of i === 0 || data.maps[i].labeling === data.maps[0].labeling ? data.links : []) if (s !== x) line(svg, ssh.dstates[s].at, ssh.dstates[x].at, "", action);
  for (const { path, from, to } of ssh.streets) line(svg, ssh.places.get(from), ssh.places.get(to), differs(streetKey(ssh.ofPlace.get(from), ssh.ofPlace.get(to))), `path ${path}`);
  for (const [p, [x, y]] of ssh.places) {
    const steps = ssh.ofPlace.get(p) ?? [];
    const drawn = element("svg:circle", { cx: x, cy: -y, r: 0.16, class: `node ${differs(`p${steps}`)}` }, null, svg);
    element("svg:title", {}, `place ${p}: ${stretches(steps)}`, drawn);
    element("svg:text", { class: "name", x, y: -y + 0.06 }, p, svg);
  }
  const crowd = new Map();
  for (const s of ssh.dstates) { const key = s.place === null ? `d${s.id}` : `p${s.place}`; crowd.set(key, [...(crowd.get(key) ?? []), s]); }
  for (const together of crowd.values()) together.forEach((s, k) => mark(svg, s.at, s.heading, k, together.length, differs(`d${s.steps}`),
    `dstate ${s.id}, ${s.view}: ${stretches(s.steps)}${s.path === null ? "" : `; path ${s.path}${s.direction === -1 ? ", backwards" : ""}`}`, s.steps, `${s.id}`));
  for (const [t, text] of ssh.faults) {
    const at = ssh.dstates[ssh.labels[t]].at;
    const drawn = element("svg:circle", { cx: at[0], cy: -at[1], r: 0.34, class: "fault" }, null, svg);
    element("svg:title", {}, text, drawn);
  }
  return points;
}

function draw(keep = true) {
  state.map = Math.min(state.map, data.maps.length - 1);
  if (state.other >= data.maps.length) state.other = data.maps.length - 1;
  $("drawings").replaceChildren();
  let points = [];
  if (state.mode === "overview") points = drawOverview();
  else {
    points = drawMap(state.map, state.mode === "two" ? state.other : null);
    if (state.mode === "two") points = points.concat(drawMap(state.other, state.map));
  }
  if (!keep || !view) view = fit(points);
  showView();
  for (const name of ["overview", "one", "two"]) $(name).setAttribute("aria-pressed", state.mode === name);
  $("moves").hidden = state.mode === "overview";
  $("second").hidden = state.mode !== "two";
  $("two").disabled = data.maps.length < 2;
  $("number").max = $("other").max = data.maps.length;
  $("number").value = state.map + 1;
  $("other").value = state.other + 1;
  $("back").disabled = state.map === 0;
  $("next").disabled = state.map === data.maps.length - 1;
  $("labels").disabled = nextMap((told, now) => told.labeling !== now.labeling) === null;
  $("paths").disabled = nextMap((told, now) => told.labeling === now.labeling) === null;
  about();
  legend();
}

function legend() {
  $("legend").replaceChildren();
  const rows = state.mode === "overview" ? [["", "all maps"], ["most", "more than two thirds"], ["half", "about half"], ["few", "less than a third"]] : state.mode === "two" ? [["", "as in the other map"], ["differs", "not so in the other map"]] : [];
  for (const [kind, text] of rows) {
    const row = element("p", { class: "key" }, null, $("legend"));
    element("i", { class: kind }, null, row);
    element("span", {}, text, row);
  }
}

function about() {
  $("about").replaceChildren();
  if (state.mode === "overview") { element("p", {}, `${data.maps.length === 1 ? "One map" : `${data.maps.length} maps`}; ${data.file}`, $("about")); return; }
  for (const i of state.mode === "two" ? [state.map, state.other] : [state.map]) {
    const ssh = mapOf(i);
    element("p", {}, `Map ${i + 1}: ${ssh.dstates.length} dstates${ssh.places.size ? `, ${ssh.places.size} places, ${data.orders[data.maps[i].orders].length} paths` : ""}`, $("about"));
    for (const [, text] of ssh.faults) element("p", {}, text, $("about"));
  }
}

// The next map of a kind, after the one drawn, and from the first one on after the last.
function nextMap(wanted) {
  const count = data.maps.length, now = data.maps[state.map];
  for (let k = 1; k < count; k++) {
    const i = (state.map + k) % count;
    if (wanted(data.maps[i], now)) return i;
  }
  return null;
}

function go(i) {
  if (i === null || !(i >= 0 && i < data.maps.length)) return;
  state.map = i;
  if (state.mode === "overview") state.mode = "one";
  draw();
}

function setMode(mode) {
  if (mode === "two" && data.maps.length < 2) return;
  state.mode = mode;
  if (mode === "two" && state.other === state.map) state.other = state.map ? 0 : 1;
  draw(false);
}

function setStep(t) {
  if (!(t >= 0 && t < data.steps.length)) return;
  state.step = t;
  const step = data.steps[t];
  $("slider").value = t;
  $("at").textContent = `${t} of ${data.steps.length - 1}`;
  $("seen").textContent = `view ${step.view}${step.action === null ? "; the trace ends" : `; then ${step.action}`}`;
  polar(step.image);
  const groups = new Map();
  data.maps.forEach((told, i) => {
    const key = told.labeling;
    groups.set(key, [...(groups.get(key) ?? []), i + 1]);
  });
  const bySteps = new Map();
  for (const [key, maps] of groups) {
    const { labels } = data.labelings[key];
    const steps = labels.flatMap((label, k) => (label === labels[t] ? [k] : [])), name = `${steps}`;
    const known = bySteps.get(name) ?? { steps, label: labels[t], maps: [] };
    known.maps.push(...maps);
    bySteps.set(name, known);
  }
  $("rivals").replaceChildren();
  for (const { steps, label, maps } of bySteps.values())
    element("li", {}, `dstate ${label} (${stretches(steps)}): ${maps.length === data.maps.length ? "in all maps" : `in ${maps.length} of ${data.maps.length} maps${maps.length < 9 ? `: ${maps.sort((a, b) => a - b).join(", ")}` : ""}`}`, $("rivals"));
  for (const shape of document.querySelectorAll(".here")) shape.classList.remove("here");
  draw();
}

function polar(ranges) {
  $("image").replaceChildren();
  if (!ranges) return;
  const svg = element("svg:svg", { viewBox: "-105 -105 210 210", role: "img", "aria-label": "laser image, ahead is up" }, null, $("image"));
  const points = ranges.map((r, k) => {
    const angle = ranges.length > 1 ? (2 * Math.PI * k) / ranges.length - Math.PI / 2 : 0;
    return `${(Math.cos(angle) * r).toFixed(1)},${(Math.sin(angle) * r).toFixed(1)}`;
  });
  element("svg:polygon", { points: points.join(" "), class: "polar" }, null, svg);
}

function pick(t) {
  state.picked = state.picked.length === 1 && state.picked[0] !== t ? [state.picked[0], t].sort((a, b) => a - b) : [t];
  judge();
}

function judge() {
  const [a, b] = state.picked;
  $("first").value = a ?? "";
  $("later").value = b ?? "";
  $("answer").textContent = "";
  $("ask").hidden = b === undefined;
  if (b === undefined) $("verdict").textContent = a === undefined ? "" : `step ${a}: choose another one`;
  else {
    const count = { dstate: 0, place: 0, path: 0 }, all = data.maps.length;
    data.maps.forEach((told, i) => {
      const ssh = mapOf(i), [s, x] = [ssh.dstates[ssh.labels[a]], ssh.dstates[ssh.labels[b]]];
      count.dstate += s.id === x.id;
      count.place += s.place !== null && s.place === x.place;
      count.path += s.path !== null && s.path === x.path;
    });
    const word = count.dstate === all ? "one dstate in every" : count.dstate === 0 ? "different dstates in every" : "one dstate in";
    const listed = data.complete && data.minimal === all ? "minimal map" : "map listed";
    const told = [count.dstate && count.dstate < all ? `${word} ${count.dstate} of the ${all} ${listed}s: rivals disagree` : `${word} ${listed}`];
    if (data.places[0].some(([place]) => place !== null)) told.push(`at one place in ${count.place}, along one path in ${count.path} of ${all}`);
    $("verdict").textContent = `Steps ${a} and ${b}: ${told.join("; ")}.`;
  }
  draw();
}

function theory() { return ["same", "different"].flatMap((kind) => assumed[kind].map(([a, b]) => ` --${kind} ${a},${b}`)).join(""); }

async function ask(question, body) {
  $("answer").textContent = "…";
  try {
    const response = await fetch(question, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    if (!response.ok) throw new Error(`the server refused (${response.status}); open the address that view --serve printed`);
    const told = await response.json();
    if (told.error) throw new Error(told.error);
    return told;
  } catch (error) {
    $("answer").textContent = `No answer: ${error.message}`;
    return null;
  }
}

async function why() {
  const pair = state.picked;
  if (pair.length < 2) return;
  if (!served) { $("answer").textContent = `ssh-abduction explain ${data.trace} ${pair[0]} ${pair[1]}`; return; }
  const told = await ask("explain", { pair, ...assumed });
  if (told) $("answer").textContent = told.text;
}

async function assume(kind) {
  if (kind && state.picked.length < 2) return;
  const before = structuredClone(assumed);
  if (kind) assumed[kind].push(state.picked.slice()); else { assumed.same = []; assumed.different = []; }
  if (!served) { $("answer").textContent = `ssh-abduction solve ${data.trace} --json${theory()} > maps.json`; Object.assign(assumed, before); return; }
  const told = await ask("solve", assumed);
  if (!told || !told.content) Object.assign(assumed, before);
  if (!told) return;
  if (told.content) { data = told.content; decoded = new Map(); view = null; load(); }
  $("answer").textContent = `${kind ? `With steps ${state.picked.join(" and ")} assumed ${kind}: ` : ""}${told.text}`;
}

function load() {
  $("sentence").textContent = data.sentence + (theory() ? ` — assumed:${theory()}` : "");
  document.title = data.sentence;
  $("slider").max = $("first").max = $("later").max = data.steps.length - 1;
  $("choices").replaceChildren();
  for (const choice of data.choices) {
    const item = element("li", {}, null, $("choices"));
    element("div", {}, choice.questions.slice(0, 4).join("; ") + (choice.questions.length > 4 ? `; and ${choice.questions.length - 4} more` : "") + "?", item);
    choice.options.slice(0, 6).forEach((option) => {
      const answers = option.answers.length > 4 ? `way ${choice.options.indexOf(option) + 1}` : option.answers.map((yes) => (yes ? "yes" : "no")).join(", ");
      element("button", {}, `${answers}: ${option.maps.length} ${option.maps.length === 1 ? "map" : "maps"}`, item).addEventListener("click", () => go(option.maps[0] - 1));
    });
  }
  if (!data.choices.length) element("p", {}, "Nowhere.", $("choices"));
  $("forget").hidden = !theory();
  judge();
  setStep(Math.min(state.step, data.steps.length - 1));
}

for (const mode of ["overview", "one", "two"]) $(mode).addEventListener("click", () => setMode(mode));
$("back").addEventListener("click", () => go(state.map - 1));
$("next").addEventListener("click", () => go(state.map + 1));
const otherLabels = () => go(nextMap((told, now) => told.labeling !== now.labeling));
const otherPaths = () => go(nextMap((told, now) => told.labeling === now.labeling));
$("labels").addEventListener("click", otherLabels);
$("paths").addEventListener("click", otherPaths);
$("number").addEventListener("change", () => { go(Number($("number").value) - 1); draw(); });
$("other").addEventListener("change", () => { const i = Number($("other").value) - 1; if (i >= 0 && i < data.maps.length) state.other = i; draw(); });
$("slider").addEventListener("input", () => setStep(Number($("slider").value)));
for (const name of ["first", "later"]) $(name).addEventListener("change", () => {
  const steps = ["first", "later"].map((id) => $(id).value).filter((text) => text !== "").map(Number).filter((t) => Number.isInteger(t) && t >= 0 && t < data.steps.length);
  state.picked = [...new Set(steps)].sort((a, b) => a - b);
  judge();
});
$("why").addEventListener("click", why);
$("same").addEventListener("click", () => assume("same"));
$("different").addEventListener("click", () => assume("different"));
$("forget").addEventListener("click", () => assume(null));
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input") || event.ctrlKey || event.metaKey || event.altKey) return;
  const keys = { ArrowLeft: () => setStep(state.step - 1), ArrowRight: () => setStep(state.step + 1), n: () => go(state.map + 1), p: () => go(state.map - 1),
    d: otherLabels, h: otherPaths, o: () => setMode("overview"), 1: () => setMode("one"), 2: () => setMode("two") };
  if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
});
load();
