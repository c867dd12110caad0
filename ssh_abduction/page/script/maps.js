// The maps as the page draws them.

// The place, path and direction of each dstate of a map.
function whereIn(i) {
  return data.places[data.maps[i].places];
}

function labelsOf(i) {
  return data.labelings[data.maps[i].labeling].labels;
}

// A map as it is drawn: the steps of its dstates and places, their positions, and the streets.
function mapOf(i) {
  if (decoded.has(i)) return decoded.get(i);
  const told = data.maps[i],
    { labels, views } = data.labelings[told.labeling],
    where = whereIn(i);
  const ofDstate = members(labels),
    ofPlace = members(labels.map((s) => where[s][0])),
    ofPath = members(labels.map((s) => where[s][1]));
  const layout = told.layout === undefined ? null : data.layouts[told.layout];
  const places = new Map(layout ? layout.places.map(([p, x, y]) => [p, [x, y]]) : []);
  for (const [p, steps] of ofPlace) if (!places.has(p)) places.set(p, middle(steps));
  const dstates = views.map((view, s) => {
    const steps = ofDstate.get(s) ?? [],
      spot = layout ? layout.dstates[s] : data.spots[steps[0]];
    const [place, path, direction] = where[s];
    const at =
      place !== null && places.has(place)
        ? places.get(place)
        : layout
          ? spot.slice(0, 2)
          : middle(steps);
    return { id: s, view, steps, place, path, direction, at, heading: spot[2] };
  });
  const travelled = new Map(),
    leaps = new Set(told.leaps),
    joined = new Map(); // from each place towards one place of its piece of the map
  const pieceOf = (place) => (joined.has(place) ? pieceOf(joined.get(place)) : place);
  for (let t = 1; t < labels.length; t++) {
    const [a, b] = [dstates[labels[t - 1]], dstates[labels[t]]];
    if (!leaps.has(t) && pieceOf(a.place) !== pieceOf(b.place))
      joined.set(pieceOf(a.place), pieceOf(b.place));
    if (
      a.place !== null &&
      b.place !== null &&
      a.place !== b.place &&
      a.path === b.path &&
      !leaps.has(t)
    )
      travelled.set(pairKey(a.place, b.place), {
        path: a.path,
        from: a.place,
        to: b.place,
        travelled: true,
      });
  }
  const streets = [...travelled.values()];
  for (const [path, order] of data.orders[told.orders])
    for (let k = 1; k < order.length; k++)
      if (
        places.has(order[k - 1]) &&
        places.has(order[k]) &&
        pieceOf(order[k - 1]) === pieceOf(order[k]) &&
        !travelled.has(pairKey(order[k - 1], order[k]))
      )
        streets.push({ path, from: order[k - 1], to: order[k], travelled: false });
  const links = ofPlace.size ? new Map() : linksOf(labels);
  const keys = new Set();
  for (const [key, link] of links) {
    link.key = `l${key
      .split(" ")
      .map((s) => ofDstate.get(Number(s)))
      .join("|")}`;
    keys.add(link.key);
  }
  for (const steps of ofDstate.values()) keys.add(`d${steps}`);
  for (const steps of ofPlace.values()) keys.add(`p${steps}`);
  for (const steps of ofPath.values()) keys.add(`h${steps}`);
  for (const street of streets) {
    const ends = [street.from, street.to].map((place) => `${ofPlace.get(place)}`);
    street.key = `s${ends.sort().join("|")}`;
    if (street.travelled) keys.add(street.key);
  }
  const made = {
    number: i,
    labels,
    dstates,
    places,
    ofPlace,
    ofPath,
    streets,
    links,
    keys,
    layout,
    passed: new Set(told.passed),
    faults: (told.faults ?? []).map((k) => data.faults[k]),
    chi2: told.chi2,
    called: (kind, number) => {
      const name = told.names?.[`${kind} ${number}`];
      return name === undefined ? `${kind} ${number}` : `${kind} ${number} (${name})`;
    },
    names: told.names ?? {},
    regions: (data.regions[told.regions] ?? []).map(([places, bounds, door], number) => ({
      id: number,
      places: new Set(places),
      bounds,
      door,
    })),
    id: told.id,
  };
  if (decoded.size > 40) decoded.delete(decoded.keys().next().value);
  decoded.set(i, made);
  return made;
}

// The links of a map without places, by the dstates that they join, with the actions of the trace.
function linksOf(labels) {
  const links = new Map(),
    { steps } = data.replays.at(-1); // the trace that was mapped
  for (let t = 1; t < labels.length; t++) {
    const [s, x] = [labels[t - 1], labels[t]],
      key = `${s} ${x}`;
    if (s === x) continue;
    if (!links.has(key)) links.set(key, { from: s, to: x, actions: new Set() });
    if (steps[t - 1].action !== null) links.get(key).actions.add(steps[t - 1].action);
  }
  return links;
}

function pairKey(a, b) {
  return a < b ? `${a} ${b}` : `${b} ${a}`;
}

function middle(steps) {
  let [x, y] = [0, 0];
  for (const t of steps) {
    x += data.spots[t][0];
    y += data.spots[t][1];
  }
  return [x / Math.max(1, steps.length), y / Math.max(1, steps.length)];
}

function share(count) {
  const part = count / data.maps.length;
  return part === 1 ? "" : part > 2 / 3 ? "most" : part > 1 / 3 ? "half" : "few";
}
