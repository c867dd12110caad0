// What is drawn: the overview of all maps, or one map, perhaps beside a rival.

// A figure before its size is known: nodes {at, kind, title, name, steps}, arrows {at, heading,
// kind, title, name, steps, dstate}, streets {a, b, kind, title}, faults {step, disputed, title}.
function overviewFigure() {
  const all = data.maps.length,
    { nodes, dstates, streets } = data.overview,
    together = new Map();
  const figure = {
    map: null,
    caption:
      all === 1
        ? "The map"
        : `What all ${all} maps share is solid. What only some have is dashed, ` +
          "in colours that show how many",
  };
  const isPlaces = dstates.length > 0;
  // A place that the first map has is called as there.
  const first = mapOf(0),
    numbers = new Map([...first.ofPlace].map(([p, steps]) => [`${steps}`, p]));
  figure.nodes = isPlaces
    ? nodes.map((node) => {
        const p = numbers.get(`${node.steps}`),
          place = p === undefined ? "a place" : first.called("place", p);
        return {
          at: [node.x, node.y],
          name: p === undefined ? undefined : `${p}`,
          own: first.names[`place ${p}`],
          passed: first.passed.has(p),
          kind: share(node.maps),
          steps: node.steps,
          title: `${place}: ${stretches(node.steps)}: in ${node.maps} of ${all} maps`,
        };
      })
    : [];
  for (const [k, node] of nodes.entries())
    for (const t of node.steps) if (!together.has(t)) together.set(t, k);
  figure.arrows = (isPlaces ? dstates : nodes).map((s) => {
    const hollow = isPlaces && s.path < s.maps && s.maps === all;
    const along =
      isPlaces && s.path < s.maps
        ? `; what is along its path is the same in ${s.path} of them`
        : "";
    return {
      at: [s.x, s.y],
      heading: s.heading,
      kind: hollow ? `hollow ${share(s.path)}` : share(s.maps),
      title: `dstate of ${stretches(s.steps)}: in ${s.maps} of ${all} maps${along}`,
      steps: s.steps,
      name: isPlaces ? null : called(s.steps[0]),
      dstate: null,
      bare: !isPlaces,
    };
  });
  const at = nodes.map((node) => [node.x, node.y]);
  figure.streets = streets
    .map(([a, b, count, path]) => ({
      a: at[a],
      b: at[b],
      from: a,
      to: b,
      kind: share(count),
      count,
      inner: count === all && path < count ? share(path) : null,
      title:
        `${isPlaces ? "a street" : "a link"} that ${count} of ${all} maps have` +
        (path < count ? `; what else is along its path is the same in ${path} of them` : ""),
    }))
    .sort((p, q) => p.count - q.count);
  figure.streets.unshift(...liftsOf(data.layouts[data.maps[0].layout]));
  const nodeOf = [];
  for (const [t, k] of together) nodeOf[t] = k;
  if (data.ground) coursesOf(figure.streets, nodeOf);
  const known = new Map();
  for (const told of data.maps)
    for (const k of told.faults ?? []) known.set(k, (known.get(k) ?? 0) + 1);
  figure.faults = [...known].map(([k, count]) => ({
    step: data.faults[k][0],
    disputed: count < all,
    title: `${data.faults[k][1]}: in ${count} of ${all} maps`,
  }));
  figure.points = at;
  figure.layout = data.layouts[data.maps[0].layout] ?? groundLayout();
  figure.labels = labelsOf(0);
  return figure;
}

function mapFigure(i, rival) {
  const ssh = mapOf(i),
    other = rival === null ? null : mapOf(rival);
  const figure = {
    map: i,
    caption:
      `Map ${i + 1} of ${data.maps.length}, ${ssh.id}` +
      (ssh.chi2 === undefined ? "" : `, chi-square ${ssh.chi2}`) +
      (other ? "; dashed: not so in the other one" : ""),
  };
  const kindOf = (key, path) =>
    !other
      ? ""
      : !other.keys.has(key)
        ? "differs"
        : path !== null && path !== undefined && !other.keys.has(`h${ssh.ofPath.get(path)}`)
          ? "course"
          : "";
  // The probability of the most doubtful join at each place. Joins are of the first map.
  const doubts = new Map();
  for (const [, b, probability] of i === 0 ? data.joins : []) {
    const place = ssh.dstates[ssh.labels[b]].place;
    if (probability !== null && !doubts.has(place)) doubts.set(place, probability);
  }
  figure.nodes = [...ssh.places].map(([p, at]) => ({
    at,
    doubt: doubts.get(p),
    place: p,
    name: `${p}`,
    own: ssh.names[`place ${p}`],
    steps: ssh.ofPlace.get(p) ?? [],
    passed: ssh.passed.has(p),
    kind: kindOf(`p${ssh.ofPlace.get(p) ?? []}`),
    title: `${ssh.called("place", p)}: ${stretches(ssh.ofPlace.get(p) ?? [])}`,
  }));
  figure.arrows = ssh.dstates.map((s) => {
    const kind = kindOf(`d${s.steps}`, s.path),
      path = s.path === null ? "" : `; path ${s.path}${s.direction === -1 ? ", backwards" : ""}`;
    return {
      at: s.at,
      heading: s.heading,
      kind,
      colour: other ? null : colourAt(s.steps, s.path),
      title: `dstate ${s.id}, ${s.view}: ${stretches(s.steps)}${path}`,
      steps: s.steps,
      name: `x${s.id}`,
      dstate: s.id,
      bare: s.place === null,
    };
  });
  figure.streets = ssh.streets
    .filter(({ travelled }) => travelled || !other)
    .map(({ path, from, to, key, travelled }) => ({
      a: ssh.places.get(from),
      b: ssh.places.get(to),
      from,
      to,
      kind: `${kindOf(key, path)}${travelled ? "" : " order"}`.trim(),
      colour: other || data.drives.length || path === null ? null : path % COLOURS,
      path: path ?? undefined,
      called: ssh.called("path", path),
      title:
        `${path === null ? "way" : `${ssh.called("path", path)},`} from ` +
        `${ssh.called("place", from)} to ${ssh.called("place", to)}` +
        (travelled ? "" : ", not travelled: the order of the path implies it"),
    }));
  for (const { from, to, actions, key } of ssh.links.values())
    figure.streets.push({
      a: ssh.dstates[from].at,
      b: ssh.dstates[to].at,
      kind: kindOf(key, null),
      headed: true,
      names: [...actions].join(", "),
      title: `${[...actions].join(", ") || "an action"}: from dstate ${from} to dstate ${to}`,
    });
  figure.streets.unshift(...liftsOf(ssh.layout));
  figure.faults = ssh.faults.map(([step, text]) => ({
    step,
    disputed: other !== null && !other.faults.some(([, said]) => said === text),
    title: text,
  }));
  figure.points = [
    ...ssh.places.values(),
    ...ssh.dstates.filter((s) => s.place === null).map((s) => s.at),
  ];
  if (data.ground) {
    coursesOf(
      figure.streets,
      ssh.labels.map((s) => ssh.dstates[s].place),
    );
    figure.courses = new Map(
      figure.streets.filter((s) => s.course).map((s) => [pairKey(s.from, s.to), s.course]),
    );
  }
  figure.bands = bandsOf(ssh);
  figure.layout = ssh.layout ?? groundLayout();
  figure.labels = ssh.labels;
  return figure;
}

// The layout of all maps over the scans of a log: metres.
function groundLayout() {
  return data.ground ? { metric: true, unit: 1, ellipses: data.indoors.ellipses } : null;
}

// The lifts between places on two floors.
function liftsOf(layout) {
  return (layout?.lifts ?? []).map(([x, y, u, v, actions]) => ({
    a: [x, y],
    b: [u, v],
    kind: "order lift",
    title: actions,
  }));
}

// The colour of a dstate: that of its path. In a joint map it is that of the only drive there.
function colourAt(steps, path) {
  if (!data.drives.length) return path === null ? null : path % COLOURS;
  const drives = new Set(steps.map(driveOf));
  return drives.size === 1 ? [...drives][0] % COLOURS : null;
}

// The distance of each point from the nearest other one, in units of the map.
function nearestOf(points) {
  return points.map((p) => {
    let best = Infinity;
    for (const q of points) {
      const d = Math.hypot(p[0] - q[0], p[1] - q[1]);
      if (d > 1e-6 && d < best) best = d;
    }
    return best;
  });
}

// The median of these distances.
function crowding(points) {
  const known = nearestOf(points.slice(0, 300))
    .filter(Number.isFinite)
    .sort((a, b) => a - b);
  return known.length ? known[Math.floor(known.length / 2)] : 1;
}

function clear(figure, x, y, w, h) {
  return figure.boxes.every(([l, t, r, b]) => x + w <= l || x - w >= r || y + h <= t || y - h >= b);
}
function keep(figure, x, y, w, h) {
  figure.boxes.push([x - w, y - h, x + w, y + h]);
}

// Put a label at a distance from a point, in the first direction where there is room for it.
function label(figure, text, [x, y], far, directions, kind = "", always = false) {
  const w = text.length * 3.3 + 1,
    h = 6;
  for (const [c, s] of directions) {
    const along = far + Math.abs(c) * w + Math.abs(s) * h,
      [u, v] = [x + c * along, y + s * along];
    const outside = u < w || v < h || u > figure.width - w || v > figure.height - h;
    if (!always && (outside || !clear(figure, u, v, w, h))) continue;
    keep(figure, u, v, w, h);
    element(
      "svg:text",
      { class: classes("name", kind), x: u.toFixed(1), y: v.toFixed(1) },
      text,
      figure.base,
    );
    return true;
  }
  return false;
}

function coloured(colour) {
  return colour === null || colour === undefined ? "" : `coloured path${colour}`;
}

function classes(...names) {
  return names.filter(Boolean).join(" ");
}
