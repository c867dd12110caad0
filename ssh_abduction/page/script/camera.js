// Where drawings are on the page: moving and zooming.

// The home of a drawing shows all of it. The camera says by how many pixels all drawings are moved
// from their homes, and how much they are enlarged.
let camera = { dx: 0, dy: 0, z: 1 },
  homes = [];

// The home of points: their middle, and the pixels for a unit of the map, so that all are visible.
function homeOf(points, svg) {
  const xs = points.map((p) => p[0]),
    ys = points.map((p) => p[1]);
  const least = (v) => v.reduce((a, b) => Math.min(a, b), Infinity),
    most = (v) => v.reduce((a, b) => Math.max(a, b), -Infinity);
  const [l, r, b, t] = [least(xs), most(xs), least(ys), most(ys)],
    box = svg.getBoundingClientRect(),
    margin = Math.min(data.ground ? 20 : 55, box.width / 7, box.height / 6);
  const k = Math.min(
    (box.width - 2 * margin) / Math.max(r - l, 1e-9),
    (box.height - 2 * margin - 12) / Math.max(t - b, 1e-9),
    data.ground ? Infinity : 230 / crowding(points),
  );
  return { x: (l + r) / 2, y: (b + t) / 2, k: Math.max(k, 0.1) };
}

function extentOf(figure) {
  return figure.extent ?? figure.points;
}

// Give drawings in metres one home, so that they can be compared, and each other one its own.
function settle() {
  const together =
    figures.every((figure) => figure.layout?.metric) ||
    figures.every((figure) => figure.layout === figures[0].layout);
  homes = figures.map((figure) =>
    homeOf(together ? figures.flatMap(extentOf) : extentOf(figure), figure.svg),
  );
  camera = { dx: 0, dy: 0, z: 1 };
}

// Whether everything is visible from the homes as they are. Then they need not move.
function settled() {
  return (
    homes.length === figures.length &&
    figures.every((figure, i) => {
      const box = figure.svg.getBoundingClientRect(),
        home = homes[i];
      return extentOf(figure).every(
        ([x, y]) =>
          Math.abs(x - home.x) * home.k < box.width / 2 - 12 &&
          Math.abs(y - home.y) * home.k < box.height / 2 - 12,
      );
    })
  );
}

function onScreen(figure, [x, y]) {
  return [
    figure.width / 2 + (x - figure.home.x) * figure.k + camera.dx,
    figure.height / 2 - (y - figure.home.y) * figure.k + camera.dy,
  ];
}

let waiting = false;
function paintSoon() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    paint();
  });
}

// Enlarge all drawings around the point at (u, v) from their middles.
function zoom(factor, u = 0, v = 0) {
  const z = Math.min(Math.max(camera.z * factor, 0.2), 60),
    f = z / camera.z;
  camera = { dx: u - (u - camera.dx) * f, dy: v - (v - camera.dy) * f, z };
  paintSoon();
}

// One finger or the mouse moves the drawings. Two fingers or the wheel zoom. A click picks the
// nearest dstate.
function movable(figure) {
  const { svg } = figure,
    down = new Map();
  let moved = false;
  svg.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const box = svg.getBoundingClientRect();
      zoom(
        Math.exp(-Math.sign(event.deltaY) * 0.15),
        event.clientX - box.left - box.width / 2,
        event.clientY - box.top - box.height / 2,
      );
    },
    { passive: false },
  );
  const pans = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
  svg.addEventListener("keydown", (event) => {
    const by = pans[event.key];
    if (!by || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    camera.dx += by[0];
    camera.dy += by[1];
    paintSoon();
  });
  svg.addEventListener("pointerdown", (event) => {
    down.set(event.pointerId, [event.clientX, event.clientY]);
    if (down.size === 1) moved = false;
  });
  svg.addEventListener("pointermove", (event) => {
    const from = down.get(event.pointerId);
    if (!from) return;
    const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
    if (!moved && Math.hypot(dx, dy) < 5) return;
    if (!moved) svg.setPointerCapture(event.pointerId);
    moved = true;
    const others = [...down].filter(([id]) => id !== event.pointerId);
    if (others.length === 1) {
      const [, [ox, oy]] = others[0],
        box = svg.getBoundingClientRect();
      const factor =
        Math.hypot(event.clientX - ox, event.clientY - oy) /
        Math.max(1, Math.hypot(from[0] - ox, from[1] - oy));
      zoom(
        factor,
        (event.clientX + ox) / 2 - box.left - box.width / 2,
        (event.clientY + oy) / 2 - box.top - box.height / 2,
      );
    } else if (!others.length) {
      camera.dx += dx;
      camera.dy += dy;
      paintSoon();
    }
    down.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel", "pointerleave"])
    svg.addEventListener(name, (event) => down.delete(event.pointerId));
  svg.addEventListener("click", (event) => {
    if (moved) {
      moved = false;
      return;
    }
    if (state.pointing !== null) return setPoint(figure, event);
    const target = event.target.closest("[data-step]");
    let steps = target ? figure.marks[Number(target.dataset.mark)].steps : null;
    if (!steps) {
      const box = svg.getBoundingClientRect(),
        away = (m) => Math.hypot(m.x - event.clientX + box.left, m.y - event.clientY + box.top);
      const nearest = figure.marks.reduce((best, m) => (away(m) < away(best) ? m : best), {
        x: Infinity,
        y: Infinity,
      });
      if (nearest.steps && away(nearest) < NEAREST) steps = nearest.steps;
    }
    if (steps) pick(!replay().other && steps.includes(state.step) ? state.step : steps[0]);
  });
}

function newFigure(content) {
  const figure = { ...content, marks: [], boxes: [] };
  if (data.ground) {
    const [l, b, r, t] = data.ground.view;
    figure.extent = [...figure.points, [l, b], [r, t]];
  }
  const holder = element("figure", {}, null, $("drawings"));
  element("figcaption", {}, content.caption, holder);
  const said = `${content.caption}. Arrow keys move it, + and - zoom.`;
  figure.svg = element("svg:svg", { role: "img", tabindex: 0, "aria-label": said }, null, holder);
  figure.ground = element("svg:g", { class: "ground" }, null, figure.svg);
  figure.under = element("svg:g", {}, null, figure.svg);
  figure.base = element("svg:g", {}, null, figure.svg);
  figure.over = element("svg:g", {}, null, figure.svg);
  movable(figure);
  if (data.ground) buildGround(figure);
  return figure;
}
