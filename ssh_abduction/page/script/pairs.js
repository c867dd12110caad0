// Questions about two steps.

function pick(t) {
  state.picked =
    state.picked.length === 1 && state.picked[0] !== t
      ? [state.picked[0], t].sort((a, b) => a - b)
      : [t];
  judge();
}

// Tell what the listed maps, or the proof for all minimal maps, say of two steps.
function judge() {
  giveUp();
  const [a, b] = state.picked;
  $("first").value = a === undefined ? "" : called(a);
  $("later").value = b === undefined ? "" : called(b);
  $("answer").textContent = "";
  $("costs").replaceChildren();
  $("ask").hidden = b === undefined && !theory();
  for (const id of ["why", "same", "different", "accept", "reject"]) $(id).hidden = b === undefined;
  $("scans").replaceChildren();
  const { steps, images } = data.replays.at(-1); // the trace that was mapped
  for (const t of b === undefined ? [] : [a, b]) {
    const scan = element("figure", {}, null, $("scans"));
    element("figcaption", {}, `step ${called(t)}`, scan);
    drawImage(element("div", {}, null, scan), images, images?.images[t] ?? null, steps[t].star);
  }
  if (b === undefined)
    $("verdict").textContent = a === undefined ? "" : `Step ${called(a)} is chosen; choose another one.`;
  else {
    tellVerdict(a, b);
    if (served) why();
  }
  for (const figure of figures) paintOver(figure);
}

function costOf(i) {
  const told = data.maps[i];
  return data.labelings[told.labeling].views.length + (told.cost ?? 0);
}

function tellVerdict(a, b) {
  const minimal = data.minimal ?? data.maps.length,
    count = { dstate: 0, place: 0, path: 0 },
    best = { same: Infinity, different: Infinity };
  data.maps.forEach((told, i) => {
    const labels = labelsOf(i),
      where = whereIn(i),
      [s, x] = [labels[a], labels[b]],
      side = s === x ? "same" : "different";
    best[side] = Math.min(best[side], costOf(i));
    if (i >= minimal) return;
    count.dstate += s === x;
    count.place += where[s][0] !== null && where[s][0] === where[x][0];
    count.path += where[s][1] !== null && where[s][1] === where[x][1];
  });
  const proven = data.complete || data.shared,
    listed = data.complete ? "minimal map" : "map listed";
  let verdict;
  if (data.shared) {
    const [i, j] = [a, b].map((t) => data.shared.always.indexOf(data.shared.always[t]));
    verdict =
      i === j
        ? "one dstate in every minimal map"
        : data.shared.sometimes.some(([p, q]) => p === Math.min(i, j) && q === Math.max(i, j))
          ? `one dstate in some minimal maps, different in others: rivals disagree`
          : "different dstates in every minimal map";
  } else
    verdict =
      count.dstate === minimal
        ? `one dstate in every ${listed}`
        : count.dstate === 0
          ? `different dstates in every ${listed}`
          : `one dstate in ${count.dstate} of the ${minimal} ${listed}s: rivals disagree`;
  const places = data.places[0].some(([place]) => place !== null)
    ? `; at one place in ${count.place}, along one path in ${count.path} of ${minimal}`
    : "";
  $("verdict").textContent = `Steps ${called(a)} and ${called(b)}: ${verdict}${places}.`;
  const least = Math.min(best.same, best.different),
    cost = {};
  for (const side of ["same", "different"]) {
    cost[side] =
      best[side] === least
        ? "costs nothing"
        : best[side] < Infinity
          ? `${best[side]} dstates in the best map listed, not ${least}`
          : proven
            ? `more than the ${least} dstates of these maps, if there is such a map`
            : "no listed map does this";
  }
  tellCosts(cost);
}

function tellCosts(cost) {
  $("costs").replaceChildren();
  for (const [side, name] of [
    ["same", "One dstate"],
    ["different", "Different"],
  ]) {
    element("dt", {}, name, $("costs"));
    element("dd", {}, cost[side], $("costs"));
  }
}

function theory(more = null) {
  const all = { same: [...assumed.same], different: [...assumed.different] };
  if (more) all[more].push(state.picked);
  return ["same", "different"]
    .flatMap((kind) => all[kind].map(([a, b]) => ` --${kind} ${inShell(`${called(a)},${called(b)}`)}`))
    .join("");
}

let asking = null;
function giveUp() {
  if (!asking) return;
  asking.abort();
  asking = null;
  $("busy").hidden = true;
}

async function ask(question, body, told = $("answer")) {
  giveUp();
  const mine = (asking = new AbortController()),
    begun = Date.now(),
    since = () => {
      $("waited").textContent = `Solving for ${Math.round((Date.now() - begun) / 1000)} s`;
    };
  told.textContent = "";
  $("busy").hidden = false;
  since();
  const clock = setInterval(since, 500);
  try {
    const response = await fetch(new URL(question, location.href.replace(/\/?$/, "/")), {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(body),
      signal: mine.signal,
    });
    if (!response.ok)
      throw new Error(
        `the server refused (${response.status}); open the address that view --serve printed`,
      );
    const answer = await response.json();
    if (answer.error) throw new Error(answer.error);
    return answer;
  } catch (error) {
    if (asking === mine)
      told.textContent =
        error instanceof TypeError
          ? "No answer: the server has ended; start view --serve again"
          : `No answer: ${error.message}`;
    return null;
  } finally {
    clearInterval(clock);
    if (asking === mine) {
      asking = null;
      $("busy").hidden = true;
    }
  }
}

async function why() {
  const pair = state.picked;
  if (pair.length < 2) return;
  if (!served) {
    $("answer").className = "command";
    $("answer").textContent =
      `ssh-abduction explain ${data.trace} ${pair.map(called).map(inShell).join(" ")}${data.flags}${theory()}`;
    return;
  }
  const told = await ask("explain", { pair, ...assumed });
  if (!told) return;
  $("answer").textContent = told.text;
  tellCosts(told.assuming);
}

// The name of a step as `correct` reads it.
function fullName(t) {
  return data.drives.length || !data.name ? called(t) : `${data.name}:${t}`;
}

// Say that the two steps chosen are one, or are not: over a log one place, else one dstate.
async function correct(accepted) {
  const pair = state.picked.slice(),
    kind = data.ground
      ? accepted ? "same_place" : "elsewhere"
      : accepted ? "same" : "different";
  if (pair.length < 2) return;
  if (!data.corrects) {
    const option = `--${kind.replace("_", "-")} ${inShell(pair.map(fullName).join(","))}`;
    $("answer").className = "command";
    $("answer").textContent =
      `ssh-abduction correct ${data.file} ${option}\n\n` +
      `Or let this page write it:\nssh-abduction view ${data.file} ${data.trace} --serve`;
    return;
  }
  const told = await ask("correct", { pair, kind });
  if (told) $("answer").textContent = told.text;
}

async function assume(kind) {
  if (kind && state.picked.length < 2) return;
  const pair = state.picked.slice();
  if (!served) {
    if (kind) assumed[kind].push(pair);
    else {
      assumed.same = [];
      assumed.different = [];
    }
    $("forget").hidden = !theory();
    $("answer").className = "command";
    const commands = [
      `ssh-abduction solve ${data.trace} --json${data.flags}${theory()} > assumed.json`,
      `ssh-abduction view assumed.json ${data.trace}`,
      "",
      "Or let this page solve again:",
      `ssh-abduction view ${data.file} ${data.trace} --serve`,
    ];
    $("answer").textContent = theory() ? commands.join("\n") : "";
    return;
  }
  const wanted = kind
    ? { ...assumed, [kind]: [...assumed[kind], pair] }
    : { same: [], different: [] };
  const told = await ask("solve", wanted);
  if (!told) return;
  if (told.content) {
    Object.assign(assumed, wanted);
    data = told.content;
    decoded = new Map();
    load(false);
  }
  $("answer").textContent =
    `${kind ? `With steps ${pair.map(called).join(" and ")} assumed ${kind}: ` : ""}${told.text}`;
}
