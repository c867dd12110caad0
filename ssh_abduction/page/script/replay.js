// The replay of a trace, step by step, with images and beliefs.

// Whether the slider goes through the scans of the log, not only through the steps.
function gliding() {
  return Boolean(data.ground?.scans) && !replay().other;
}

function setScan(k) {
  const t = Math.max(0, data.ground.at.findLastIndex((at) => at <= k));
  if (t !== state.step) return setStep(t, k);
  state.scan = k;
  $("slider").value = k;
  for (const figure of figures) paintOver(figure);
}

function setStep(t, scan = null) {
  const { steps, images } = replay();
  if (!(t >= 0 && t < steps.length)) return;
  state.step = t;
  state.scan = scan; // null shows the robot at the pose of its dstate
  const step = steps[t],
    parts = [];
  $("slider").value = scan ?? (gliding() ? data.ground.at[t] : t);
  $("slider").setAttribute("aria-valuetext", `step ${called(t)}`);
  const [first, last] = endsOf(t);
  $("at").textContent =
    replay().other || !data.drives.length
      ? `${t} of ${last}`
      : `${called(t)} of ${last - first}`;
  parts.push(`view ${step.view}`);
  if (step.confidence !== undefined) parts[0] += ` (confidence ${step.confidence})`;
  if (step.moved && t > 0) {
    const [x, y, turn] = step.moved,
      degrees = Math.round((turn * 180) / Math.PI);
    const moved = [`came ${Math.abs(x).toFixed(1)} m ${x < 0 ? "back" : "ahead"}`];
    if (Math.abs(y) >= 0.05)
      moved.push(`${Math.abs(y).toFixed(1)} m to the ${y > 0 ? "left" : "right"}`);
    if (degrees) moved.push(`turned ${Math.abs(degrees)}° ${degrees > 0 ? "left" : "right"}`);
    parts.push(moved.join(", "));
  }
  parts.push(
    step.action === null || t === last
      ? t === steps.length - 1
        ? "the trace ends"
        : t === last
          ? "this drive ends"
          : "then an action that the maps do not name"
      : `then ${step.action}`,
  );
  $("seen").textContent = parts.join("; ");
  const wrong = replay().other
    ? []
    : data.faults.map((fault, k) => [...fault, k]).filter(([at]) => at === t);
  $("wrong").textContent = wrong
    .map(([, text, kind, k]) => {
      const count = data.maps.filter((told) => told.faults?.includes(k)).length;
      const some = count < data.maps.length ? ` in ${count} of ${data.maps.length} maps` : "";
      return `${faultWord(kind)}${some}: ${text}`;
    })
    .join("; ");
  $("wrong").hidden = !wrong.length;
  drawImage($("image"), images, images?.images[t] ?? null, step.star);
  tellRivals(t);
  tellBelief();
  for (const figure of figures) paintOver(figure);
}

// Tell the dstate of this step in each rival.
function tellRivals(t) {
  const groups = new Map(),
    { beliefs, other } = replay();
  data.maps.forEach((told, i) => {
    if (!groups.has(told.labeling)) groups.set(told.labeling, []);
    groups.get(told.labeling).push(i + 1);
  });
  const bySteps = new Map();
  for (const [key, maps] of groups) {
    const { labels } = data.labelings[key],
      belief = beliefs?.[key]?.[t];
    const label = !other
      ? labels[t]
      : belief && belief[0] !== "nowhere" && belief[2].length
        ? belief[2][0][0]
        : null;
    const steps = label === null ? [] : labels.flatMap((s, k) => (s === label ? [k] : []));
    const name =
      label === null
        ? belief
          ? "at no place of the map"
          : "not localised there"
        : `dstate ${label} (${stretches(steps)})`;
    const key2 = label === null ? name : `${steps}`,
      known = bySteps.get(key2) ?? { name, maps: [] };
    known.maps.push(...maps);
    bySteps.set(key2, known);
  }
  $("rivals").replaceChildren();
  const listed = [...bySteps.values()].sort((p, q) => q.maps.length - p.maps.length);
  const all = data.maps.length;
  for (const { name, maps } of listed.slice(0, 12)) {
    const which = maps.length < 9 ? `: ${maps.sort((a, b) => a - b).join(", ")}` : "";
    const some = `in ${maps.length} of ${all} maps${which}`;
    const where = maps.length < all ? some : all === 1 ? "in the map" : "in all maps";
    element("li", {}, `${name}: ${where}`, $("rivals"));
  }
  if (listed.length > 12)
    element("li", {}, `and ${listed.length - 12} other dstates in other maps`, $("rivals"));
}

function tellBelief() {
  $("belief").replaceChildren();
  const { beliefs } = replay();
  if (!beliefs) return;
  const drawn =
      state.mode === "overview" ? Object.keys(beliefs)[0] : `${data.maps[state.map].labeling}`,
    belief = beliefs[drawn]?.[state.step];
  if (!belief) {
    element("p", {}, "Not localised in this map.", $("belief"));
    return;
  }
  const [verdict, nowhere, likely] = belief,
    map =
      state.mode === "overview"
        ? data.maps.findIndex((told) => `${told.labeling}` === drawn)
        : state.map;
  element("p", {}, `Belief in map ${map + 1}: ${verdict}`, $("belief"));
  for (const [name, p, kind] of [
    ...likely.slice(0, 6).map(([s, p]) => [`dstate ${s}`, p, ""]),
    ["nowhere", nowhere, "nowhere"],
  ]) {
    const row = element("div", { class: "likely" }, null, $("belief"));
    element("span", {}, name, row);
    element("i", { class: kind }, null, row).style.width = `${100 * p}%`;
    element("span", {}, p.toFixed(2), row);
  }
}

// Draw ranges around the robot, which is in the middle and faces up.
function drawImage(holder, images, text, star) {
  holder.replaceChildren();
  const value = (c) => ALPHABET.indexOf(c) / (ALPHABET.length - 1);
  const ranges = text !== null;
  if (!ranges && !star?.length) return;
  const behind =
    (ranges &&
      Math.max(Math.abs(images.first), Math.abs(images.first + images.step * (text.length - 1))) >
        100) ||
    star?.some(([bearing]) => Math.abs(((bearing + 540) % 360) - 180) > 100);
  const spot = (degrees, r) => {
    const a = (degrees * Math.PI) / 180;
    return [-Math.sin(a) * r, -Math.cos(a) * r];
  };
  const ahead =
    ranges && behind && !star?.some(([bearing]) => Math.abs(((bearing + 540) % 360) - 180) < 60)
      ? Math.max(
          40,
          ...[...text].map((c, k) => -spot(images.first + images.step * k, 108 * value(c))[1]),
        )
      : 118;
  const svg = element(
    "svg:svg",
    {
      class: ranges ? "" : "small",
      viewBox: `-150 ${-ahead} 300 ${ahead + (behind ? 118 : 18)}`,
      role: "img",
      "aria-label": `${ranges ? "laser image" : "openings"}, ahead is up`,
    },
    null,
    holder,
  );
  const ring = ranges
    ? ([0.25, 0.5, 1, 2, 5, 10, 20, 50, 100, 1000].find(
        (metres) => images.reach / metres <= 3.99,
      ) ?? images.reach)
    : 1;
  for (let k = 1; k * ring <= (ranges ? images.reach : 1); k++) {
    const r = (100 * k * ring) / (ranges ? images.reach : 1);
    element("svg:circle", { class: "ring", r: r.toFixed(1) }, null, svg);
    if (ranges) element("svg:text", { class: "rim", x: r.toFixed(1), y: 12 }, `${k * ring} m`, svg);
  }
  if (ranges) {
    const points = [...text]
      .map((c, k) => (c === "!" ? null : spot(images.first + images.step * k, 100 * value(c))))
      .filter(Boolean);
    const round = Math.abs(images.step) * text.length >= 359;
    element(
      "svg:polygon",
      {
        points: [...(round ? [] : [[0, 0]]), ...points]
          .map((p) => p.map((n) => n.toFixed(1)).join(","))
          .join(" "),
        class: "polar",
      },
      null,
      svg,
    );
  }
  for (const [bearing, open] of star ?? []) {
    const [[x1, y1], [x2, y2]] = [spot(-bearing, 104), spot(-bearing, 114)],
      drawn = element(
        "svg:line",
        { x1, y1, x2, y2, class: classes("gateway", open ? "" : "unknown") },
        null,
        svg,
      );
    element(
      "svg:title",
      {},
      `${open ? "an opening" : "not observed"} at ${bearing}°, clockwise from ahead`,
      drawn,
    );
  }
  element("svg:path", { d: arrowAt(0, 0, 0, -1, 7), class: "robot" }, null, svg);
  if (star) {
    const openings = star.map(([bearing, open]) => `${bearing}°${open ? "" : " (not observed)"}`);
    const told = star.length
      ? `Openings, seen clockwise from ahead: ${openings.join(", ")}`
      : "No opening is seen.";
    element("p", {}, told, holder);
  }
}

let player = null;
function play(on) {
  clearInterval(player);
  player = null;
  $("play").setAttribute("aria-pressed", on);
  $("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  const [first, last] = endsOf(state.step);
  if (state.step === last) setStep(first);
  const { length } = replay().steps,
    pause = gliding() ? Math.max(40, (PLAYING * length) / data.ground.way.length) : PLAYING;
  player = setInterval(() => {
    if (gliding()) setScan(Number($("slider").value) + 1);
    else setStep(state.step + 1);
    if (state.step >= last) play(false);
  }, pause);
}

function chooseReplay(k) {
  play(false);
  state.replay = k;
  $("which").value = k;
  $("slider").max = (gliding() ? data.ground.way : replay().steps).length - 1;
  setStep(Math.min(state.step, replay().steps.length - 1));
  legend();
}
