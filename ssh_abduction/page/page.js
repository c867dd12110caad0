"use strict";
// The page of rival maps. All texts of a trace are set as text, never as HTML.
const NS = "http://www.w3.org/2000/svg";
const ALPHABET = Array.from({ length: 92 }, (_, k) => String.fromCharCode(35 + k)).filter((c) => !"&<>\\".includes(c)).join(""); // as in images.py
const COLOURS = 8; // of paths
const NEAREST = 22; // pixels: a click picks the nearest dstate within so many
const PLAYING = 700; // milliseconds a step
const $ = (id) => document.getElementById(id);
let data = JSON.parse($("content").textContent);
const served = data.served;
const assumed = { same: [], different: [] };
const state = { mode: "overview", map: 0, other: 1, step: 0, picked: [], replay: 0 };
let decoded = new Map(), placed = new Map(), figures = [];

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

function counted(count, noun) { return `${count} ${count === 1 ? noun : `${noun}s`}`; }

function members(names) {
  const found = new Map();
  names.forEach((name, t) => {
    if (name === null) return;
    if (!found.has(name)) found.set(name, []);
    found.get(name).push(t);
  });
  return found;
}

function replay() { return data.replays[state.replay]; }

// ---- maps ----

// The place, path and direction of each dstate of a map.
function whereIn(i) {
  const number = data.maps[i].places;
  if (!placed.has(number)) {
    const first = data.places[0], raw = data.places[number];
    const named = ([place, path, direction]) => [place, raw.paths?.[path] === undefined ? path : raw.paths[path], direction];
    placed.set(number, Array.isArray(raw) ? raw : first.map((value, k) => raw[k] ?? named(value)));
  }
  return placed.get(number);
}

function labelsOf(i) { return data.labelings[data.maps[i].labeling].labels; }

// A map as it is drawn: the steps of its dstates and places, where these are, and the streets between them.
function mapOf(i) {
  if (decoded.has(i)) return decoded.get(i);
  const told = data.maps[i], { labels, views } = data.labelings[told.labeling], where = whereIn(i);
  const ofDstate = members(labels), ofPlace = members(labels.map((s) => where[s][0])), ofPath = members(labels.map((s) => where[s][1]));
  const layout = told.layout === undefined ? null : data.layouts[told.layout];
  const places = new Map(layout ? layout.places.map(([p, x, y]) => [p, [x, y]]) : []);
  for (const [p, steps] of ofPlace) if (!places.has(p)) places.set(p, middle(steps));
  const dstates = views.map((view, s) => {
    const steps = ofDstate.get(s) ?? [], spot = layout ? layout.dstates[s] : data.spots[steps[0]];
    const [place, path, direction] = where[s];
    const at = place !== null && places.has(place) ? places.get(place) : layout ? spot.slice(0, 2) : middle(steps);
    return { id: s, view, steps, place, path, direction, at, heading: spot[2] };
  });
  const travelled = new Map();
  for (let t = 1; t < labels.length; t++) {
    const [a, b] = [dstates[labels[t - 1]], dstates[labels[t]]];
    if (a.place !== null && b.place !== null && a.place !== b.place && a.path !== null && a.path === b.path) travelled.set(pairKey(a.place, b.place), { path: a.path, from: a.place, to: b.place, travelled: true });
  }
  const streets = [...travelled.values()];
  for (const [path, order] of data.orders[told.orders])
    for (let k = 1; k < order.length; k++)
      if (places.has(order[k - 1]) && places.has(order[k]) && !travelled.has(pairKey(order[k - 1], order[k]))) streets.push({ path, from: order[k - 1], to: order[k], travelled: false });
  const links = ofPlace.size ? new Map() : linksOf(labels);
  const keys = new Set();
  for (const [key, link] of links) { link.key = `l${key.split(" ").map((s) => ofDstate.get(Number(s))).join("|")}`; keys.add(link.key); }
  for (const steps of ofDstate.values()) keys.add(`d${steps}`);
  for (const steps of ofPlace.values()) keys.add(`p${steps}`);
  for (const steps of ofPath.values()) keys.add(`h${steps}`);
  for (const street of streets) { street.key = `s${[`${ofPlace.get(street.from)}`, `${ofPlace.get(street.to)}`].sort().join("|")}`; if (street.travelled) keys.add(street.key); }
  const made = { number: i, labels, dstates, places, ofPlace, ofPath, streets, links, keys, layout, faults: (told.faults ?? []).map((k) => data.faults[k]), chi2: told.chi2, id: told.id };
  if (decoded.size > 40) decoded.delete(decoded.keys().next().value);
  decoded.set(i, made);
  return made;
}

// The links of a map without places, by the dstates that they join: which actions of the trace led from the one to the other.
function linksOf(labels) {
  const links = new Map(), { steps } = data.replays.at(-1); // the trace that was mapped
  for (let t = 1; t < labels.length; t++) {
    const [s, x] = [labels[t - 1], labels[t]], key = `${s} ${x}`;
    if (s === x) continue;
    if (!links.has(key)) links.set(key, { from: s, to: x, actions: new Set() });
    if (steps[t - 1].action !== null) links.get(key).actions.add(steps[t - 1].action);
  }
  return links;
}

function pairKey(a, b) { return a < b ? `${a} ${b}` : `${b} ${a}`; }

function middle(steps) {
  let [x, y] = [0, 0];
  for (const t of steps) { x += data.spots[t][0]; y += data.spots[t][1]; }
  return [x / Math.max(1, steps.length), y / Math.max(1, steps.length)];
}

function share(count) {
  const part = count / data.maps.length;
  return part === 1 ? "" : part > 2 / 3 ? "most" : part > 1 / 3 ? "half" : "few";
}

// ---- drawings. Each has a home, which holds all of it; the camera is how far all of them are moved, in pixels, and enlarged from there ----

let camera = { dx: 0, dy: 0, z: 1 }, homes = [];

// The middle of points and how many pixels the distance between neighbours has, so that all points are seen.
function homeOf(points, svg) {
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  const least = (v) => v.reduce((a, b) => Math.min(a, b), Infinity), most = (v) => v.reduce((a, b) => Math.max(a, b), -Infinity);
  const [l, r, b, t] = [least(xs), most(xs), least(ys), most(ys)], box = svg.getBoundingClientRect(), margin = Math.min(55, box.width / 7, box.height / 6);
  const k = Math.min((box.width - 2 * margin) / Math.max(r - l, 1e-9), (box.height - 2 * margin - 12) / Math.max(t - b, 1e-9), 230 / crowding(points));
  return { x: (l + r) / 2, y: (b + t) / 2, k: Math.max(k, 0.1) };
}

// Drawings in metres have one home, so that they can be compared; others say nothing of lengths, and each has its own.
function settle() {
  const together = figures.every((figure) => figure.layout?.metric) || figures.every((figure) => figure.layout === figures[0].layout);
  homes = figures.map((figure) => homeOf(together ? figures.flatMap((one) => one.points) : figure.points, figure.svg));
  camera = { dx: 0, dy: 0, z: 1 };
}

// Whether all that is drawn can be seen from the homes as they are, so that they need not move: what stays the same then stays where it is.
function settled() {
  return homes.length === figures.length && figures.every((figure, i) => {
    const box = figure.svg.getBoundingClientRect(), home = homes[i];
    return figure.points.every(([x, y]) => Math.abs(x - home.x) * home.k < box.width / 2 - 12 && Math.abs(y - home.y) * home.k < box.height / 2 - 12);
  });
}

function onScreen(figure, [x, y]) { return [figure.width / 2 + (x - figure.home.x) * figure.k + camera.dx, figure.height / 2 - (y - figure.home.y) * figure.k + camera.dy]; }

let waiting = false;
function paintSoon() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; paint(); });
}

// Enlarge all drawings, so that the point at (u, v) from their middles stays where it is.
function zoom(factor, u = 0, v = 0) {
  const z = Math.min(Math.max(camera.z * factor, 0.2), 60), f = z / camera.z;
  camera = { dx: u - (u - camera.dx) * f, dy: v - (v - camera.dy) * f, z };
  paintSoon();
}

// One finger or the mouse moves the drawing, two fingers or the wheel zoom; a click that moves nothing picks the nearest dstate.
function movable(figure) {
  const { svg } = figure, down = new Map();
  let moved = false;
  svg.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = svg.getBoundingClientRect();
    zoom(Math.exp(-Math.sign(event.deltaY) * 0.15), event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2);
  }, { passive: false });
  svg.addEventListener("pointerdown", (event) => { down.set(event.pointerId, [event.clientX, event.clientY]); if (down.size === 1) moved = false; });
  svg.addEventListener("pointermove", (event) => {
    const from = down.get(event.pointerId);
    if (!from) return;
    const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
    if (!moved && Math.hypot(dx, dy) < 5) return;
    if (!moved) svg.setPointerCapture(event.pointerId);
    moved = true;
    const others = [...down].filter(([id]) => id !== event.pointerId);
    if (others.length === 1) {
      const [, [ox, oy]] = others[0], box = svg.getBoundingClientRect();
      const factor = Math.hypot(event.clientX - ox, event.clientY - oy) / Math.max(1, Math.hypot(from[0] - ox, from[1] - oy));
      zoom(factor, (event.clientX + ox) / 2 - box.left - box.width / 2, (event.clientY + oy) / 2 - box.top - box.height / 2);
    } else if (!others.length) { camera.dx += dx; camera.dy += dy; paintSoon(); }
    down.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel", "pointerleave"]) svg.addEventListener(name, (event) => down.delete(event.pointerId));
  svg.addEventListener("click", (event) => {
    if (moved) { moved = false; return; }
    const target = event.target.closest("[data-step]");
    let steps = target ? figure.marks[Number(target.dataset.mark)].steps : null;
    if (!steps) {
      const box = svg.getBoundingClientRect(), away = (m) => Math.hypot(m.x - event.clientX + box.left, m.y - event.clientY + box.top);
      const nearest = figure.marks.reduce((best, m) => (away(m) < away(best) ? m : best), { x: Infinity, y: Infinity });
      if (nearest.steps && away(nearest) < NEAREST) steps = nearest.steps;
    }
    if (steps) pick(!replay().other && steps.includes(state.step) ? state.step : steps[0]);
  });
}

function newFigure(content) {
  const figure = { ...content, marks: [], boxes: [] };
  const holder = element("figure", {}, null, $("drawings"));
  element("figcaption", {}, content.caption, holder);
  figure.svg = element("svg:svg", { role: "img", "aria-label": content.caption }, null, holder);
  figure.under = element("svg:g", {}, null, figure.svg);
  figure.base = element("svg:g", {}, null, figure.svg);
  figure.over = element("svg:g", {}, null, figure.svg);
  movable(figure);
  return figure;
}

// What is drawn of a figure, before it is known how large: nodes {at, kind, title, name, steps}, marks {at, node, heading, kind, title, name, steps, dstate}, and streets {a, b: places in the list of nodes, kind, title}.
function overviewFigure() {
  const all = data.maps.length, { nodes, dstates, streets } = data.overview, together = new Map();
  const figure = { map: null, caption: all === 1 ? "The map" : `What all ${all} maps share is solid; what some dispute is dashed, in colours that say how many have it` };
  const isPlaces = dstates.length > 0;
  figure.nodes = isPlaces ? nodes.map((node) => ({ at: [node.x, node.y], kind: share(node.maps), title: `place of ${stretches(node.steps)}: in ${node.maps} of ${all} maps` })) : [];
  for (const [k, node] of nodes.entries()) for (const t of node.steps) if (!together.has(t)) together.set(t, k);
  figure.arrows = (isPlaces ? dstates : nodes).map((s) => {
    const hollow = isPlaces && s.path < s.maps && s.maps === all;
    const title = `dstate of ${stretches(s.steps)}: in ${s.maps} of ${all} maps${isPlaces && s.path < s.maps ? `; what is along its path is the same in ${s.path} of them` : ""}`;
    return { at: [s.x, s.y], heading: s.heading, kind: hollow ? `hollow ${share(s.path)}` : share(s.maps), title, steps: s.steps, name: isPlaces ? null : `${s.steps[0]}`, dstate: null, bare: !isPlaces };
  });
  const at = nodes.map((node) => [node.x, node.y]);
  figure.streets = streets.map(([a, b, count, path]) => ({ a: at[a], b: at[b], kind: share(count), count, inner: count === all && path < count ? share(path) : null,
    title: `${isPlaces ? "a street" : "a link"} that ${count} of ${all} maps have${path < count ? `; what else is along its path is the same in ${path} of them` : ""}` })).sort((p, q) => p.count - q.count);
  const known = new Map();
  for (const told of data.maps) for (const k of told.faults ?? []) known.set(k, (known.get(k) ?? 0) + 1);
  figure.faults = [...known].map(([k, count]) => ({ step: data.faults[k][0], disputed: count < all, title: `${data.faults[k][1]}: in ${count} of ${all} maps` }));
  figure.points = at;
  figure.layout = data.layouts[data.maps[0].layout];
  figure.labels = labelsOf(0);
  return figure;
}

function mapFigure(i, rival) {
  const ssh = mapOf(i), other = rival === null ? null : mapOf(rival);
  const figure = { map: i, caption: `Map ${i + 1} of ${data.maps.length}, ${ssh.id}${ssh.chi2 === undefined ? "" : `, chi-square ${ssh.chi2}`}${other ? "; dashed: not so in the other one" : ""}` };
  const kindOf = (key, path) => (!other ? "" : !other.keys.has(key) ? "differs" : path !== null && path !== undefined && !other.keys.has(`h${ssh.ofPath.get(path)}`) ? "course" : "");
  figure.nodes = [...ssh.places].map(([p, at]) => ({ at, name: `${p}`, kind: kindOf(`p${ssh.ofPlace.get(p) ?? []}`), title: `place ${p}: ${stretches(ssh.ofPlace.get(p) ?? [])}` }));
  figure.arrows = ssh.dstates.map((s) => {
    const kind = kindOf(`d${s.steps}`, s.path), path = s.path === null ? "" : `; path ${s.path}${s.direction === -1 ? ", backwards" : ""}`;
    return { at: s.at, heading: s.heading, kind, colour: !other && s.path !== null ? s.path % COLOURS : null, title: `dstate ${s.id}, ${s.view}: ${stretches(s.steps)}${path}`, steps: s.steps, name: `x${s.id}`, dstate: s.id, bare: s.place === null };
  });
  figure.streets = ssh.streets.filter(({ travelled }) => travelled || !other).map(({ path, from, to, key, travelled }) => ({ a: ssh.places.get(from), b: ssh.places.get(to), kind: `${kindOf(key, path)}${travelled ? "" : " order"}`.trim(), colour: other ? null : path % COLOURS, path,
    title: `path ${path}, from place ${from} to place ${to}${travelled ? "" : ": only the order of the path says so, nobody travelled there"}` }));
  for (const { from, to, actions, key } of ssh.links.values()) figure.streets.push({ a: ssh.dstates[from].at, b: ssh.dstates[to].at, kind: kindOf(key, null), headed: true, names: [...actions].join(", "), title: `${[...actions].join(", ") || "an action"}: from dstate ${from} to dstate ${to}` });
  figure.faults = ssh.faults.map(([step, text]) => ({ step, disputed: other !== null && !other.faults.some(([, said]) => said === text), title: text }));
  figure.points = [...ssh.places.values(), ...ssh.dstates.filter((s) => s.place === null).map((s) => s.at)];
  figure.layout = ssh.layout;
  figure.labels = ssh.labels;
  return figure;
}

// How far each point is from the nearest other one, in units of the map.
function nearestOf(points) {
  return points.map((p) => {
    let best = Infinity;
    for (const q of points) { const d = Math.hypot(p[0] - q[0], p[1] - q[1]); if (d > 1e-6 && d < best) best = d; }
    return best;
  });
}

// The same in the middle of all of them.
function crowding(points) {
  const known = nearestOf(points.slice(0, 300)).filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[Math.floor(known.length / 2)] : 1;
}

function clear(figure, x, y, w, h) { return figure.boxes.every(([l, t, r, b]) => x + w <= l || x - w >= r || y + h <= t || y - h >= b); }
function keep(figure, x, y, w, h) { figure.boxes.push([x - w, y - h, x + w, y + h]); }

// A label in the first of these directions, so far from a point, where it is clear, if it is in any.
function label(figure, text, [x, y], far, directions, kind = "") {
  const w = text.length * 3.3 + 1, h = 6;
  for (const [c, s] of directions) {
    const along = far + Math.abs(c) * w + Math.abs(s) * h, [u, v] = [x + c * along, y + s * along];
    if (u < w || v < h || u > figure.width - w || v > figure.height - h || !clear(figure, u, v, w, h)) continue;
    keep(figure, u, v, w, h);
    element("svg:text", { class: classes("name", kind), x: u.toFixed(1), y: v.toFixed(1) }, text, figure.base);
    return true;
  }
  return false;
}

function coloured(colour) { return colour === null || colour === undefined ? "" : `coloured path${colour}`; }

function classes(...names) { return names.filter(Boolean).join(" "); }

// Paints a figure as the camera sees it.
function paintFigure(figure) {
  const box = figure.svg.getBoundingClientRect(), [width, height] = [box.width, box.height];
  const home = homes[figures.indexOf(figure)];
  Object.assign(figure, { width, height, home, k: home.k * camera.z, marks: [], boxes: [] });
  figure.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  figure.base.replaceChildren();
  const apart = (figure.crowding ??= crowding(figure.points)) * figure.k;
  const r = Math.min(12, Math.max(3, 0.17 * apart)); // of a place; where another one is near, it is smaller
  figure.radius = r;
  figure.nearest ??= nearestOf(figure.points);
  const radii = new Map(figure.points.map((at, k) => [`${at}`, Math.min(r, Math.max(3, 0.36 * figure.nearest[k] * figure.k))])), radiusAt = (at) => radii.get(`${at}`) ?? r;
  const see = (at) => onScreen(figure, at);
  const spots = figure.nodes.map((node) => see(node.at));
  for (const street of figure.streets) paintStreet(figure, street, see(street.a), see(street.b), spots, r);
  paintEllipses(figure, see);
  figure.nodes.forEach((node, k) => {
    const [x, y] = spots[k], r = radiusAt(node.at);
    const circle = element("svg:circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: r.toFixed(1), class: classes("node", node.kind) }, null, figure.base);
    element("svg:title", {}, node.title, circle);
    keep(figure, x, y, r, r);
    if (node.name && r >= 6) element("svg:text", { class: "name inside", x: x.toFixed(1), y: y.toFixed(1), "font-size": Math.min(12, r * 1.15, (3 * r) / node.name.length).toFixed(1) }, node.name, figure.base);
  });
  paintMarks(figure, see, radiusAt);
  const named = new Set();
  for (const m of figure.marks) if (m.name && apart > (figure.marks.length > 150 ? 70 : m.bare ? 24 : 40)) label(figure, m.name, [m.x, m.y], m.size + 2, around(m));
  for (const street of figure.streets) if (street.names && apart > 60) { const [x, y, c, s] = street.middle; label(figure, street.names.length > 24 ? `${street.names.slice(0, 23)}…` : street.names, [x, y], 3, [[c, s], [-c, -s]], "soft"); }
  for (const street of figure.streets) if (street.path !== undefined && !named.has(street.path)) {
    const [[ax, ay], [bx, by]] = [see(street.a), see(street.b)], far = Math.hypot(bx - ax, by - ay) || 1, [nx, ny] = [-(by - ay) / far, (bx - ax) / far];
    if (far > 60 && [0.5, 0.35, 0.65].some((part) => label(figure, `path ${street.path}`, [ax + (bx - ax) * part, ay + (by - ay) * part], 6, [[nx, ny], [-nx, -ny]], "path"))) named.add(street.path);
  }
  paintFaults(figure, r);
  paintScale(figure);
}

// The street is bent where it would run through a place that is not one of its ends.
function paintStreet(figure, street, a, b, spots, r) {
  const far = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1, [ux, uy] = [(b[0] - a[0]) / far, (b[1] - a[1]) / far];
  let met = 0;
  if (!street.headed) for (const [x, y] of spots) {
    const along = (x - a[0]) * ux + (y - a[1]) * uy, aside = (y - a[1]) * ux - (x - a[0]) * uy;
    if (along > r && along < far - r && Math.abs(aside) < r + 2 && Math.hypot(x - a[0], y - a[1]) > 1 && Math.hypot(x - b[0], y - b[1]) > 1) met += aside > 0 ? -1 : 1.5;
  }
  const bend = street.headed ? Math.min(0.2 * far, 34) : met ? Math.sign(met) * Math.min(0.4 * far, 4.5 * r + 0.05 * far) : 0;
  const way = bend ? `M${a[0].toFixed(1)},${a[1].toFixed(1)} Q${((a[0] + b[0]) / 2 - uy * bend).toFixed(1)},${((a[1] + b[1]) / 2 + ux * bend).toFixed(1)} ${b[0].toFixed(1)},${b[1].toFixed(1)}` : `M${a[0].toFixed(1)},${a[1].toFixed(1)} L${b[0].toFixed(1)},${b[1].toFixed(1)}`;
  if (street.headed) { // an arrow before the dstate that the link leads to, and its actions beside its middle
    const [mx, my] = [(a[0] + b[0]) / 2 - uy * bend, (a[1] + b[1]) / 2 + ux * bend], away = Math.hypot(b[0] - mx, b[1] - my) || 1, [c, s] = [(b[0] - mx) / away, (b[1] - my) / away];
    street.head = [b[0] - c * (r + 6), b[1] - s * (r + 6), c, s];
    street.middle = [(a[0] + b[0]) / 2 - (uy * bend) / 2, (a[1] + b[1]) / 2 + (ux * bend) / 2, -uy, ux];
  }
  const drawn = element("svg:path", { d: way, class: classes("street", street.kind, coloured(street.colour)), "stroke-width": (street.kind.includes("order") || street.headed ? 1.5 : Math.min(5, Math.max(1.5, 0.4 * r))).toFixed(1) }, null, figure.base);
  element("svg:title", {}, street.title, drawn);
  if (street.headed) element("svg:path", { d: arrowAt(...street.head, 6), class: classes("head", street.kind) }, null, figure.base);
  if (street.inner) element("svg:path", { d: way, class: classes("street", street.inner, "inner"), "stroke-width": Math.min(2.5, Math.max(1, 0.2 * r)).toFixed(1) }, null, figure.base);
}

// Two standard deviations of where a place is, as seen from the first dstate.
function paintEllipses(figure, see) {
  for (const [s, major, minor, angle] of figure.layout?.ellipses ?? []) {
    const [x, y] = see(figure.layout.dstates[s]), [rx, ry] = [2 * major * figure.k, 2 * minor * figure.k];
    if (rx < figure.radius) continue;
    const drawn = element("svg:ellipse", { class: "ellipse", rx: rx.toFixed(1), ry: Math.max(2, ry).toFixed(1), transform: `translate(${x.toFixed(1)},${y.toFixed(1)}) rotate(${((-angle * 180) / Math.PI).toFixed(1)})` }, null, figure.base);
    element("svg:title", {}, "where this is, by two standard deviations, as seen from the first dstate", drawn);
  }
}

// Headed marks stand at their place on the side that they face, to the right of the line of their path; where many crowd there, farther out. A mark without a heading is a dot.
function paintMarks(figure, see, radiusAt) {
  const crowds = new Map();
  figure.arrows.forEach((arrow) => { const key = arrow.at.map((n) => n.toFixed(3)).join(" "); crowds.set(key, [...(crowds.get(key) ?? []), arrow]); });
  for (const crowd of crowds.values()) {
    const r = radiusAt(crowd[0].at), size = Math.max(3.5, r * 0.85);
    const headed = crowd.filter((m) => m.heading !== null).sort((p, q) => p.heading - q.heading);
    let least = Math.PI / 2;
    headed.forEach((m, k) => { const next = headed[(k + 1) % headed.length], gap = (next.heading - m.heading + 2 * Math.PI) % (2 * Math.PI); if (headed.length > 1 && gap > 0.15) least = Math.min(least, gap); });
    const bare = crowd[0].bare && crowd.length === 1, ring = bare ? 0 : Math.min(Math.max(r + size * 0.8, (1.7 * size) / least), 3.2 * r + size);
    let level = 0;
    crowd.forEach((m) => {
      const k = headed.indexOf(m), angle = m.heading ?? (bare ? null : (2 * Math.PI * crowd.indexOf(m)) / crowd.length);
      level = k > 0 && Math.abs(m.heading - headed[k - 1].heading) <= 0.15 ? level + 1 : 0;
      const [c, s] = angle === null ? [0, 0] : [Math.cos(angle), -Math.sin(angle)], lane = m.heading === null || bare ? 0 : Math.min(0.45 * r, 5), far = ring + level * 1.5 * size;
      const [px, py] = see(m.at), [x, y] = [px + c * far - s * lane, py + s * far + c * lane];
      const shape = m.heading === null ? element("svg:circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: (bare ? r : size * 0.6).toFixed(1) })
        : element("svg:path", { d: arrowAt(x, y, c, s, size) });
      const group = element("svg:g", { class: "mark", "data-step": m.steps[0], "data-mark": figure.marks.length }, null, figure.base);
      group.append(shape);
      for (const [name, value] of Object.entries({ class: classes("dstate", m.kind, coloured(m.colour)), "data-step": m.steps[0], "data-mark": figure.marks.length })) shape.setAttribute(name, value);
      element("svg:title", {}, m.title, shape);
      keep(figure, x, y, size, size);
      figure.marks.push({ ...m, x, y, c, s, angle, size: bare && m.heading === null ? r : size, dot: m.heading === null });
    });
  }
}

function arrowAt(x, y, c, s, size) {
  const p = (u, v) => `${(x + c * u - s * v).toFixed(1)},${(y + s * u + c * v).toFixed(1)}`;
  return `M${p(size, 0)} L${p(-size * 0.7, size * 0.75)} L${p(-size * 0.35, 0)} L${p(-size * 0.7, -size * 0.75)} Z`;
}

// The directions from a mark in which its label may stand: to its right, ahead, between these, to its left.
function around(m) {
  if (m.angle === null) return [[0, -1], [0, 1], [1, 0], [-1, 0]];
  return [[0, 1], [1, 0], [0.7, 0.7], [0, -1], [0.7, -0.7], [-0.7, 0.7]].map(([u, v]) => [m.c * u - m.s * v, m.s * u + m.c * v]);
}

function paintFaults(figure, r) {
  const at = new Map();
  for (const fault of figure.faults) {
    const m = figure.marks.find((mark) => mark.steps.includes(fault.step));
    if (m) at.set(m, [...(at.get(m) ?? []), fault]);
  }
  const u = Math.max(7, r * 0.7);
  for (const [m, told] of at) {
    const far = m.size + u + 5, [x, y] = m.angle === null ? [m.x, m.y - far] : [m.x + m.c * far, m.y + m.s * far];
    const group = element("svg:g", { class: classes("fault", told.every(({ disputed }) => disputed) && "disputed") }, null, figure.base);
    element("svg:title", {}, told.map(({ title }) => title).join("; "), group);
    element("svg:path", { d: `M${x},${y - u} l${u},${u} l${-u},${u} l${-u},${-u} Z` }, null, group);
    element("svg:text", { x, y, "font-size": (1.3 * u).toFixed(1) }, "!", group);
  }
}

function paintScale(figure) {
  if (!figure.layout?.metric) return;
  const metre = figure.k / figure.layout.unit, most = 110 / metre, ten = 10 ** Math.floor(Math.log10(most)), metres = [5, 2, 1].map((k) => k * ten).find((m) => m <= most) ?? ten;
  const group = element("svg:g", { class: "scale" }, null, figure.base), x = figure.width - 14 - metres * metre, y = figure.height - 12;
  element("svg:path", { d: `M${x},${y - 5} v10 m0,-5 h${metres * metre} m0,-5 v10` }, null, group);
  element("svg:text", { x: x + (metres * metre) / 2, y: y - 6 }, `${metres} m`, group);
}

// What changes with the step and with what is picked.
function paintOver(figure) {
  figure.under.replaceChildren();
  figure.over.replaceChildren();
  const beliefs = replay().beliefs, labeling = figure.map === null ? Object.keys(beliefs ?? {})[0] : data.maps[figure.map].labeling, belief = beliefs?.[labeling]?.[state.step];
  if (belief) for (const [s, p] of belief[2]) {
    const steps = data.labelings[labeling].labels.flatMap((x, t) => (x === s ? [t] : [])), m = figure.marks.find((mark) => (figure.map === null ? `${mark.steps}` === `${steps}` : mark.dstate === s));
    if (!m) continue;
    const disc = element("svg:circle", { class: "believed", cx: m.x, cy: m.y, r: (m.size + 2 + Math.sqrt(p) * 1.3 * (figure.radius + 4)).toFixed(1) }, null, figure.under);
    element("svg:title", {}, `the robot is here with probability ${p}`, disc);
  }
  for (const m of figure.marks) {
    if (!replay().other && m.steps.includes(state.step)) {
      element("svg:circle", { class: "here", cx: m.x, cy: m.y, r: m.size + 4 }, null, figure.over);
      element(m.dot ? "svg:circle" : "svg:path", m.dot ? { class: "herefill", cx: m.x, cy: m.y, r: m.size } : { class: "herefill", d: arrowAt(m.x, m.y, m.c, m.s, m.size * 1.15) }, null, figure.over);
    }
    state.picked.forEach((t, k) => {
      if (!m.steps.includes(t)) return;
      element("svg:circle", { class: "picked", cx: m.x, cy: m.y, r: m.size + 10 + 3 * k }, null, figure.over);
      element("svg:text", { class: "name tag", x: m.x + (k ? 1 : -1) * (m.size + 15), y: m.y - m.size - 11 }, "AB"[k], figure.over);
    });
  }
}

function paint() {
  for (const figure of figures) { paintFigure(figure); paintOver(figure); }
}

function draw(keep = true) {
  const last = data.maps.length - 1;
  state.map = Math.min(state.map, last);
  state.other = Math.min(state.other, last);
  $("drawings").replaceChildren();
  const told = state.mode === "overview" ? [overviewFigure()] : state.mode === "one" ? [mapFigure(state.map, null)] : [mapFigure(state.map, state.other), mapFigure(state.other, state.map)];
  figures = told.map(newFigure);
  if (!keep || !settled()) settle();
  paint();
  for (const name of ["overview", "one", "two"]) $(name).setAttribute("aria-pressed", state.mode === name);
  $("moves").hidden = state.mode === "overview" || !last;
  $("second").hidden = state.mode !== "two";
  $("two").disabled = !last;
  $("number").max = $("other").max = last + 1;
  $("number").value = state.map + 1;
  $("other").value = state.other + 1;
  $("back").disabled = state.map === 0;
  $("next").disabled = state.map === last;
  $("labels").disabled = nextMap((one, now) => one.labeling !== now.labeling) === null;
  $("paths").disabled = nextMap((one, now) => one.labeling === now.labeling) === null;
  about();
  legend();
  tellBelief();
}

function legend() {
  $("legend").replaceChildren();
  const rows = [];
  if (state.mode === "overview" && data.maps.length > 1) rows.push(["street", "", "all maps"], ["street", "most", "more than two thirds"], ["street", "half", "about half"], ["street", "few", "less than a third"], ["dstate", "hollow half", "rivals dispute what else is along its path"]);
  if (state.mode === "two") rows.push(["street", "", "as in the other map"], ["street", "differs", "not so in the other map"], ["street", "course", "there too, but along another path"]);
  if (state.mode === "one" && mapOf(state.map).streets.some((street) => !street.travelled)) rows.push(["street", "order", "nobody travelled there: the order of the path says so"]);
  if (data.places[0].some(([place]) => place !== null)) rows.push(["node", "", "a place"], ["dstate", "", "a dstate, headed as it faces"]);
  if (!replay().other) rows.push(["here", "", "where the robot is at this step"]);
  if (replay().beliefs) rows.push(["believed", "", "where it is believed to be: the larger, the more probable"]);
  if (figures.some((figure) => figure.layout?.ellipses?.length)) rows.push(["ellipse", "", "two standard deviations of a position"]);
  if (data.faults.length) rows.push(["fault", "", state.mode === "one" ? "what the map disbelieves" : "what all disbelieve"]);
  if (data.faults.length && state.mode !== "one") rows.push(["fault", "disputed", state.mode === "two" ? "what the other map does not disbelieve" : "what some maps disbelieve"]);
  for (const [shape, kind, text] of rows) {
    const row = element("p", { class: "key" }, null, $("legend")), svg = element("svg:svg", { viewBox: "0 0 38 16", "aria-hidden": "true" }, null, row);
    if (shape === "street") element("svg:path", { d: "M2,8 H36", class: classes("street", kind), "stroke-width": kind === "order" ? 1.5 : 4 }, null, svg);
    else if (shape === "dstate") element("svg:path", { d: arrowAt(19, 8, 1, 0, 7), class: classes("dstate", kind) }, null, svg);
    else if (shape === "ellipse") element("svg:ellipse", { cx: 19, cy: 8, rx: 14, ry: 6, class: shape }, null, svg);
    else if (shape === "fault") { const mark = element("svg:g", { class: classes("fault", kind) }, null, svg); element("svg:path", { d: "M19,0 l8,8 l-8,8 l-8,-8 Z" }, null, mark); element("svg:text", { x: 19, y: 8, "font-size": 11 }, "!", mark); }
    else element("svg:circle", { cx: 19, cy: 8, r: 6, class: shape }, null, svg);
    element("span", {}, text, row);
  }
}

function about() {
  $("about").replaceChildren();
  if (state.mode === "overview") { element("p", {}, `${counted(data.maps.length, "map")} of ${data.file}`, $("about")); return; }
  for (const i of state.mode === "two" ? [state.map, state.other] : [state.map]) {
    const ssh = mapOf(i);
    element("p", {}, `Map ${i + 1}: ${counted(ssh.dstates.length, "dstate")}${ssh.places.size ? `, ${counted(ssh.places.size, "place")}, ${counted(data.orders[data.maps[i].orders].length, "path")}` : ""}`, $("about"));
    for (const [, text] of ssh.faults) element("p", {}, `Disbelieved: ${text}`, $("about"));
  }
}

// ---- which map ----

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
  if (i === null || !(i >= 0 && i < data.maps.length)) { draw(); return; }
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

// ---- the replay ----

function setStep(t) {
  const { steps, images } = replay();
  if (!(t >= 0 && t < steps.length)) return;
  state.step = t;
  const step = steps[t], parts = [];
  $("slider").value = t;
  $("at").textContent = `${t} of ${steps.length - 1}`;
  parts.push(`view ${step.view}`);
  if (step.confidence !== undefined) parts[0] += ` (confidence ${step.confidence})`;
  if (step.moved && t > 0) { const [x, y, turn] = step.moved, degrees = Math.round((turn * 180) / Math.PI); parts.push(`came ${Math.abs(x).toFixed(1)} m ${x < 0 ? "back" : "ahead"}${Math.abs(y) >= 0.05 ? `, ${Math.abs(y).toFixed(1)} m to the ${y > 0 ? "left" : "right"}` : ""}${degrees ? `, turned ${Math.abs(degrees)}° ${degrees > 0 ? "left" : "right"}` : ""}`); }
  parts.push(step.action === null ? (t === steps.length - 1 ? "the trace ends" : "then an action that the maps do not tell") : `then ${step.action}`);
  $("seen").textContent = parts.join("; ");
  const wrong = replay().other ? [] : data.faults.map(([at, text], k) => [at, text, k]).filter(([at]) => at === t);
  $("wrong").textContent = wrong.map(([, text, k]) => { const count = data.maps.filter((told) => told.faults?.includes(k)).length; return `Disbelieved${count < data.maps.length ? ` in ${count} of ${data.maps.length} maps` : ""}: ${text}`; }).join("; ");
  $("wrong").hidden = !wrong.length;
  drawImage(images, images?.images[t] ?? null, step.star);
  tellRivals(t);
  tellBelief();
  for (const figure of figures) paintOver(figure);
}

// The dstate of this step in each rival, or where the robot is believed to be.
function tellRivals(t) {
  const groups = new Map(), { beliefs, other } = replay();
  data.maps.forEach((told, i) => {
    if (!groups.has(told.labeling)) groups.set(told.labeling, []);
    groups.get(told.labeling).push(i + 1);
  });
  const bySteps = new Map();
  for (const [key, maps] of groups) {
    const { labels } = data.labelings[key], belief = beliefs?.[key]?.[t];
    const label = !other ? labels[t] : belief && belief[0] !== "nowhere" && belief[2].length ? belief[2][0][0] : null;
    const steps = label === null ? [] : labels.flatMap((s, k) => (s === label ? [k] : []));
    const name = label === null ? (belief ? "nowhere that it knows" : "not localised there") : `dstate ${label} (${stretches(steps)})`;
    const key2 = label === null ? name : `${steps}`, known = bySteps.get(key2) ?? { name, maps: [] };
    known.maps.push(...maps);
    bySteps.set(key2, known);
  }
  $("rivals").replaceChildren();
  const listed = [...bySteps.values()].sort((p, q) => q.maps.length - p.maps.length);
  for (const { name, maps } of listed.slice(0, 12))
    element("li", {}, `${name}: ${maps.length === data.maps.length ? (maps.length === 1 ? "in the map" : "in all maps") : `in ${maps.length} of ${data.maps.length} maps${maps.length < 9 ? `: ${maps.sort((a, b) => a - b).join(", ")}` : ""}`}`, $("rivals"));
  if (listed.length > 12) element("li", {}, `and ${listed.length - 12} other dstates in other maps`, $("rivals"));
}

function tellBelief() {
  $("belief").replaceChildren();
  const { beliefs } = replay();
  if (!beliefs) return;
  const drawn = state.mode === "overview" ? Object.keys(beliefs)[0] : `${data.maps[state.map].labeling}`, belief = beliefs[drawn]?.[state.step];
  if (!belief) { element("p", {}, "Not localised in this map.", $("belief")); return; }
  const [verdict, nowhere, likely] = belief, map = state.mode === "overview" ? data.maps.findIndex((told) => `${told.labeling}` === drawn) : state.map;
  element("p", {}, `Belief in map ${map + 1}: ${verdict}`, $("belief"));
  for (const [name, p, kind] of [...likely.slice(0, 6).map(([s, p]) => [`dstate ${s}`, p, ""]), ["nowhere", nowhere, "nowhere"]]) {
    const row = element("div", { class: "likely" }, null, $("belief"));
    element("span", {}, name, row);
    element("i", { class: kind }, null, row).style.width = `${100 * p}%`;
    element("span", {}, p.toFixed(2), row);
  }
}

// Ranges round the robot, which is in the middle and faces up; or a panorama as a strip.
function drawImage(images, text, star) {
  $("image").replaceChildren();
  const value = (c) => ALPHABET.indexOf(c) / (ALPHABET.length - 1);
  if (images?.kind === "panorama" && text !== null) {
    const { rows, columns, colours } = images, canvas = element("canvas", { width: columns, height: rows, role: "img", "aria-label": "panorama" }, null, $("image"));
    const context = canvas.getContext("2d"), pixels = context.createImageData(columns, rows);
    for (let k = 0; k < rows * columns; k++) for (let c = 0; c < 4; c++) pixels.data[4 * k + c] = c === 3 ? 255 : 255 * value(text[k * colours + Math.min(c, colours - 1)]);
    context.putImageData(pixels, 0, 0);
  }
  const ranges = images?.kind === "ranges" && text !== null;
  if (!ranges && !star?.length) return;
  const behind = (ranges && Math.max(Math.abs(images.first), Math.abs(images.first + images.step * (text.length - 1))) > 100) || star?.some(([bearing]) => Math.abs(((bearing + 540) % 360) - 180) > 100);
  const spot = (degrees, r) => { const a = (degrees * Math.PI) / 180; return [-Math.sin(a) * r, -Math.cos(a) * r]; };
  const ahead = ranges && behind && !star?.some(([bearing]) => Math.abs(((bearing + 540) % 360) - 180) < 60) ? Math.max(40, ...[...text].map((c, k) => -spot(images.first + images.step * k, 108 * value(c))[1])) : 118;
  const svg = element("svg:svg", { class: ranges ? "" : "small", viewBox: `-150 ${-ahead} 300 ${ahead + (behind ? 118 : 18)}`, role: "img", "aria-label": `${ranges ? "laser image" : "openings"}, ahead is up` }, null, $("image"));
  const ring = ranges ? [0.25, 0.5, 1, 2, 5, 10, 20, 50, 100, 1000].find((metres) => images.reach / metres <= 3.99) ?? images.reach : 1;
  for (let k = 1; k * ring <= (ranges ? images.reach : 1); k++) {
    const r = (100 * k * ring) / (ranges ? images.reach : 1);
    element("svg:circle", { class: "ring", r: r.toFixed(1) }, null, svg);
    if (ranges) element("svg:text", { class: "rim", x: r.toFixed(1), y: 12 }, `${k * ring} m`, svg);
  }
  if (ranges) {
    const points = [...text].map((c, k) => (c === "!" ? null : spot(images.first + images.step * k, 100 * value(c)))).filter(Boolean);
    const round = Math.abs(images.step) * text.length >= 359;
    element("svg:polygon", { points: [...(round ? [] : [[0, 0]]), ...points].map((p) => p.map((n) => n.toFixed(1)).join(",")).join(" "), class: "polar" }, null, svg);
  }
  for (const [bearing, open] of star ?? []) {
    const [[x1, y1], [x2, y2]] = [spot(-bearing, 104), spot(-bearing, 114)], drawn = element("svg:line", { x1, y1, x2, y2, class: classes("gateway", open ? "" : "unknown") }, null, svg);
    element("svg:title", {}, `${open ? "an opening" : "not observed"} at ${bearing}°, clockwise from ahead`, drawn);
  }
  element("svg:path", { d: arrowAt(0, 0, 0, -1, 7), class: "robot" }, null, svg);
  if (star) element("p", {}, star.length ? `Openings, seen clockwise from ahead: ${star.map(([bearing, open]) => `${bearing}°${open ? "" : " (not observed)"}`).join(", ")}` : "No opening is seen.", $("image"));
}

let player = null;
function play(on) {
  clearInterval(player);
  player = null;
  $("play").setAttribute("aria-pressed", on);
  $("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  const last = replay().steps.length - 1;
  if (state.step === last) setStep(0);
  player = setInterval(() => { setStep(state.step + 1); if (state.step >= last) play(false); }, PLAYING);
}

function chooseReplay(k) {
  play(false);
  state.replay = k;
  $("which").value = k;
  $("slider").max = replay().steps.length - 1;
  setStep(Math.min(state.step, replay().steps.length - 1));
  legend();
}

// ---- two steps ----

function pick(t) {
  state.picked = state.picked.length === 1 && state.picked[0] !== t ? [state.picked[0], t].sort((a, b) => a - b) : [t];
  judge();
}

// What is known of two steps without asking anybody: from the maps listed, or from what is proven of all minimal maps.
function judge() {
  giveUp();
  const [a, b] = state.picked;
  $("first").value = a ?? "";
  $("later").value = b ?? "";
  $("answer").textContent = "";
  $("costs").replaceChildren();
  $("ask").hidden = b === undefined && !theory();
  for (const id of ["why", "same", "different"]) $(id).hidden = b === undefined;
  if (b === undefined) $("verdict").textContent = a === undefined ? "" : `Step ${a} is chosen; choose another one.`;
  else { tellVerdict(a, b); if (served) why(); }
  for (const figure of figures) paintOver(figure);
}

function costOf(i) {
  const told = data.maps[i];
  return data.labelings[told.labeling].views.length + (told.cost ?? 0);
}

function tellVerdict(a, b) {
  const minimal = data.minimal ?? data.maps.length, count = { dstate: 0, place: 0, path: 0 }, best = { same: Infinity, different: Infinity };
  data.maps.forEach((told, i) => {
    const labels = labelsOf(i), where = whereIn(i), [s, x] = [labels[a], labels[b]], side = s === x ? "same" : "different";
    best[side] = Math.min(best[side], costOf(i));
    if (i >= minimal) return;
    count.dstate += s === x;
    count.place += where[s][0] !== null && where[s][0] === where[x][0];
    count.path += where[s][1] !== null && where[s][1] === where[x][1];
  });
  const proven = data.complete || data.shared, listed = data.complete ? "minimal map" : "map listed";
  let verdict;
  if (data.shared) {
    const [i, j] = [a, b].map((t) => data.shared.always.indexOf(data.shared.always[t]));
    verdict = i === j ? "one dstate in every minimal map" : data.shared.sometimes.some(([p, q]) => p === Math.min(i, j) && q === Math.max(i, j)) ? `one dstate in some minimal maps, different in others: rivals disagree` : "different dstates in every minimal map";
  } else verdict = count.dstate === minimal ? `one dstate in every ${listed}` : count.dstate === 0 ? `different dstates in every ${listed}` : `one dstate in ${count.dstate} of the ${minimal} ${listed}s: rivals disagree`;
  const places = data.places[0].some(([place]) => place !== null) ? `; at one place in ${count.place}, along one path in ${count.path} of ${minimal}` : "";
  $("verdict").textContent = `Steps ${a} and ${b}: ${verdict}${places}.`;
  const least = Math.min(best.same, best.different), cost = {};
  for (const side of ["same", "different"]) {
    cost[side] = best[side] === least ? "costs nothing" : best[side] < Infinity ? `${best[side]} dstates in the best map listed, not ${least}` : proven ? `more than the ${least} dstates of these maps, if there is such a map` : "no map listed has them so";
  }
  const told = data.assuming?.pairs[`${Math.min(a, b)},${Math.max(a, b)}`];
  if (told && !theory()) [cost.same, cost.different] = told.map((k) => data.assuming.texts[k]);
  tellCosts(cost);
}

function tellCosts(cost) {
  $("costs").replaceChildren();
  for (const [side, name] of [["same", "One dstate"], ["different", "Different"]]) { element("dt", {}, name, $("costs")); element("dd", {}, cost[side], $("costs")); }
}

function theory(more = null) {
  const all = { same: [...assumed.same], different: [...assumed.different] };
  if (more) all[more].push(state.picked);
  return ["same", "different"].flatMap((kind) => all[kind].map(([a, b]) => ` --${kind} ${a},${b}`)).join("");
}

let asking = null;
function giveUp() {
  if (!asking) return;
  asking.abort();
  asking = null;
  $("busy").hidden = true;
}

async function ask(question, body) {
  giveUp();
  const mine = (asking = new AbortController()), begun = Date.now(), since = () => { $("waited").textContent = `Solving for ${Math.round((Date.now() - begun) / 1000)} s`; };
  $("answer").textContent = "";
  $("busy").hidden = false;
  since();
  const clock = setInterval(since, 500);
  try {
    const response = await fetch(new URL(question, location.href.replace(/\/?$/, "/")), { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body), signal: mine.signal });
    if (!response.ok) throw new Error(`the server refused (${response.status}); open the address that view --serve printed`);
    const told = await response.json();
    if (told.error) throw new Error(told.error);
    return told;
  } catch (error) {
    if (asking === mine) $("answer").textContent = error instanceof TypeError ? "No answer: the server has ended; start view --serve again" : `No answer: ${error.message}`;
    return null;
  } finally {
    clearInterval(clock);
    if (asking === mine) { asking = null; $("busy").hidden = true; }
  }
}

async function why() {
  const pair = state.picked;
  if (pair.length < 2) return;
  if (!served) { $("answer").className = "command"; $("answer").textContent = `ssh-abduction explain ${data.trace} ${pair[0]} ${pair[1]}${data.flags}${theory()}`; return; }
  const told = await ask("explain", { pair, ...assumed });
  if (!told) return;
  $("answer").textContent = told.text;
  tellCosts(told.assuming);
}

async function assume(kind) {
  if (kind && state.picked.length < 2) return;
  const pair = state.picked.slice();
  if (!served) {
    if (kind) assumed[kind].push(pair); else { assumed.same = []; assumed.different = []; }
    $("forget").hidden = !theory();
    $("answer").className = "command";
    $("answer").textContent = theory() ? `ssh-abduction solve ${data.trace} --json${data.flags}${theory()} > assumed.json\nssh-abduction view assumed.json ${data.trace}\n\nOr let this page solve again:\nssh-abduction view ${data.file} ${data.trace} --serve` : "";
    return;
  }
  const wanted = kind ? { ...assumed, [kind]: [...assumed[kind], pair] } : { same: [], different: [] };
  const told = await ask("solve", wanted);
  if (!told) return;
  if (told.content) {
    Object.assign(assumed, wanted);
    data = told.content;
    decoded = new Map(); placed = new Map();
    load(false);
  }
  $("answer").textContent = `${kind ? `With steps ${pair.join(" and ")} assumed ${kind}: ` : ""}${told.text}`;
}

// ---- all of it ----

function load(judging = true) {
  $("sentence").textContent = data.sentence + (theory() ? ` — assumed:${theory()}` : "");
  document.title = data.sentence;
  $("first").max = $("later").max = labelsOf(0).length - 1;
  $("which").replaceChildren();
  data.replays.forEach(({ name }, k) => element("option", { value: k }, name, $("which")));
  $("replay").hidden = data.replays.length < 2;
  $("choices").replaceChildren();
  for (const choice of data.choices.slice(0, 20)) {
    const item = element("li", {}, null, $("choices"));
    element("div", {}, choice.questions.slice(0, 4).join("; ") + (choice.questions.length > 4 ? `; and ${choice.questions.length - 4} more` : "") + "?", item);
    choice.options.slice(0, 6).forEach((option, k) => {
      const answers = option.answers.length > 4 ? `way ${k + 1}` : option.answers.map((yes) => (yes ? "yes" : "no")).join(", ");
      element("button", { title: `go to map ${option.maps[0]}` }, `${answers}: ${counted(option.maps.length, "map")}`, item).addEventListener("click", () => go(option.maps[0] - 1));
    });
    if (choice.options.length > 6) element("span", {}, `and ${choice.options.length - 6} other ways`, item);
  }
  if (data.choices.length > 20) element("p", {}, `and ${data.choices.length - 20} other choices`, $("choices"));
  if (!data.choices.length) element("p", {}, data.maps.length > 1 ? "In nothing that is asked of steps." : "There is one map only.", $("choices"));
  if (data.maps.length === 1 && state.mode !== "one") state.mode = "one";
  draw(false);
  state.replay = Math.min(state.replay, data.replays.length - 1);
  chooseReplay(state.replay);
  if (judging) judge();
  else {
    $("costs").replaceChildren();
    if (state.picked.length === 2) tellVerdict(...state.picked);
  }
  $("forget").hidden = !theory();
}

for (const mode of ["overview", "one", "two"]) $(mode).addEventListener("click", () => setMode(mode));
$("back").addEventListener("click", () => go(state.map - 1));
$("next").addEventListener("click", () => go(state.map + 1));
const otherLabels = () => go(nextMap((told, now) => told.labeling !== now.labeling));
const otherPaths = () => go(nextMap((told, now) => told.labeling === now.labeling));
$("labels").addEventListener("click", otherLabels);
$("paths").addEventListener("click", otherPaths);
$("number").addEventListener("change", () => go(Number($("number").value) - 1));
$("other").addEventListener("change", () => { const i = Number($("other").value) - 1; if (i >= 0 && i < data.maps.length) state.other = i; draw(); });
$("slider").addEventListener("input", () => { play(false); setStep(Number($("slider").value)); });
$("play").addEventListener("click", () => play(!player));
$("which").addEventListener("change", () => chooseReplay(Number($("which").value)));
const whole = () => { settle(); paintSoon(); };
$("closer").addEventListener("click", () => zoom(1.3));
$("farther").addEventListener("click", () => zoom(1 / 1.3));
$("whole").addEventListener("click", whole);
for (const name of ["first", "later"]) $(name).addEventListener("change", () => {
  const steps = ["first", "later"].map((id) => $(id).value).filter((text) => text !== "").map(Number), last = labelsOf(0).length - 1;
  const wrong = steps.find((t) => !(Number.isInteger(t) && t >= 0 && t <= last));
  state.picked = [...new Set(steps.filter((t) => Number.isInteger(t) && t >= 0 && t <= last))].sort((a, b) => a - b);
  judge();
  if (wrong !== undefined) $("verdict").textContent = `There is no step ${wrong}: steps are 0 to ${last}.`;
});
$("why").addEventListener("click", why);
$("same").addEventListener("click", () => assume("same"));
$("different").addEventListener("click", () => assume("different"));
$("forget").addEventListener("click", () => assume(null));
$("stop").addEventListener("click", () => { giveUp(); $("answer").textContent = "Given up."; });
$("busy").hidden = true;
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input:not([type=range]), select") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " " && event.target.matches("button")) return;
  const keys = { ArrowLeft: () => setStep(state.step - 1), ArrowRight: () => setStep(state.step + 1), " ": () => play(!player), c: () => { if (!replay().other) pick(state.step); }, n: () => go(state.map + 1), p: () => go(state.map - 1),
    d: otherLabels, h: otherPaths, o: () => setMode("overview"), 1: () => setMode("one"), 2: () => setMode("two"), "+": () => zoom(1.3), "=": () => zoom(1.3), "-": () => zoom(1 / 1.3), 0: whole };
  if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
});
let resized = null;
new ResizeObserver(() => { clearTimeout(resized); resized = setTimeout(() => { if (figures.length && (figures[0].width !== figures[0].svg.getBoundingClientRect().width || figures[0].height !== figures[0].svg.getBoundingClientRect().height)) whole(); }, 60); }).observe($("stage"));
load();
performance.mark("drawn");
