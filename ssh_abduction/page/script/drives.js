// The drives of a joint trace: their names, their colours, their trails, and the joins between them.

// The index of the drive of a step; -1 for the only drive of a trace.
function driveOf(t) {
  return data.drives.findIndex(({ first, stop }) => first <= t && t < stop);
}

function called(t) {
  const drive = data.drives[driveOf(t)];
  return drive ? `${drive.name}:${t - drive.first}` : `${t}`;
}

// Text as one word of the shell.
function inShell(text) {
  return /^[\w:.,-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
}

// The number of a step from its number or name (step 4, monday:4), or the first step of a dstate (d4)
// or of a thing (p4, kitchen); NaN for none.
function numberOf(text) {
  const said = text.trim(),
    dstate = /^d(\d+)$/.exec(said),
    [, name, number] = /^(?:(.*):|step ?)?(\d+)$/.exec(said) ?? [],
    drive = data.drives.find((drive) => drive.name === name);
  if (dstate) return [...labelsOf(0)].findIndex((label) => label === Number(dstate[1]));
  if (number === undefined) return thingCalled(said)?.steps?.[0] ?? NaN;
  if (name === undefined || (name === data.name && !data.drives.length)) return Number(number);
  return drive && Number(number) < drive.stop - drive.first ? drive.first + Number(number) : NaN;
}

function colourOf(k) {
  return `coloured path${k % COLOURS}`;
}

// The first and the last step of the drive of a step, or of the replay of another trace.
function endsOf(t) {
  const drive = replay().other ? undefined : data.drives[driveOf(t)];
  return drive ? [drive.first, drive.stop - 1] : [0, replay().steps.length - 1];
}

function tellDrives() {
  $("drives").hidden = $("joins_of_drives").hidden = !data.drives.length;
  $("joined").textContent = data.joined;
  $("starts").replaceChildren();
  $("between").replaceChildren();
  data.drives.forEach(({ name, first }, k) => {
    const button = element("button", { title: "go to its first step" }, null, $("starts"));
    const svg = element("svg:svg", { viewBox: "0 0 22 12", "aria-hidden": "true" }, null, button);
    element("svg:path", { d: "M2,6 H20", class: classes("trail", colourOf(k)) }, null, svg);
    element("span", {}, name, button);
    button.addEventListener("click", () => {
      chooseReplay(data.replays.length - 1);
      setStep(first);
    });
  });
  for (const { sentence, joins } of data.between) {
    const item = element("li", {}, sentence, $("between"));
    for (const [a, b, share] of joins)
      element(
        "button",
        { title: "choose these two steps" },
        `${called(a)} = ${called(b)}: ${share}`,
        item,
      ).addEventListener("click", () => {
        state.picked = [a, b];
        judge();
      });
  }
}

// Paint the way of each drive through the places, the ways of several drives side by side.
function paintTrails(figure, see) {
  if (data.ground) return; // the courses of the drives are on the ground
  const states = figure.map === null ? null : mapOf(figure.map).dstates;
  const leaps = new Set(data.maps[figure.map ?? 0].leaps);
  const at = (t) => see(states ? states[figure.labels[t]].at : data.spots[t]);
  data.drives.forEach(({ name, first, stop }, k) => {
    const lane = (k - (data.drives.length - 1) / 2) * 4,
      [ways, lifts] = [[], []];
    for (let t = first + 1; t < stop; t++) {
      const [a, b] = [at(t - 1), at(t)],
        far = Math.hypot(b[0] - a[0], b[1] - a[1]);
      if (far < 1) continue;
      // Both directions of an edge have the same lane.
      const side = Math.sign(b[0] - a[0] || b[1] - a[1]),
        [nx, ny] = [(-side * lane * (b[1] - a[1])) / far, (side * lane * (b[0] - a[0])) / far];
      (leaps.has(t) ? lifts : ways).push(`M${point([a[0] + nx, a[1] + ny])} L${point([b[0] + nx, b[1] + ny])}`);
    }
    for (const [parts, kind, title] of [
      [ways, "", `the way of ${name}`],
      [lifts, "lift", `${name} by a lift, or slipping`],
    ]) {
      if (kind && !parts.length) continue;
      const trail = element(
        "svg:path",
        { d: parts.join(" ") || "M0,0", class: classes("trail", kind, colourOf(k)) },
        null,
        figure.base,
      );
      element("svg:title", {}, title, trail);
    }
  });
}
