// Finding things by name or number, the layers of the drawing, and the report.

const LAYERS = data.ground
  ? ["walls", "courses", "rooms", "regions", "gateways", "names", "laser", "ellipses", "arrows"]
  : ["courses", "regions", "names", "ellipses", "arrows"];
const layers = new Set(LAYERS.filter((name) => name !== "ellipses" && (name !== "arrows" || !data.ground)));

function showLayers() {
  $("layers").replaceChildren();
  for (const name of LAYERS) {
    const row = element("label", {}, null, $("layers")),
      box = element("input", { type: "checkbox", id: `layer-${name}` }, null, row);
    box.checked = layers.has(name);
    row.append(name);
    box.addEventListener("change", () => {
      layers[box.checked ? "add" : "delete"](name);
      paint();
      legend();
    });
  }
}

// All that has a name or a number in the first map, with its position and its steps, but no dstates.
function things() {
  const ssh = mapOf(0),
    { corridors = [], rooms = [], doors = [] } = data.indoors;
  return [
    ...[...ssh.places].map(([p, at]) => ({ text: ssh.called("place", p), at, steps: ssh.ofPlace.get(p) })),
    ...[...ssh.ofPath].map(([h, steps]) => ({ text: ssh.called("path", h), at: middle(steps), steps })),
    ...corridors.map(({ title, line }) => ({ text: title, at: along(line, 0.5) })),
    ...rooms
      .filter(({ places, line }) => line.length || places.length)
      .map(({ title, places, line }) => ({
        text: title,
        at: line.length ? middle(places.flatMap((p) => ssh.ofPlace.get(p) ?? [])) : ssh.places.get(places[0]),
      })),
    ...doors.map(({ title, at }) => ({ text: title, at })),
  ];
}

function listThings() {
  $("things").replaceChildren();
  for (const { text } of things()) element("option", { value: text }, null, $("things"));
}

// The thing that is called so: its name, its number as in the shell (p4, room 4), or the first one
// that begins so or has it.
function thingCalled(text) {
  const wanted = text.trim().toLowerCase().replace(/^p(?=\d+$)/, "place ").replace(/^([a-z]+)(?=\d+$)/, "$1 "),
    all = things(),
    said = (one) => one.text.toLowerCase();
  return (
    all.find((one) => said(one) === wanted) ??
    all.find((one) => [`place ${wanted}`, wanted].some((start) => said(one).startsWith(`${start} `))) ??
    all.find((one) => said(one).includes(`(${wanted})`)) ??
    all.find((one) => wanted && said(one).includes(wanted))
  );
}

function find(text) {
  const wanted = text.trim(),
    ssh = mapOf(0),
    t = /^(d|step ?)\d+$|:\d+$/.test(wanted) ? numberOf(wanted) : NaN,
    dstate = ssh.dstates[ssh.labels[t]],
    where = dstate && (dstate.place === null ? "" : ` at ${ssh.called("place", dstate.place)}`),
    one = dstate ? { text: wanted + where, at: dstate.at, steps: [t] } : thingCalled(text);
  $("found").textContent = !wanted ? "" : one ? one.text : `nothing is called ${wanted}`;
  state.found = wanted && one ? one.at : null;
  if (state.found) {
    if (one.steps && !replay().other) setStep(one.steps[0]);
    const home = homes[0],
      z = Math.max(camera.z, Math.min(3, 60 / home.k));
    camera = { dx: -(one.at[0] - home.x) * home.k * z, dy: (one.at[1] - home.y) * home.k * z, z };
    if (one.steps) {
      state.picked = [one.steps[0]];
      judge();
    }
  }
  paintSoon();
}

function paintFound(figure) {
  if (!state.found) return;
  const [x, y] = onScreen(figure, state.found);
  element("svg:circle", { class: "found", cx: x, cy: y, r: 24 }, null, figure.over);
}

// The sections of the report, folded.
function tellReport() {
  $("report").replaceChildren();
  $("report").hidden = !data.report.length;
  for (const { title, lines, table } of data.report) {
    const part = element("details", {}, null, $("report"));
    element("summary", {}, title, part);
    for (const line of lines) element("p", {}, line, part);
    if (!table.length) continue;
    const body = element("table", {}, null, element("div", { class: "wide" }, null, part));
    table.forEach((row, k) => {
      const drawn = element("tr", {}, null, body);
      for (const cell of row) element(k ? "td" : "th", {}, `${cell}`, drawn);
    });
  }
}

// Paper has no folds. The drawing is made for its width, so that names can be read.
let folded = [];
function forPaper(printed) {
  $("stage").classList.toggle("paper", printed);
  settle();
  paint();
}
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  for (const part of folded) part.open = true;
  forPaper(true);
});
addEventListener("afterprint", () => {
  for (const part of folded) part.open = false;
  forPaper(false);
});
