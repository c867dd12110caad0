"use strict";
// The state of the page, and small helpers. Texts of a trace are set as text, never as HTML.
const NS = "http://www.w3.org/2000/svg";
const ALPHABET = Array.from({ length: 92 }, (_, k) => String.fromCharCode(35 + k))
  .filter((c) => !"&<>\\".includes(c))
  .join(""); // as in page/content.py
const COLOURS = 8; // the number of colours of paths
const NEAREST = 22; // pixels: a click picks the nearest dstate that is no farther away
const PLAYING = 700; // milliseconds for each step
const $ = (id) => document.getElementById(id);
let data = JSON.parse($("content").textContent);
const served = data.served;
const assumed = { same: [], different: [] };
const state = { mode: "overview", map: 0, other: 1, step: 0, scan: null, picked: [], replay: 0, region: null, found: null, pointing: null };
let decoded = new Map(),
  figures = [];

function element(name, attributes = {}, text = null, parent = null) {
  const made = name.startsWith("svg:")
    ? document.createElementNS(NS, name.slice(4))
    : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== null) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

function stretches(steps) {
  const parts = [];
  for (const t of steps) {
    const last = parts.at(-1);
    if (last && last[1] === t - 1 && driveOf(t - 1) === driveOf(t)) last[1] = t;
    else parts.push([t, t]);
  }
  const bare = (t) => t - (data.drives[driveOf(t)]?.first ?? 0);
  const told = parts.map(([a, b]) => (a === b ? called(a) : `${called(a)}–${bare(b)}`));
  const shown = told.length > 8 ? [...told.slice(0, 8), "…"] : told;
  return `${steps.length === 1 ? "step" : "steps"} ${shown.join(", ")}`;
}

function counted(count, noun) {
  return `${count} ${count === 1 ? noun : `${noun}s`}`;
}

function members(names) {
  const found = new Map();
  names.forEach((name, t) => {
    if (name === null) return;
    if (!found.has(name)) found.set(name, []);
    found.get(name).push(t);
  });
  return found;
}

function replay() {
  return data.replays[state.replay];
}
