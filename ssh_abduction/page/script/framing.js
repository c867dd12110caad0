// The frame of another map, such as that of Nav2, by points that are known in both.

const POINTS = ["map_x", "map_y", "x", "y"];
const TRIPLE = [0, 1, 2]; // the third point is optional, and shows how well all of them fit

function metres() {
  return data.ground ? 1 : data.layouts[data.maps[0].layout].unit;
}

function cellOf(k, name) {
  return $(`point${k}_${name}`);
}

function tellFrame() {
  $("framed").hidden = !data.has_frame || !(data.ground || data.layouts[data.maps[0].layout].metric);
  if ($("points").childElementCount) return;
  for (const k of TRIPLE) {
    const row = element("fieldset", {}, null, $("points"));
    element("legend", {}, `Point ${k + 1}${k < 2 ? "" : " (optional)"}`, row);
    const button = element("button", { type: "button" }, "Click it in the drawing", row);
    button.addEventListener("click", () => {
      state.pointing = state.pointing === k ? null : k;
      pointing();
    });
    POINTS.forEach((name, i) => {
      const label = element("label", {}, `${name.slice(-1)} ${i < 2 ? "here" : "in your map"} `, row);
      const cell = element("input", { id: `point${k}_${name}`, inputmode: "decimal", size: 7 }, null, label);
      cell.addEventListener("change", () => figures.forEach(paintOver));
    });
  }
}

function pointing() {
  $("stage").classList.toggle("pointing", state.pointing !== null);
  [...$("points").querySelectorAll("button")].forEach((button, k) =>
    button.setAttribute("aria-pressed", state.pointing === k),
  );
}

// Take the point of a drawing that was clicked.
function setPoint(figure, event) {
  const box = figure.svg.getBoundingClientRect(),
    x = figure.home.x + (event.clientX - box.left - figure.width / 2 - camera.dx) / figure.k,
    y = figure.home.y - (event.clientY - box.top - figure.height / 2 - camera.dy) / figure.k;
  cellOf(state.pointing, "map_x").value = (x * metres()).toFixed(2);
  cellOf(state.pointing, "map_y").value = (y * metres()).toFixed(2);
  cellOf(state.pointing, "x").focus();
  state.pointing = null;
  pointing();
  figures.forEach(paintOver);
}

function paintPoints(figure) {
  for (const k of TRIPLE) {
    const at = POINTS.slice(0, 2).map((name) => cellOf(k, name)?.value ?? "");
    if (at.some((text) => text === "" || !Number.isFinite(Number(text)))) continue;
    const [x, y] = onScreen(figure, at.map((text) => Number(text) / metres()));
    element("svg:path", { class: "point", d: `M${x - 9},${y} h18 m-9,-9 v18` }, null, figure.over);
    element("svg:text", { class: "name tag", x: x + 12, y: y - 10 }, `${k + 1}`, figure.over);
  }
}

// How far each point is off after the rotation and the shift that fit best.
function residuals(points) {
  const mean = (i) => points.reduce((sum, point) => sum + point[i], 0) / points.length,
    middle = POINTS.map((_, i) => mean(i)),
    off = points.map((point) => point.map((number, i) => number - middle[i])),
    along = off.reduce((sum, [a, b, x, y]) => sum + a * x + b * y, 0),
    across = off.reduce((sum, [a, b, x, y]) => sum + a * y - b * x, 0),
    turn = Math.atan2(across, along);
  return off.map(([a, b, x, y]) =>
    Math.hypot(a * Math.cos(turn) - b * Math.sin(turn) - x, a * Math.sin(turn) + b * Math.cos(turn) - y),
  );
}

async function frame() {
  const rows = TRIPLE.map((k) => POINTS.map((name) => cellOf(k, name).value.trim())),
    points = rows.filter((row, k) => k < 2 || row.some(Boolean)).map((row) => row.map((cell) => Number(cell || NaN))),
    told = $("framing");
  told.className = "";
  if (points.flat().some((number) => !Number.isFinite(number))) {
    told.textContent = "Write four numbers for each point, in metres: x and y here, and x and y in your map.";
    return;
  }
  const [a, b] = points;
  const far = [0, 2].map((i) => Math.hypot(a[i] - b[i], a[i + 1] - b[i + 1]));
  if (far.some((metres) => metres < 0.5)) {
    told.textContent = "The points are less than 0.5 m apart; choose points that are far apart.";
    return;
  }
  if (data.corrects) {
    const answer = await ask("frame", { points }, told);
    if (answer) told.textContent = answer.text;
    return;
  }
  const lines = [POINTS, ...points].map((row) => row.join(",")).join("\\n");
  told.className = "command";
  told.textContent =
    `Points 1 and 2 are ${far[0].toFixed(2)} m apart here and ${far[1].toFixed(2)} m in your map ` +
    `(${(far[1] / far[0]).toFixed(3)} times).\n` +
    residuals(points).map((metres, k) => `Point ${k + 1} is off by ${metres.toFixed(2)} m.`).join(" ") +
    `\n\nprintf '${lines}\\n' > frame.csv\n` +
    `ssh-abduction export ${data.file} --to nav2 --frame-of frame.csv -o graph.geojson`;
}
