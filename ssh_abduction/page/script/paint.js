// Painting figures as SVG.

// Paint a figure as the camera sees it.
function paintFigure(figure) {
  const box = figure.svg.getBoundingClientRect(),
    [width, height] = [box.width, box.height];
  const home = homes[figures.indexOf(figure)];
  Object.assign(figure, { width, height, home, k: home.k * camera.z, marks: [], boxes: [] });
  figure.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  figure.base.replaceChildren();
  const usual = (figure.crowding ??= crowding(figure.points)) * figure.k;
  const r = Math.min(12, Math.max(3, 0.17 * usual)); // the radius of a place that no other place is near
  figure.radius = r;
  // Over walls, places that the robot only passed are dots, and the others have room for numbers.
  const apart = data.ground
    ? figure.nodes.filter((node) => !node.passed).map((node) => node.at)
    : figure.points;
  figure.nearest ??= nearestOf(apart);
  const [part, most] = data.ground ? [0.45, Math.max(r, 9)] : [0.36, r];
  const radii = new Map(
      apart.map((at, k) => [
        `${at}`,
        Math.min(most, Math.max(3, part * figure.nearest[k] * figure.k)),
      ]),
    ),
    radiusAt = (at) => radii.get(`${at}`) ?? r;
  const see = (at) => onScreen(figure, at);
  const spots = figure.nodes.map((node) => see(node.at));
  for (const name of LAYERS) figure.svg.classList.toggle(`no-${name}`, !layers.has(name));
  if (data.ground) paintGround(figure, see);
  else paintBands(figure, see, r);
  for (const street of figure.streets)
    if (!street.course) paintStreet(figure, street, see(street.a), see(street.b), spots, r);
  paintTrails(figure, see);
  paintEllipses(figure, see);
  figure.nodes.forEach((node, k) => {
    const [x, y] = spots[k],
      r = node.passed && data.ground ? Math.min(4, radiusAt(node.at)) : radiusAt(node.at);
    if (data.ground && !node.passed) paintGateways(figure, spots[k], node, r);
    const circle = element(
      "svg:circle",
      { cx: x.toFixed(1), cy: y.toFixed(1), r: r.toFixed(1), class: classes("node", node.kind) },
      null,
      figure.base,
    );
    if (node.doubt) {
      circle.classList.add("doubtful");
      label(figure, node.doubt, spots[k], r + 2, [[1, 0], [0, 1], [-1, 0], [0, -1]], "doubt", true);
    }
    const doubt = node.doubt ? `; a join here has probability ${node.doubt}` : "";
    element("svg:title", {}, node.title + doubt, circle);
    keep(figure, x, y, r, r);
    if (node.name && r >= 6)
      element(
        "svg:text",
        {
          class: "name inside",
          x: x.toFixed(1),
          y: y.toFixed(1),
          "font-size": Math.min(12, r * 1.15, (3 * r) / node.name.length).toFixed(1),
        },
        node.name,
        figure.base,
      );
  });
  if (layers.has("arrows") || !figure.nodes.length) paintMarks(figure, see, radiusAt);
  else
    figure.nodes.forEach((node, k) => {
      const [x, y] = spots[k];
      figure.marks.push({ ...node, name: null, x, y, size: radiusAt(node.at), angle: null, dot: true });
    });
  // Names that a person gave are drawn always, and first where they cover nothing.
  figure.nodes.forEach((node, k) => {
    const near = radiusAt(node.at) + 2,
      sides = [0, 4, 2, 6, 1, 3, 5, 7].map((eighth) => (eighth * Math.PI) / 4),
      directions = sides.map((angle) => [Math.sin(angle), Math.cos(angle)]);
    if (node.own && ![near, 2 * near, 3 * near].some((far) => named(far, directions)))
      named(near, directions, true);
    function named(far, directions, always) {
      return label(figure, node.own, spots[k], far, directions, "own", always);
    }
  });
  if (data.ground) nameGround(figure, see);
  paintFloors(figure, see, r);
  const named = new Set();
  for (const m of figure.marks)
    if (m.name && usual > (figure.marks.length > 150 ? 70 : m.bare ? 24 : 40))
      label(figure, m.name, [m.x, m.y], m.size + 2, around(m));
  for (const street of figure.streets)
    if (street.names && usual > 60) {
      const [x, y, c, s] = street.middle;
      label(
        figure,
        street.names.length > 24 ? `${street.names.slice(0, 23)}…` : street.names,
        [x, y],
        3,
        [
          [c, s],
          [-c, -s],
        ],
        "soft",
      );
    }
  for (const street of figure.streets)
    if (street.path !== undefined && !named.has(street.path)) {
      const [[ax, ay], [bx, by]] = [see(street.a), see(street.b)],
        far = Math.hypot(bx - ax, by - ay) || 1,
        [nx, ny] = [-(by - ay) / far, (bx - ax) / far];
      if (
        far > 60 &&
        [0.5, 0.35, 0.65].some((part) =>
          label(
            figure,
            street.called,
            [ax + (bx - ax) * part, ay + (by - ay) * part],
            6,
            [
              [nx, ny],
              [-nx, -ny],
            ],
            "path",
          ),
        )
      )
        named.add(street.path);
    }
  // Over walls, places that the robot only passed have their numbers where there is room.
  if (data.ground && figure.k > 8)
    figure.nodes.forEach((node, k) => {
      if (node.passed && !node.own) label(figure, node.name, spots[k], 6, around({ angle: null }), "number");
    });
  paintFaults(figure, r);
  paintScale(figure);
}

// Paint a street, bent if it would run through a place that is not one of its ends.
function paintStreet(figure, street, a, b, spots, r) {
  const far = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1,
    [ux, uy] = [(b[0] - a[0]) / far, (b[1] - a[1]) / far];
  let met = 0;
  if (!street.headed)
    for (const [x, y] of spots) {
      const along = (x - a[0]) * ux + (y - a[1]) * uy,
        aside = (y - a[1]) * ux - (x - a[0]) * uy;
      if (
        along > r &&
        along < far - r &&
        Math.abs(aside) < r + 2 &&
        Math.hypot(x - a[0], y - a[1]) > 1 &&
        Math.hypot(x - b[0], y - b[1]) > 1
      )
        met += aside > 0 ? -1 : 1.5;
    }
  const bend = street.headed
    ? Math.min(0.2 * far, 34)
    : met
      ? Math.sign(met) * Math.min(0.4 * far, 4.5 * r + 0.05 * far)
      : 0;
  const [mx, my] = [(a[0] + b[0]) / 2 - uy * bend, (a[1] + b[1]) / 2 + ux * bend];
  const way = bend ? `M${point(a)} Q${point([mx, my])} ${point(b)}` : `M${point(a)} L${point(b)}`;
  if (street.headed) {
    // An arrow before the dstate that the link leads to, and the actions beside the middle.
    const away = Math.hypot(b[0] - mx, b[1] - my) || 1,
      [c, s] = [(b[0] - mx) / away, (b[1] - my) / away];
    street.head = [b[0] - c * (r + 6), b[1] - s * (r + 6), c, s];
    street.middle = [
      (a[0] + b[0]) / 2 - (uy * bend) / 2,
      (a[1] + b[1]) / 2 + (ux * bend) / 2,
      -uy,
      ux,
    ];
  }
  const drawn = element(
    "svg:path",
    {
      d: way,
      class: classes("street", street.kind, coloured(street.colour)),
      "stroke-width": (street.kind.includes("order") || street.headed
        ? 1.5
        : Math.min(5, Math.max(1.5, 0.4 * r))
      ).toFixed(1),
    },
    null,
    figure.base,
  );
  element("svg:title", {}, street.title, drawn);
  if (street.headed)
    element(
      "svg:path",
      { d: arrowAt(...street.head, 6), class: classes("head", street.kind) },
      null,
      figure.base,
    );
  if (street.inner)
    element(
      "svg:path",
      {
        d: way,
        class: classes("street", street.inner, "inner"),
        "stroke-width": Math.min(2.5, Math.max(1, 0.2 * r)).toFixed(1),
      },
      null,
      figure.base,
    );
}

// Two standard deviations of the position of a place relative to the first dstate.
function paintEllipses(figure, see) {
  for (const [u, v, major, minor, angle] of figure.layout?.ellipses ?? []) {
    const [x, y] = see([u, v]),
      [rx, ry] = [2 * major * figure.k, 2 * minor * figure.k];
    if (rx < figure.radius) continue;
    const drawn = element(
      "svg:ellipse",
      {
        class: "ellipse",
        rx: rx.toFixed(1),
        ry: Math.max(2, ry).toFixed(1),
        transform: `translate(${point([x, y])}) rotate(${((-angle * 180) / Math.PI).toFixed(1)})`,
      },
      null,
      figure.base,
    );
    element(
      "svg:title",
      {},
      "two standard deviations of this position, relative to the first dstate",
      drawn,
    );
  }
}

// Paint dstates on the side of their place that they face, to the right of the line of their path,
// and farther out where there are many. A dstate without a heading is a dot.
function paintMarks(figure, see, radiusAt) {
  const crowds = new Map();
  figure.arrows.forEach((arrow) => {
    const key = arrow.at.map((n) => n.toFixed(3)).join(" ");
    crowds.set(key, [...(crowds.get(key) ?? []), arrow]);
  });
  for (const crowd of crowds.values()) {
    const r = radiusAt(crowd[0].at),
      size = Math.max(3.5, r * 0.85);
    const headed = crowd.filter((m) => m.heading !== null).sort((p, q) => p.heading - q.heading);
    let least = Math.PI / 2;
    headed.forEach((m, k) => {
      const next = headed[(k + 1) % headed.length],
        gap = (next.heading - m.heading + 2 * Math.PI) % (2 * Math.PI);
      if (headed.length > 1 && gap > 0.15) least = Math.min(least, gap);
    });
    const bare = crowd[0].bare && crowd.length === 1,
      ring = bare ? 0 : Math.min(Math.max(r + size * 0.8, (1.7 * size) / least), 3.2 * r + size);
    let level = 0;
    crowd.forEach((m) => {
      const k = headed.indexOf(m),
        angle = m.heading ?? (bare ? null : (2 * Math.PI * crowd.indexOf(m)) / crowd.length);
      level = k > 0 && Math.abs(m.heading - headed[k - 1].heading) <= 0.15 ? level + 1 : 0;
      const [c, s] = angle === null ? [0, 0] : [Math.cos(angle), -Math.sin(angle)],
        lane = m.heading === null || bare ? 0 : Math.min(0.45 * r, 5),
        far = ring + level * 1.5 * size;
      const [px, py] = see(m.at),
        [x, y] = [px + c * far - s * lane, py + s * far + c * lane];
      const shape =
        m.heading === null
          ? element("svg:circle", {
              cx: x.toFixed(1),
              cy: y.toFixed(1),
              r: (bare ? r : size * 0.6).toFixed(1),
            })
          : element("svg:path", { d: arrowAt(x, y, c, s, size) });
      const group = element(
        "svg:g",
        { class: "mark", "data-step": m.steps[0], "data-mark": figure.marks.length },
        null,
        figure.base,
      );
      group.append(shape);
      for (const [name, value] of Object.entries({
        class: classes("dstate", m.kind, coloured(m.colour)),
        "data-step": m.steps[0],
        "data-mark": figure.marks.length,
      }))
        shape.setAttribute(name, value);
      element("svg:title", {}, m.title, shape);
      keep(figure, x, y, size, size);
      figure.marks.push({
        ...m,
        x,
        y,
        c,
        s,
        angle,
        size: bare && m.heading === null ? r : size,
        dot: m.heading === null,
      });
    });
  }
}

// Write a point as data of an SVG path.
function point([x, y]) {
  return `${x.toFixed(1)},${y.toFixed(1)}`;
}

// Write an arrow at (x, y) in the direction (c, s) as data of an SVG path.
function arrowAt(x, y, c, s, size) {
  const p = (u, v) => point([x + c * u * size - s * v * size, y + s * u * size + c * v * size]);
  return `M${p(1, 0)} L${p(-0.7, 0.75)} L${p(-0.35, 0)} L${p(-0.7, -0.75)} Z`;
}

// The directions from a mark for its label: to its right, ahead, between these, to its left.
function around(m) {
  if (m.angle === null)
    return [
      [0, -1],
      [0, 1],
      [1, 0],
      [-1, 0],
    ];
  return [
    [0, 1],
    [1, 0],
    [0.7, 0.7],
    [0, -1],
    [0.7, -0.7],
    [-0.7, 0.7],
  ].map(([u, v]) => [m.c * u - m.s * v, m.s * u + m.c * v]);
}

// Name each floor beside its upper left corner. The floors are drawn below each other.
function paintFloors(figure, see, r) {
  for (const [k, corner] of (figure.layout?.floors ?? []).entries())
    label(
      figure,
      `floor ${k}`,
      see(corner),
      3 * r,
      [
        [-1, 0],
        [-0.7, -0.7],
        [0, -1],
        [0.7, -0.7],
      ],
      "floor",
    );
}

function paintFaults(figure, r) {
  const at = new Map();
  for (const fault of figure.faults) {
    const m = figure.marks.find((mark) => mark.steps.includes(fault.step));
    if (m) at.set(m, [...(at.get(m) ?? []), fault]);
  }
  const u = Math.max(7, r * 0.7);
  for (const [m, told] of at) {
    const far = m.size + u + 5,
      [x, y] = m.angle === null ? [m.x, m.y - far] : [m.x + m.c * far, m.y + m.s * far];
    const group = element(
      "svg:g",
      { class: classes("fault", told.every(({ disputed }) => disputed) && "disputed") },
      null,
      figure.base,
    );
    element("svg:title", {}, told.map(({ title }) => title).join("; "), group);
    element("svg:path", { d: `M${x},${y - u} l${u},${u} l${-u},${u} l${-u},${-u} Z` }, null, group);
    element("svg:text", { x, y, "font-size": (1.3 * u).toFixed(1) }, "!", group);
  }
}

function paintScale(figure) {
  if (!figure.layout?.metric) return;
  const metre = figure.k / figure.layout.unit,
    most = 110 / metre,
    ten = 10 ** Math.floor(Math.log10(most)),
    metres = [5, 2, 1].map((k) => k * ten).find((m) => m <= most) ?? ten;
  const group = element("svg:g", { class: "scale" }, null, figure.base),
    x = figure.width - 14 - metres * metre,
    y = figure.height - 12;
  element("svg:path", { d: `M${x},${y - 5} v10 m0,-5 h${metres * metre} m0,-5 v10` }, null, group);
  element("svg:text", { x: x + (metres * metre) / 2, y: y - 6 }, `${metres} m`, group);
}

// Paint what changes with the step and with the picked steps.
function paintOver(figure) {
  figure.under.replaceChildren();
  figure.over.replaceChildren();
  paintChosen(figure);
  paintFound(figure);
  if (data.ground) paintLaser(figure);
  paintPoints(figure);
  const beliefs = replay().beliefs,
    labeling = figure.map === null ? Object.keys(beliefs ?? {})[0] : data.maps[figure.map].labeling,
    belief = beliefs?.[labeling]?.[state.step];
  if (belief)
    for (const [s, p] of belief[2]) {
      const steps = data.labelings[labeling].labels.flatMap((x, t) => (x === s ? [t] : [])),
        m = figure.marks.find((mark) =>
          figure.map === null ? `${mark.steps}` === `${steps}` : mark.dstate === s,
        );
      if (!m) continue;
      const disc = element(
        "svg:circle",
        {
          class: "believed",
          cx: m.x,
          cy: m.y,
          r: (m.size + 2 + Math.sqrt(p) * 1.3 * (figure.radius + 4)).toFixed(1),
        },
        null,
        figure.under,
      );
      element("svg:title", {}, `the robot is here with probability ${p}`, disc);
    }
  for (const m of figure.marks) {
    if (!replay().other && m.steps.includes(state.step)) {
      element("svg:circle", { class: "here", cx: m.x, cy: m.y, r: m.size + 4 }, null, figure.over);
      if (!data.ground) // else the robot is drawn where it was
        element(
        m.dot ? "svg:circle" : "svg:path",
        m.dot
          ? { class: "herefill", cx: m.x, cy: m.y, r: m.size }
          : { class: "herefill", d: arrowAt(m.x, m.y, m.c, m.s, m.size * 1.15) },
        null,
        figure.over,
      );
    }
    state.picked.forEach((t, k) => {
      if (!m.steps.includes(t)) return;
      element(
        "svg:circle",
        { class: "picked", cx: m.x, cy: m.y, r: m.size + 10 + 3 * k },
        null,
        figure.over,
      );
      element(
        "svg:text",
        { class: "name tag", x: m.x + (k ? 1 : -1) * (m.size + 15), y: m.y - m.size - 11 },
        "AB"[k],
        figure.over,
      );
    });
  }
}

function paint() {
  for (const figure of figures) {
    paintFigure(figure);
    paintOver(figure);
  }
}
