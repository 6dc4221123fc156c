// Wires the page: events into the model, the moment into map and lists.

import "./style.css";

import type { Event, Sign } from "./events";
import { Lists, byId } from "./lists";
import type { Colours, FlightMap } from "./map";
import { Model } from "./model";
import { Playback } from "./playback";
import { listen } from "./stream";
import { clock, decided, duration, moment, sentence } from "./words";

const LISTS_PERIOD_MS = 250;
/** A source that says every second that it is there, and has not for so long, is not. */
const SILENCE_MS = 10_000;

const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
let model = new Model();
let map: FlightMap | undefined;
const playback = new Playback();
const actions = { select, seek };
let lists = new Lists(model, actions);
let selected = "";
let live = false;
let complete = false;
/** Since when the server does not answer, and what is said of it. */
let lost: { since: number; text: string } | undefined;
let heard = performance.now();
let empty = "";

const play = byId<HTMLButtonElement>("play");
const liveButton = byId<HTMLButtonElement>("live");
const slider = byId<HTMLInputElement>("moment");
const output = byId<HTMLOutputElement>("clock");
const connection = byId("connection");
const mode = byId("mode");

function colours(): Colours {
  const style = getComputedStyle(document.documentElement);
  const colour = (name: string) => style.getPropertyValue(`--${name}`).trim();
  return {
    background: colour("map"),
    text: colour("text"),
    flown: colour("flown"),
    link: colour("link"),
    place: colour("quiet"),
    zone: colour("zone"),
    operationArea: colour("operation-area"),
    corridor: colour("corridor"),
    path: colour("path"),
    depot: colour("quiet"),
  };
}

/** Once the first events are here, or none come: a map that begins elsewhere would be drawn twice. */
let tell: () => void;
const told = new Promise<void>((resolve) => (tell = resolve));
const FIRST_TIMEOUT_MS = 1_000;

async function openMap(): Promise<void> {
  try {
    const [module] = await Promise.all([import("./map"), told]);
    const time = complete ? model.begin : playback.time;
    map = new module.FlightMap(byId("map"), model, colours(), still, select, time);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => map?.paint(colours()));
    if (complete) map?.showWhole();
  } catch (error) {
    byId("map").hidden = true;
    byId("legend").hidden = true;
    const sentence = byId("no-map");
    sentence.textContent = "This browser has no WebGL, which the map needs: the lists say what happens.";
    sentence.hidden = false;
    console.info("the map cannot be shown:", error);
  }
}

function select(drone: string): void {
  selected = selected === drone ? "" : drone;
  if (selected) map?.centre(selected, playback.time);
  show();
}

function seek(time: number): void {
  playback.seek(time);
  show();
}

function take(all: (Event | Sign)[]): void {
  for (const one of all) {
    switch (one.type) {
      case "reset":
        restart();
        break;
      case "live":
        live = true;
        if (playback.time === 0) playback.follow(model.end);
        break;
      case "end":
        finish();
        break;
      default:
        if (one.type === "contact") heard = performance.now();
        model.take(one);
    }
  }
}

/** Since when what is shown may not be so any more, and why; undefined: it is so. */
function stale(): { since: number; text: string } | undefined {
  if (complete) return undefined;
  if (lost !== undefined) return lost;
  const contact = model.contact;
  if (contact === undefined) return undefined;
  if (contact.stale_since_ms !== null) return { since: contact.stale_since_ms, text: contact.text };
  const silence = performance.now() - heard;
  return silence > SILENCE_MS ? { since: Date.now() - silence, text: "The server says nothing." } : undefined;
}

/** What the user should know of what they see. */
function showConnection(): void {
  const found = stale();
  const text = found ? `Stale since ${clock(found.since)} UTC: ${found.text}` : (model.problems.at(-1)?.text ?? empty);
  if (connection.textContent !== text) connection.textContent = text;
  document.body.classList.toggle("stale", found !== undefined);
  const now = playback.following ? "live" : "paused";
  mode.textContent = complete ? "replay" : found ? "stale" : live ? now : "connecting";
}

/** Everything is told again: the moment that is shown stays. */
function restart(): void {
  model = new Model();
  lists.clear();
  lists = new Lists(model, actions);
  map?.follow(model);
}

/** A recording is all there. */
function finish(): void {
  complete = true;
  if (!Number.isFinite(model.begin)) {
    empty = "The recording is empty.";
    return;
  }
  playback.seek(model.begin);
  playback.playing = !still;
  map?.showWhole();
  map?.fit(model.begin);
  showTicks();
}

/** Where on the timeline policies decided something. */
function showTicks(): void {
  const span = Math.max(model.end - model.begin, 1);
  const marks = model.verdicts.values.filter(decided).map((verdict) => {
    const mark = document.createElement("span");
    mark.style.left = `${((verdict.time_ms - model.begin) / span) * 100}%`;
    mark.title = sentence(verdict);
    return mark;
  });
  byId("ticks").replaceChildren(...marks);
}

function show(): void {
  lists.show(playback.time, selected);
  showConnection();
  play.textContent = playback.playing || playback.following ? "Pause" : "Play";
  liveButton.hidden = !live;
  liveButton.setAttribute("aria-pressed", String(playback.following));
  if (!Number.isFinite(model.begin)) return;
  slider.min = String(model.begin);
  slider.max = String(model.end);
  slider.value = String(playback.time);
  const passed = `${duration(playback.time - model.begin)} of ${duration(model.end - model.begin)}`;
  slider.setAttribute("aria-valuetext", `${moment(playback.time)}, ${passed}`);
  output.textContent = `${clock(playback.time)} UTC · ${passed}`;
}

play.addEventListener("click", () => {
  if (playback.playing || playback.following) playback.pause();
  else playback.play(model.begin, model.end);
  show();
});
liveButton.addEventListener("click", () => {
  playback.follow(model.end);
  show();
});
byId<HTMLSelectElement>("speed").addEventListener("change", (event) => {
  playback.speed = Number((event.target as HTMLSelectElement).value);
});
byId("verdict-filter").addEventListener("change", show);
slider.addEventListener("input", () => seek(Number(slider.value)));
slider.addEventListener("keydown", (event) => {
  // The browser's own steps would be a tenth of a second.
  const steps: Record<string, number> = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 };
  const step = steps[event.key];
  if (step === undefined) return;
  event.preventDefault();
  seek(Math.min(Math.max(playback.time + step * 1000, model.begin), model.end));
});

let before = performance.now();
let listed = 0;

function frame(now: number): void {
  playback.tick(now - before, model.begin, model.end);
  before = now;
  map?.draw(playback.time, selected, now);
  if (now - listed > LISTS_PERIOD_MS) {
    listed = now;
    show();
  }
  requestAnimationFrame(frame);
}

void openMap();
setTimeout(() => tell(), FIRST_TIMEOUT_MS);
listen({
  events: (all) => {
    take(all);
    if (live || complete) tell();
  },
  connected: () => {
    lost = undefined;
    heard = performance.now();
  },
  lost: (forGood) => {
    const text = forGood
      ? "the server refused the page: open the address that `fractus view` printed again."
      : "the server does not answer; trying again.";
    lost = { since: lost?.since ?? Date.now(), text };
  },
});
requestAnimationFrame(frame);
