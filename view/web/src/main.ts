// Connects the parts of the page: events update the model, and the shown time updates map and lists.

import "./style.css";

import { loadBaseMap } from "./base_map";
import { byId } from "./elements";
import type { Event, Marker } from "./events";
import { Lists } from "./lists";
import type { Colours, FlightMap } from "./map";
import { Model } from "./model";
import { Playback } from "./playback";
import { listen } from "./stream";
import { clock, dateAndTime, duration, isIntervention, sentence } from "./text";

const LISTS_INTERVAL_MS = 250;
/** Time without a contact event after which the state is stale. Sources of a cluster send one every second. */
const CONTACT_TIMEOUT_MS = 10_000;
/** Maximum delay of the map. Without it, the map would be drawn twice: without and with the areas of the first events. */
const FIRST_EVENTS_TIMEOUT_MS = 1_000;
const SECOND_MS = 1_000;

interface Staleness {
  /** Unix milliseconds. */
  since: number;
  text: string;
}

const reducedMotion = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
let model = new Model();
let map: FlightMap | undefined;
const playback = new Playback();
const actions = { select, seek };
let lists = new Lists(model, actions);
let selected = "";
/** True once a live source has sent the current state. */
let live = false;
/** True once a recording was received completely. */
let complete = false;
/** Lost connection to the server. */
let lost: Staleness | undefined;
/** Time of the last contact event, on the clock of `performance.now`. */
let lastContact = performance.now();
let emptyText = "";

const play = byId<HTMLButtonElement>("play");
const liveButton = byId<HTMLButtonElement>("live");
const slider = byId<HTMLInputElement>("shown-time");
const output = byId<HTMLOutputElement>("clock");
const connection = byId("connection");
const mode = byId("mode");

function colours(): Colours {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(`--${name}`).trim();
}

let resolveFirstEvents: () => void;
const firstEvents = new Promise<void>((resolve) => (resolveFirstEvents = resolve));

async function openMap(): Promise<void> {
  try {
    const [module, baseMap] = await Promise.all([import("./map"), loadBaseMap(), firstEvents]);
    const time = complete ? model.begin : playback.time;
    map = new module.FlightMap(byId("map"), model, colours(), reducedMotion, select, baseMap, time);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => map?.paint(colours()));
    if (complete) map?.showWhole();
    byId("map-tools").hidden = false;
  } catch (error) {
    byId("map").hidden = true;
    byId("legend").hidden = true;
    const notice = byId("no-map");
    notice.textContent = "This browser has no WebGL, which the map requires. The lists show the same data.";
    notice.hidden = false;
    console.info("cannot show the map:", error);
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

function handle(batch: (Event | Marker)[]): void {
  for (const event of batch) {
    switch (event.type) {
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
        if (event.type === "contact") lastContact = performance.now();
        model.add(event);
    }
  }
}

/** Returns since when and why the shown state is stale, or undefined if it is current. */
function staleness(): Staleness | undefined {
  if (complete) return undefined;
  if (lost !== undefined) return lost;
  const contact = model.contact;
  if (contact === undefined) return undefined;
  if (contact.stale_since_ms !== null) return { since: contact.stale_since_ms, text: contact.text };
  const silenceMs = performance.now() - lastContact;
  if (silenceMs <= CONTACT_TIMEOUT_MS) return undefined;
  return { since: Date.now() - silenceMs, text: "the server sends no events" };
}

function showConnection(): void {
  const stale = staleness();
  const text = stale ? `Stale since ${clock(stale.since)} UTC: ${stale.text}` : (model.problems.at(-1)?.text ?? emptyText);
  if (connection.textContent !== text) connection.textContent = text;
  document.body.classList.toggle("stale", stale !== undefined);
  mode.textContent = modeText(stale !== undefined);
}

function modeText(isStale: boolean): string {
  if (complete) return "replay";
  if (isStale) return "stale";
  if (!live) return "connecting";
  return playback.following ? "live" : "paused";
}

/** Starts with an empty model, because the server sends the complete state again. The shown time stays. */
function restart(): void {
  model = new Model();
  lists.clear();
  lists = new Lists(model, actions);
  map?.follow(model);
}

/** Starts the replay of a recording that was received completely. */
function finish(): void {
  complete = true;
  if (!Number.isFinite(model.begin)) {
    emptyText = "The recording is empty.";
    return;
  }
  playback.seek(model.begin);
  playback.playing = !reducedMotion;
  map?.showWhole();
  map?.fit(model.begin);
  showTicks();
}

/** Marks interventions of policies on the timeline. */
function showTicks(): void {
  const span = Math.max(model.end - model.begin, 1);
  const marks = model.verdicts.values.filter(isIntervention).map((verdict) => {
    const mark = document.createElement("span");
    mark.style.left = `${((verdict.time_ms - model.begin) / span) * 100}%`;
    mark.title = sentence(verdict);
    return mark;
  });
  byId("ticks").replaceChildren(...marks);
}

function show(): void {
  lists.show(playback.time, selected, staleness()?.since);
  showConnection();
  play.textContent = playback.playing || playback.following ? "Pause" : "Play";
  liveButton.hidden = !live;
  liveButton.setAttribute("aria-pressed", String(playback.following));
  if (!Number.isFinite(model.begin)) return;
  slider.min = String(model.begin);
  slider.max = String(model.end);
  slider.value = String(playback.time);
  const progress = `${duration(playback.time - model.begin)} of ${duration(model.end - model.begin)}`;
  slider.setAttribute("aria-valuetext", `${dateAndTime(playback.time)}, ${progress}`);
  output.textContent = `${clock(playback.time)} UTC · ${progress}`;
}

byId("zoom-flight").addEventListener("click", () => map?.zoomToFlight(playback.time, selected));
byId("zoom-all").addEventListener("click", () => map?.zoomToAll());
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
  // Steps in seconds. The default steps of the browser are a tenth of a second.
  const steps: Record<string, number> = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 };
  const step = steps[event.key];
  if (step === undefined) return;
  event.preventDefault();
  seek(Math.min(Math.max(playback.time + step * SECOND_MS, model.begin), model.end));
});

let lastFrame = performance.now();
let lastLists = 0;

function frame(now: number): void {
  playback.tick(now - lastFrame, model.begin, model.end);
  lastFrame = now;
  map?.draw(playback.time, selected, now);
  if (now - lastLists > LISTS_INTERVAL_MS) {
    lastLists = now;
    show();
  }
  requestAnimationFrame(frame);
}

void openMap();
setTimeout(() => resolveFirstEvents(), FIRST_EVENTS_TIMEOUT_MS);
listen({
  events: (batch) => {
    handle(batch);
    if (live || complete) resolveFirstEvents();
  },
  connected: () => {
    lost = undefined;
    lastContact = performance.now();
  },
  lost: (refused) => {
    const text = refused
      ? "the server refused the connection; open the address that `fractus view` printed"
      : "the server does not respond, reconnecting";
    lost = { since: lost?.since ?? Date.now(), text };
  },
});
requestAnimationFrame(frame);
