// Filling the page, and listening to the user.

function load(judging = true) {
  state.region = null;
  $("heading").textContent = data.verdict;
  $("sentence").textContent = data.sentence + (theory() ? ` — assumed:${theory()}` : "");
  document.title = data.verdict;
  $("first").max = $("later").max = labelsOf(0).length - 1;
  $("which").replaceChildren();
  data.replays.forEach(({ name }, k) => element("option", { value: k }, name, $("which")));
  $("replay").hidden = data.replays.length < 2;
  tellDoubts();
  tellDrives();
  tellReport();
  tellFrame();
  listThings();
  $("choices").replaceChildren();
  for (const choice of data.choices.slice(0, 20)) {
    const item = element("li", {}, null, $("choices"));
    element(
      "div",
      {},
      choice.questions.slice(0, 4).join("; ") +
        (choice.questions.length > 4 ? `; and ${choice.questions.length - 4} more` : "") +
        "?",
      item,
    );
    choice.options.slice(0, 6).forEach((option, k) => {
      const answers =
        option.answers.length > 4
          ? `way ${k + 1}`
          : option.answers.map((yes) => (yes ? "yes" : "no")).join(", ");
      element(
        "button",
        { title: `go to map ${option.maps[0]}` },
        `${answers}: ${counted(option.maps.length, "map")}`,
        item,
      ).addEventListener("click", () => go(option.maps[0] - 1));
    });
    if (choice.options.length > 6)
      element("span", {}, `and ${choice.options.length - 6} other ways`, item);
  }
  if (data.choices.length > 20)
    element("p", {}, `and ${data.choices.length - 20} other choices`, $("choices"));
  if (!data.choices.length)
    element(
      "p",
      {},
      data.maps.length > 1 ? "In no answer to a question about steps." : "There is one map only.",
      $("choices"),
    );
  if (data.maps.length === 1 && state.mode !== "one") state.mode = "one";
  draw(false);
  state.replay = Math.min(state.replay, data.replays.length - 1);
  chooseReplay(state.replay);
  if (judging) judge();
  else {
    $("costs").replaceChildren();
    if (state.picked.length === 2) tellVerdict(...state.picked);
  }
  $("forget").hidden = !theory();
}

// Joins of the first map that may be wrong. A click chooses the two steps of a join.
function tellDoubts() {
  $("sureness").textContent = data.sureness;
  $("warnings").replaceChildren();
  for (const warning of data.warnings) element("p", {}, `Warning: ${warning}`, $("warnings"));
  $("joins").replaceChildren();
  $("doubts").hidden = !data.joins.length;
  const weighed = data.joins.length && data.joins[0][2] !== null;
  $("doubted").textContent = weighed
    ? "The best map joins these steps. Their probability, by the maps that are known:"
    : "These joins of map 1 rest on minimality alone. The others follow from them:";
  for (const [a, b, probability] of data.joins) {
    const text = `steps ${called(a)} and ${called(b)}${weighed ? `: ${probability}` : ""}`;
    const item = element("li", {}, null, $("joins"));
    element("button", {}, text, item).addEventListener("click", () => {
      state.picked = [a, b];
      judge();
    });
  }
}

for (const mode of ["overview", "one", "two"])
  $(mode).addEventListener("click", () => setMode(mode));
$("back").addEventListener("click", () => go(state.map - 1));
$("next").addEventListener("click", () => go(state.map + 1));
const otherLabels = () => go(nextMap((told, now) => told.labeling !== now.labeling));
const otherPaths = () => go(nextMap((told, now) => told.labeling === now.labeling));
$("labels").addEventListener("click", otherLabels);
$("paths").addEventListener("click", otherPaths);
$("number").addEventListener("change", () => go(Number($("number").value) - 1));
$("other").addEventListener("change", () => {
  const i = Number($("other").value) - 1;
  if (i >= 0 && i < data.maps.length) state.other = i;
  draw();
});
$("slider").addEventListener("input", () => {
  play(false);
  (gliding() ? setScan : setStep)(Number($("slider").value));
});
$("play").addEventListener("click", () => play(!player));
$("which").addEventListener("change", () => chooseReplay(Number($("which").value)));
const whole = () => {
  settle();
  paintSoon();
};
$("closer").addEventListener("click", () => zoom(1.3));
$("farther").addEventListener("click", () => zoom(1 / 1.3));
$("whole").addEventListener("click", whole);
for (const name of ["first", "later"])
  $(name).addEventListener("change", () => {
    const texts = ["first", "later"].map((id) => $(id).value).filter((text) => text !== ""),
      last = labelsOf(0).length - 1,
      isStep = (text) => numberOf(text) >= 0 && numberOf(text) <= last;
    const wrong = texts.find((text) => !isStep(text));
    state.picked = [...new Set(texts.filter(isStep).map(numberOf))].sort((a, b) => a - b);
    judge();
    if (wrong !== undefined)
      $("verdict").textContent = `There is no step or place ${wrong}: steps are 0 to ${last}, a place is written as p4.`;
  });
$("why").addEventListener("click", why);
$("same").addEventListener("click", () => assume("same"));
$("different").addEventListener("click", () => assume("different"));
$("forget").addEventListener("click", () => assume(null));
$("accept").addEventListener("click", () => correct(true));
$("reject").addEventListener("click", () => correct(false));
$("frame").addEventListener("click", frame);
$("find").addEventListener("change", () => find($("find").value));
$("stop").addEventListener("click", () => {
  giveUp();
  $("answer").textContent = "Given up.";
});
$("busy").hidden = true;
document.addEventListener("keydown", (event) => {
  if (
    event.target.matches("input:not([type=range]), select") ||
    event.ctrlKey ||
    event.metaKey ||
    event.altKey
  )
    return;
  if (event.key === " " && event.target.matches("button")) return;
  const keys = {
    ArrowLeft: () => setStep(state.step - 1),
    ArrowRight: () => setStep(state.step + 1),
    " ": () => play(!player),
    c: () => {
      if (!replay().other) pick(state.step);
    },
    n: () => go(state.map + 1),
    p: () => go(state.map - 1),
    d: otherLabels,
    h: otherPaths,
    o: () => setMode("overview"),
    1: () => setMode("one"),
    2: () => setMode("two"),
    "+": () => zoom(1.3),
    "=": () => zoom(1.3),
    "-": () => zoom(1 / 1.3),
    0: whole,
    "/": () => $("find").focus(),
  };
  if (keys[event.key]) {
    event.preventDefault();
    keys[event.key]();
  }
});
showLayers();
let resized = null;
new ResizeObserver(() => {
  clearTimeout(resized);
  resized = setTimeout(() => {
    if (
      figures.length &&
      (figures[0].width !== figures[0].svg.getBoundingClientRect().width ||
        figures[0].height !== figures[0].svg.getBoundingClientRect().height)
    )
      whole();
  }, 60);
}).observe($("stage"));
load();
performance.mark("drawn");
