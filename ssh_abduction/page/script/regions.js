// Regions of the map drawn: bands around what lies behind one place, and the sides of paths.

// Bands of a map, the widest first: the places of each region behind one place, and the moves
// between them.
function bandsOf(ssh) {
  const behind = ssh.regions.filter(({ door }) => door !== null),
    contains = (a, b) => a.size > b.size && [...b].every((p) => a.has(p));
  const depth = (region) =>
    Math.max(-1, ...behind.filter((r) => contains(region.places, r.places)).map(depth)) + 1;
  return behind.map((region) => {
    const ways = [...region.places].map((p) => [ssh.places.get(p), ssh.places.get(p), p, p]);
    for (let t = 1; t < ssh.labels.length; t++) {
      const [p, q] = [t - 1, t].map((k) => ssh.dstates[ssh.labels[k]].place);
      if (p !== q && region.places.has(p) && region.places.has(q))
        ways.push([ssh.places.get(p), ssh.places.get(q), p, q]);
    }
    return { ways, depth: depth(region), title: regionTold(ssh, region) };
  });
}

function regionTold(ssh, { id, places, door }) {
  const named = [...places].map((p) => ssh.called("place", p));
  const behind = door === null ? "" : `, behind ${ssh.called("place", door)}`;
  return `${ssh.called("region", id)}: ${named.join(", ")}${behind}`;
}

// The places right and left of a path, as the robot faces in its first direction.
function sidesOf(ssh, path) {
  const found = { right: new Set(), left: new Set() };
  for (const { places, bounds } of ssh.regions)
    for (const [h, way] of bounds)
      if (h === path) for (const p of places) found[way === 1 ? "right" : "left"].add(p);
  return found;
}

function paintBands(figure, see, radius) {
  for (const { ways, depth, title } of figure.bands ?? []) {
    const drawn = element(
      "svg:path",
      {
        class: "band",
        d: ways.map(([a, b]) => `M${point(see(a))} L${point(see(b))}`).join(" "),
        "stroke-width": (3 * radius * (1 + 0.5 * depth)).toFixed(1),
      },
      null,
      figure.base,
    );
    element("svg:title", {}, title, drawn);
  }
}

// Rings around the places of the side or region that was chosen.
function paintChosen(figure) {
  if (!state.region || figure.map !== state.map) return;
  for (const node of figure.nodes)
    for (const [side, places] of Object.entries(state.region.sides))
      if (places.has(node.place)) {
        const [x, y] = onScreen(figure, node.at);
        element(
          "svg:circle",
          { class: classes("beside", side), cx: x, cy: y, r: figure.radius + 5 },
          null,
          figure.over,
        );
      }
}

// A list of the sides of paths, and of the regions that are named or behind one place. A click
// rings their places.
function tellRegions() {
  const list = $("regions"),
    ssh = state.mode === "one" ? mapOf(state.map) : null;
  list.replaceChildren();
  $("regional").hidden = !ssh?.regions.length;
  if (!ssh?.regions.length) return;
  const add = (name, text, sides) => {
    const item = element("li", {}, null, list),
      chosen = state.region?.name === name;
    element("button", { "aria-pressed": chosen }, text, item).addEventListener("click", () => {
      state.region = chosen ? null : { name, sides };
      draw();
    });
  };
  for (const path of ssh.ofPath.keys()) {
    const sides = sidesOf(ssh, path),
      told = ["right", "left"]
        .filter((side) => sides[side].size)
        .map((side) => `${side}: ${[...sides[side]].sort((a, b) => a - b).join(", ")}`);
    if (told.length) add(`path ${path}`, `${ssh.called("path", path)} – ${told.join("; ")}`, sides);
  }
  for (const region of ssh.regions)
    if (region.door !== null || `region ${region.id}` in ssh.names)
      add(`region ${region.id}`, regionTold(ssh, region), { within: region.places });
}
