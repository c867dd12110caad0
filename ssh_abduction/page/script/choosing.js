// Choosing what is drawn, with the legend.

function draw(keep = true) {
  const last = data.maps.length - 1;
  state.map = Math.min(state.map, last);
  state.other = Math.min(state.other, last);
  $("drawings").replaceChildren();
  const told =
    state.mode === "overview"
      ? [overviewFigure()]
      : state.mode === "one"
        ? [mapFigure(state.map, null)]
        : [mapFigure(state.map, state.other), mapFigure(state.other, state.map)];
  figures = told.map(newFigure);
  if (!keep || !settled()) settle();
  paint();
  for (const name of ["overview", "one", "two"])
    $(name).setAttribute("aria-pressed", state.mode === name);
  $("moves").hidden = state.mode === "overview" || !last;
  $("second").hidden = state.mode !== "two";
  $("two").disabled = !last;
  $("number").max = $("other").max = last + 1;
  $("number").value = state.map + 1;
  $("other").value = state.other + 1;
  $("back").disabled = state.map === 0;
  $("next").disabled = state.map === last;
  $("labels").disabled = nextMap((one, now) => one.labeling !== now.labeling) === null;
  $("paths").hidden = !data.orders.some((order) => order.length);
  $("paths").disabled = nextMap((one, now) => one.labeling === now.labeling) === null;
  about();
  tellRegions();
  legend();
  tellBelief();
}

function legend() {
  $("legend").replaceChildren();
  const rows = [];
  if (state.mode === "overview" && data.maps.length > 1)
    rows.push(
      ["street", "", "all maps"],
      ["street", "most", "more than two thirds"],
      ["street", "half", "about half"],
      ["street", "few", "less than a third"],
      ["dstate", "hollow half", "rivals differ in what else is along its path"],
    );
  if (state.mode === "two")
    rows.push(
      ["street", "", "as in the other map"],
      ["street", "differs", "not so in the other map"],
      ["street", "course", "there too, but along another path"],
    );
  if (state.mode === "one" && mapOf(state.map).streets.some((street) => !street.travelled))
    rows.push(["street", "order", "not travelled: the order of the path implies it"]);
  if (data.places[0].some(([place]) => place !== null))
    rows.push(["node", "", data.ground ? "a place; small if the robot only passed it" : "a place"]);
  if (layers.has("arrows")) rows.push(["dstate", "", "a dstate, with its heading"]);
  if (data.ground) rows.push(["way", "", "a way out of a place"]);
  if (data.indoors.doors?.length) rows.push(["door", "", "a door"]);
  data.drives.forEach(({ name }, k) => rows.push(["trail", colourOf(k), `the way of ${name}`]));
  if (!replay().other) rows.push(["here", "", "where the robot is at this step"]);
  if (replay().beliefs)
    rows.push(["believed", "", "where the robot may be: larger is more probable"]);
  if (figures.some((figure) => figure.bands?.length))
    rows.push(["band", "", "a region: all known ways to it lead through one place"]);
  if (state.region && state.mode === "one")
    for (const side of Object.keys(state.region.sides))
      rows.push([
        "beside",
        side,
        side === "within" ? `in ${state.region.name}` : `${side} of ${state.region.name}`,
      ]);
  if (layers.has("ellipses") && figures.some((figure) => figure.layout?.ellipses?.length))
    rows.push(["ellipse", "", "two standard deviations of a position"]);
  const changes = data.faults.some(([, , kind]) => kind === "changed");
  if (data.faults.length)
    rows.push([
      "fault",
      "",
      changes
        ? "a gateway that changed between drives"
        : state.mode === "one"
          ? "a step that the map treats as wrong"
          : "a step that all maps treat as wrong",
    ]);
  if (data.faults.length && state.mode !== "one")
    rows.push([
      "fault",
      "disputed",
      changes
        ? "a gateway that did not change in other maps"
        : state.mode === "two"
          ? "not treated as wrong by the other map"
          : "treated as wrong by some maps",
    ]);
  for (const [shape, kind, text] of rows) {
    const row = element("p", { class: "key" }, null, $("legend")),
      svg = element("svg:svg", { viewBox: "0 0 38 16", "aria-hidden": "true" }, null, row);
    if (shape === "trail")
      element("svg:path", { d: "M2,8 H36", class: classes("trail", kind) }, null, svg);
    else if (shape === "way") element("svg:path", { d: "M12,8 H26", class: shape }, null, svg);
    else if (shape === "street")
      element(
        "svg:path",
        {
          d: "M2,8 H36",
          class: classes("street", kind),
          "stroke-width": kind === "order" ? 1.5 : 4,
        },
        null,
        svg,
      );
    else if (shape === "dstate")
      element(
        "svg:path",
        { d: arrowAt(19, 8, 1, 0, 7), class: classes("dstate", kind) },
        null,
        svg,
      );
    else if (shape === "band")
      element("svg:path", { d: "M10,8 H28", class: shape, "stroke-width": 14 }, null, svg);
    else if (shape === "ellipse")
      element("svg:ellipse", { cx: 19, cy: 8, rx: 14, ry: 6, class: shape }, null, svg);
    else if (shape === "fault") {
      const mark = element("svg:g", { class: classes("fault", kind) }, null, svg);
      element("svg:path", { d: "M19,0 l8,8 l-8,8 l-8,-8 Z" }, null, mark);
      element("svg:text", { x: 19, y: 8, "font-size": 11 }, "!", mark);
    } else element("svg:circle", { cx: 19, cy: 8, r: 6, class: shape }, null, svg);
    element("span", {}, text, row);
  }
}

// The word before what a fault says. Faults of kind "changed" are no errors of the trace.
function faultWord(kind) {
  return kind === "changed" ? "Changed between drives" : "Disbelieved";
}

function about() {
  $("about").replaceChildren();
  if (state.mode === "overview") {
    element("p", {}, `${counted(data.maps.length, "map")} of ${data.file}`, $("about"));
    return;
  }
  for (const i of state.mode === "two" ? [state.map, state.other] : [state.map]) {
    const ssh = mapOf(i);
    const paths = data.orders[data.maps[i].orders].length;
    const counts = [counted(ssh.dstates.length, "dstate")];
    if (ssh.places.size) counts.push(counted(ssh.places.size, "place"));
    if (paths) counts.push(counted(paths, "path"));
    element("p", {}, `Map ${i + 1}: ${counts.join(", ")}`, $("about"));
    for (const [, text, kind] of ssh.faults)
      element("p", {}, `${faultWord(kind)}: ${text}`, $("about"));
  }
}

// The next map that is wanted after the one drawn. The first map comes after the last.
function nextMap(wanted) {
  const count = data.maps.length,
    now = data.maps[state.map];
  for (let k = 1; k < count; k++) {
    const i = (state.map + k) % count;
    if (wanted(data.maps[i], now)) return i;
  }
  return null;
}

function go(i) {
  if (i === null || !(i >= 0 && i < data.maps.length)) {
    draw();
    return;
  }
  state.map = i;
  state.region = null;
  if (state.mode === "overview") state.mode = "one";
  draw();
}

function setMode(mode) {
  if (mode === "two" && data.maps.length < 2) return;
  state.mode = mode;
  if (mode === "two" && state.other === state.map) state.other = state.map ? 0 : 1;
  draw(false);
}
