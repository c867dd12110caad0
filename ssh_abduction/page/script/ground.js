// The ground of a log: walls, rooms and corridors, and the courses of the robot, in metres. It is
// made once for a figure. The camera only moves it.

const NEAR = 1, // metres: nearer to a place than this, a course leads straight to its middle
  BESIDE = 0.75, // metres: a course is not drawn where it is this near to a shorter one
  FINE = 0.25; // metres between two points of a course

function pathOf(points, close = false) {
  return points.length ? `M${points.map((p) => p.join(",")).join("L")}${close ? "Z" : ""}` : "";
}

// The way of the robot from a step to the next one, with its ends at the middles of places.
function courseOf(t, a, b) {
  const { way, at } = data.ground;
  const far = ([x, y]) => [a, b].every(([u, v]) => Math.hypot(x - u, y - v) >= NEAR);
  return [a, ...way.slice(at[t], at[t + 1] + 1).filter(far), b];
}

// The course of each street, by its two nodes. `nodeOf` gives the node of each step.
function coursesOf(streets, nodeOf) {
  const first = new Map();
  nodeOf.forEach((node, t) => {
    const key = `${[nodeOf[t - 1], node].sort((p, q) => p - q)}`;
    if (t && nodeOf[t - 1] !== node && !first.has(key)) first.set(key, t - 1);
  });
  for (const street of streets) {
    const t = first.get(`${[street.from, street.to].sort((p, q) => p - q)}`);
    if (t === undefined) continue;
    const ends = nodeOf[t] === street.from ? [street.a, street.b] : [street.b, street.a];
    street.course = courseOf(t, ...ends);
  }
  const kinds = new Map();
  for (const street of streets.filter((one) => one.course))
    kinds.set(street.kind, [...(kinds.get(street.kind) ?? []), street]);
  for (const alike of kinds.values()) drawOnce(alike);
}

function resampled(course) {
  const points = [course[0]];
  for (let k = 1; k < course.length; k++) {
    const [[x, y], [u, v]] = [course[k - 1], course[k]],
      parts = Math.ceil(Math.hypot(u - x, v - y) / FINE);
    for (let i = 1; i <= parts; i++) points.push([x + ((u - x) * i) / parts, y + ((v - y) * i) / parts]);
  }
  return points;
}

// Cut off the parts of courses that run beside a shorter course. What is left of one begins and
// ends on the lines that it leaves.
function drawOnce(streets) {
  const cells = new Map(),
    cell = (n) => Math.floor(n / BESIDE);
  const near = ([x, y]) => {
    let best = null;
    for (const i of [-1, 0, 1])
      for (const j of [-1, 0, 1])
        for (const p of cells.get(`${cell(x) + i} ${cell(y) + j}`) ?? []) {
          const far = Math.hypot(p[0] - x, p[1] - y);
          if (far <= BESIDE && (!best || far < best.far)) best = { p, far };
        }
    return best?.p ?? null;
  };
  const fine = streets.map((street) => ({ street, points: resampled(street.course) }));
  for (const { street, points } of fine.sort((p, q) => p.points.length - q.points.length)) {
    street.parts = [];
    let part = null;
    points.forEach((point, k) => {
      const beside = near(point);
      if (!beside) {
        if (!part) street.parts.push((part = k && near(points[k - 1]) ? [near(points[k - 1])] : []));
        part.push(point);
      } else if (part) {
        part.push(beside);
        part = null;
      }
    });
    for (const p of street.parts.flat()) {
      const key = `${cell(p[0])} ${cell(p[1])}`;
      cells.set(key, [...(cells.get(key) ?? []), p]);
    }
  }
}

function buildGround(figure) {
  const { walls, box } = data.ground,
    { rooms = [], corridors = [] } = data.indoors,
    holder = figure.ground;
  holder.replaceChildren();
  const add = (attributes, title) => {
    const drawn = element("svg:path", attributes, null, holder);
    if (title) element("svg:title", {}, title, drawn);
  };
  for (const [k, { title, line }] of rooms.entries())
    if (line.length) add({ class: `room path${k % COLOURS}`, d: pathOf(line, true) }, title);
  for (const { title, path, line } of corridors)
    add({ class: `corridor path${path % COLOURS}`, d: pathOf(line) }, title);
  for (const { ways, depth, title } of figure.bands ?? []) {
    const courses = ways.map(([a, b, p, q]) => figure.courses.get(pairKey(p, q)) ?? [a, b]);
    const d = courses.map((course) => pathOf(course)).join(" ");
    add({ class: "band", d, "stroke-width": 24 * (1 + 0.5 * depth) }, title);
  }
  element(
    "svg:image",
    {
      class: "walls",
      href: walls,
      x: box[0],
      y: -box[1],
      width: box[2],
      height: box[3],
      transform: "scale(1 -1)",
      preserveAspectRatio: "none",
    },
    null,
    holder,
  );
  for (const street of figure.streets)
    if (street.course) {
      const d = street.parts.map((part) => pathOf(part)).join(" ") || "M0,0";
      const kind = classes("street", street.kind, coloured(street.colour));
      add({ class: kind, d, "stroke-width": street.kind.includes("order") ? 1.5 : 4 }, street.title);
      if (street.inner)
        add({ class: classes("street inner", street.inner), d, "stroke-width": 2 });
    }
  for (const [k, { name, first, stop }] of data.drives.entries()) {
    const way = data.ground.way.slice(data.ground.at[first], data.ground.at[stop - 1] + 1);
    add({ class: classes("trail", colourOf(k)), d: pathOf(way) }, `the way of ${name}`);
  }
  figure.laser = element("svg:path", { class: "laser" }, null, holder);
}

// Move the ground under the camera, and name its rooms and corridors.
function paintGround(figure, see) {
  const [x, y] = see([0, 0]);
  // Far away, a point of a wall is less than a pixel, and must not be left out.
  figure.ground.classList.toggle("near", figure.k * (data.ground.grain) > 1.5);
  figure.ground.setAttribute("transform", `translate(${x} ${y}) scale(${figure.k} ${-figure.k})`);
  for (const { title, at } of data.indoors.doors ?? []) {
    const [u, v] = see(at),
      door = element("svg:circle", { class: "door", cx: u, cy: v, r: 4 }, null, figure.base);
    element("svg:title", {}, title, door);
  }
}

// The point of a line behind a share of its length.
function along(line, share) {
  const legs = line.slice(1).map(([x, y], k) => Math.hypot(x - line[k][0], y - line[k][1]));
  let far = legs.reduce((sum, leg) => sum + leg, 0) * share,
    k = 0;
  while (k < legs.length - 1 && far > legs[k]) far -= legs[k++];
  return line[k].map((p, i) => p + (far / legs[k]) * (line[k + 1][i] - p));
}

function nameGround(figure, see) {
  const around = [
    [0, -1],
    [0, 1],
    [1, 0],
    [-1, 0],
  ];
  const { corridors = [], rooms = [] } = data.indoors;
  for (const thing of [...corridors, ...rooms]) {
    const { title, line, named, bears } = thing;
    // The name of a corridor is enough for its room, unless a person has named that, too.
    if (!line.length || (bears && !named)) continue;
    const xs = line.map(([x]) => x),
      ys = line.map(([, y]) => y);
    if ((Math.max(...xs) - Math.min(...xs) + Math.max(...ys) - Math.min(...ys)) * figure.k < 90)
      continue;
    const middle = [0, 1].map((k) => line.reduce((sum, p) => sum + p[k], 0) / line.length);
    const spots = corridors.includes(thing)
      ? [0.5, 0.35, 0.65, 0.2, 0.8].map((share) => along(line, share))
      : [middle];
    const placed = [10, 24].some((far) =>
      spots.some((at) => label(figure, title, see(at), far, around, "inroom")),
    );
    // Names that a person gave are drawn always.
    if (named && !placed) label(figure, title, see(spots[0]), 10, around, "inroom", true);
  }
}

// A short line for each gateway of a place, as its last visit saw it.
function paintGateways(figure, [x, y], node, r) {
  const t = node.steps.at(-1),
    heading = data.spots[t][2];
  for (const [bearing, open] of data.replays.at(-1).steps[t].star ?? []) {
    if (!open) continue;
    const angle = heading - (bearing * Math.PI) / 180,
      [c, s] = [Math.cos(angle), -Math.sin(angle)],
      ends = [r, r + 7].map((far) => point([x + c * far, y + s * far]));
    element("svg:path", { class: "way", d: `M${ends[0]} L${ends[1]}` }, null, figure.base);
  }
}

// The laser, and the robot, over the map: of the scan at this time, else of the step.
function paintLaser(figure) {
  const { scans, way, headings } = data.ground,
    k = state.scan === null ? null : scans.images.findLastIndex((text, k) => text !== null && k <= state.scan),
    spot = replay().other ? undefined : k === null ? data.spots[state.step] : [...way[k], headings[k]],
    images = k === null ? replay().images : scans,
    text = images?.images[k ?? state.step] ?? null;
  figure.laser.setAttribute("d", "");
  if (!spot) return;
  const [x, y, heading] = spot;
  if (text !== null) {
    const points = [...text].flatMap((c, k) => {
      if (c === "!") return [];
      const angle = heading + ((images.first + images.step * k) * Math.PI) / 180,
        far = (images.reach * ALPHABET.indexOf(c)) / (ALPHABET.length - 1);
      return [[(x + Math.cos(angle) * far).toFixed(2), (y + Math.sin(angle) * far).toFixed(2)]];
    });
    figure.laser.setAttribute("d", pathOf([[x, y], ...points], true));
  }
  const [u, v] = onScreen(figure, spot),
    d = arrowAt(u, v, Math.cos(heading), -Math.sin(heading), 11);
  element("svg:path", { class: "herefill", d }, null, figure.over);
}
