// Connects the parts of the page: sign-in, form with check, map, and list of plans.

import "../style.css";
import "./plans.css";

import { byId, setText } from "../elements";
import { clock } from "../text";
import { Api, Problem, type Reply, TEMPORARY } from "./api";
import { showFindings } from "./decision";
import { differences } from "./differences";
import { FlightRecords } from "./flight_records";
import { PlanForm } from "./plan_form";
import { PlanList, stateOf } from "./plan_list";
import { MapClicks } from "./map_clicks";
import type { PlanMap } from "./plan_map";
import { Restrictions } from "./restrictions";
import { pointFeature, routeFeatures, specFeatures, volumeFeatures } from "./shapes";
import type { ApplicationTemplate, Drone, FlightPlan, FlightPlanSpec, FlightPlanStatus, Permissions, Point } from "./types";

const CHECK_DELAY_MS = 500;
const CHECK_RETRY_MS = 5_000;
const REFRESH_MS = 10_000;
const CHANGE_ATTEMPTS = 5;
const RESERVING = new Set(["Accepted", "Activated", "Nonconforming", "Contingent"]);

let api: Api | undefined;
let plans: FlightPlan[] = [];
let drones: Drone[] = [];
let map: PlanMap | undefined;
let view: "flights" | "restrictions" = "flights";
/** Time since which the server does not respond, in Unix milliseconds. */
let lost: number | undefined;
/** Plan that the form changes, in the version that the user has seen. Undefined: the form submits a new plan. */
let changed: FlightPlan | undefined;
/** Status of the last check or submission of the entered plan. */
let decision: FlightPlanStatus | undefined;
/** Reason why the entered plan could not be checked, or an empty text. */
let unchecked = "";
/** True if the entered plan is submitted. */
let submitted = false;
/** Key of the entered plan, so that a repeated submission creates no second plan. */
let key = "";
let checkTimer = 0;
let checking = new AbortController();
let following = new AbortController();
let followed = "";

const clicks = new MapClicks();
const submit = byId<HTMLButtonElement>("submit");
const form = new PlanForm(clicks, edited, () => map?.fit(routeOfForm()));
const list = new PlanList({
  follow,
  start: (plan) => void act(plan, (client) => sendSeen(client, plan, "POST", ":activate")),
  end: (plan) => {
    if (confirm(`End ${plan.metadata.name}? A drone in the air returns home.`)) void act(plan, (client) => client.send("POST", pathOf(plan, ":end")));
  },
  change: beginChange,
  remove: (plan) => {
    if (confirm(`Delete ${plan.metadata.name}?`)) void act(plan, (client) => sendSeen(client, plan, "DELETE", ""));
  },
});

const restrictions = new Restrictions({
  api: () => api,
  map: () => map,
  clicks,
  explain: (error) => (isExpired(error) ? undefined : sentence(error)),
});

const records = new FlightRecords({
  map: () => map,
  zones: { has: (policy) => restrictions.has(policy), show: (policy) => restrictions.showArea(policy) },
  announce: (text) => setText(byId("announcer"), text),
  explain: sentence,
});

// -- sign-in --

async function signIn(token: string, namespace: string): Promise<void> {
  showProblem("sign-in-problem", "");
  api = new Api(token, namespace, {
    connected: () => (lost = undefined),
    lost: () => (lost ??= Date.now()),
  });
  try {
    plans = await api.list<FlightPlan>("/plans");
    const templates = await readable<ApplicationTemplate>(api, "/apps");
    drones = (await readable<Drone>(api, "/drones")) ?? [];
    await restrictions.load(api);
    const permissions = (await api.send<Permissions>("GET", "/permissions")).body;
    restrictions.permit(permissions.publishRestrictions);
    form.permitPriority(permissions.prioritize);
    form.offer(templates, drones.map(({ metadata }) => metadata.name));
  } catch (error) {
    signOut(sentence(error));
    return;
  }
  sessionStorage.setItem("token", token);
  sessionStorage.setItem("namespace", namespace);
  showSignedIn(true);
  byId("plan-title").focus();
  edited();
  showPlans();
  showDrones();
}

/** Returns a list, or undefined if the user may not read it. */
async function readable<T>(client: Api, path: string): Promise<T[] | undefined> {
  try {
    return await client.list<T>(path);
  } catch (error) {
    if (error instanceof Problem && error.status === 403) return undefined;
    throw error;
  }
}

function signOut(reason = ""): void {
  api = undefined;
  stopChecking();
  following.abort();
  followed = "";
  plans = [];
  drones = [];
  changed = undefined;
  form.release();
  showPlans();
  showDrones();
  map?.set("selected", []);
  sessionStorage.removeItem("token");
  byId<HTMLInputElement>("token").value = "";
  showSignedIn(false);
  restrictions.clear();
  showProblem("sign-in-problem", reason);
  byId("token").focus();
}

function showSignedIn(signedIn: boolean): void {
  byId("sign-in-section").hidden = signedIn;
  for (const id of ["views", "restrictions-section", "sign-out"]) byId(id).hidden = !signedIn;
  for (const id of ["plan-section", "plans-section"]) byId(id).hidden = !signedIn || view !== "flights";
  byId("publish-section").hidden = !signedIn || view !== "restrictions";
}

function showView(shown: typeof view): void {
  view = shown;
  clicks.cancel();
  for (const name of ["flights", "restrictions"]) byId(`view-${name}`).setAttribute("aria-pressed", String(name === view));
  showSignedIn(true);
  showRoute();
  showRestrictions();
}

/** Shows the restrictions during the entered flight, or all of them beside the form of a restriction. */
function showRestrictions(): void {
  restrictions.setWindow(view === "flights" ? form.window : undefined);
}

// -- check and submission --

/** Called after each change of the form: checks the plan when the user pauses. */
function edited(): void {
  stopChecking();
  submitted = false;
  unchecked = "";
  key = randomKey();
  showRoute();
  showRestrictions();
  if (changed === undefined) decision = undefined;
  if (form.problem === "") checkTimer = window.setTimeout(() => void check(), CHECK_DELAY_MS);
  showDecision();
}

function stopChecking(): void {
  clearTimeout(checkTimer);
  checking.abort();
}

async function check(): Promise<void> {
  if (api === undefined) return;
  checking = new AbortController();
  const { signal } = checking;
  const spec = form.spec;
  try {
    const { body } = await api.send<FlightPlan>("POST", changed === undefined ? "/plans:check" : pathOf(changed, ":check"), spec, {}, signal);
    if (signal.aborted) return;
    decide(body.status ?? {});
    // The policies have changed, and with them the selected actions.
    if (JSON.stringify(form.choices.actions) !== JSON.stringify(spec.policyActions)) edited();
  } catch (error) {
    if (signal.aborted || isExpired(error)) return;
    unchecked = sentence(error);
    if (!(error instanceof Problem) || TEMPORARY.has(error.status)) checkTimer = window.setTimeout(() => void check(), CHECK_RETRY_MS);
    showDecision();
  }
}

function decide(status: FlightPlanStatus): void {
  decision = status;
  form.choices.show(status.restrictions ?? []);
  showFindings(status, showPlan);
  showDecision();
  map?.set("operationArea", volumeFeatures(status.volumes ?? []));
  const others = [...(status.refusals ?? []), ...(status.advisories ?? [])].map(({ plan }) => plan);
  const conflicting = plans.filter((plan) => others.includes(nameOf(plan)));
  map?.set("selected", conflicting.flatMap((plan) => volumeFeatures(plan.status?.volumes ?? [])));
}

/** Returns why the plan cannot be submitted, or an empty text. */
function obstacle(): string {
  if (submitted) return "The plan is submitted.";
  if (form.problem) return form.problem;
  const missing = form.choices.missing;
  if (missing.length > 0) return `Select an action for ${missing.join(", ")}.`;
  if (changed !== undefined) return "";
  if (decision === undefined) return unchecked || "The plan is being checked.";
  return decision.state === "Accepted" ? "" : "Change the plan to submit it.";
}

function showDecision(): void {
  const result = decision === undefined ? "" : `${decision.state ?? "Draft"}: ${decision.message ?? "not decided"}.`;
  const reason = obstacle();
  const present = changed === undefined ? result : `You change ${changed.metadata.name}. ${result}`;
  setText(byId("decision"), [present, reason].filter(Boolean).join(" "));
  if (decision === undefined) {
    showFindings(undefined, showPlan);
    map?.set("operationArea", []);
  }
  submit.disabled = reason !== "";
  submit.textContent = changed === undefined ? "Submit the plan" : "Change the plan";
  byId("keep").hidden = changed === undefined;
}

async function submitPlan(): Promise<void> {
  if (api === undefined || obstacle() !== "") return;
  submit.disabled = true;
  showProblem("submit-problem", "");
  const spec = form.spec;
  const before = key;
  const target = changed;
  try {
    const plan = target === undefined ? await create(api, spec) : await replace(api, target, spec);
    if (plan === undefined) return;
    put(plan);
    follow(plan);
    if (key === before) {
      changed = undefined;
      form.release();
      submitted = true;
      stopChecking();
      decide(plan.status ?? {});
      byId("plans-title").focus();
    } else if (target !== undefined && changed === target) {
      // The user has edited the form meanwhile, so the form still changes the plan.
      changed = plan;
    }
  } catch (error) {
    if (!isExpired(error)) showProblem("submit-problem", sentence(error));
  } finally {
    showDecision();
  }
}

async function create(client: Api, spec: FlightPlanSpec): Promise<FlightPlan> {
  return (await client.send<FlightPlan>("POST", "/plans", spec, { "Idempotency-Key": key })).body;
}

/** Replaces a plan. Returns undefined if another user has changed it, and shows the differences. */
async function replace(client: Api, plan: FlightPlan, spec: FlightPlanSpec): Promise<FlightPlan | undefined> {
  try {
    return (await sendSeen(client, plan, "PUT", "", spec)).body;
  } catch (error) {
    if (!(error instanceof Changed)) throw error;
    if (changed === plan) changed = error.plan;
    const text = differences(error.plan.spec, spec) || "both versions are equal";
    showProblem("submit-problem", `Another user changed the plan meanwhile: ${text}. To replace that version by yours, press “Change the plan” again.`);
    return undefined;
  }
}

/** Thrown if a plan is not the one that the user has seen. */
class Changed extends Error {
  constructor(readonly plan: FlightPlan) {
    super();
  }
}

/** Sends a request about the version of a plan that the user has seen. Throws a Changed if another user has changed the plan. */
async function sendSeen(client: Api, plan: FlightPlan, method: string, action: string, body?: FlightPlanSpec): Promise<Reply<FlightPlan>> {
  let present = plan;
  for (let attempt = 1; ; attempt++) {
    try {
      return await client.send<FlightPlan>(method, pathOf(plan, action), body, { "If-Match": `"${present.metadata.resourceVersion}"` });
    } catch (error) {
      if (!(error instanceof Problem) || error.status !== 412 || attempt === CHANGE_ATTEMPTS) throw error;
    }
    present = (await client.send<FlightPlan>("GET", pathOf(plan))).body;
    // The status of a plan is part of its version. It matters only if the user would delete a flight.
    const reserved = method === "DELETE" && RESERVING.has(stateOf(present));
    if (reserved || differences(present.spec, plan.spec) !== "") throw new Changed(present);
  }
}

function beginChange(plan: FlightPlan): void {
  const before = changed;
  try {
    changed = plan;
    form.show(plan.spec);
    showProblem("plans-problem", "");
  } catch (error) {
    changed = before;
    showProblem("plans-problem", sentence(error));
    return;
  }
  decide(plan.status ?? {});
  byId("plan-title").focus();
}

function endChange(): void {
  changed = undefined;
  form.release();
  showProblem("submit-problem", "");
  edited();
}

// -- plans --

async function refresh(): Promise<void> {
  const client = api;
  if (client === undefined) return;
  try {
    const present = await client.list<FlightPlan>("/plans");
    if (client !== api) return;
    plans = present;
    await restrictions.load(client);
  } catch (error) {
    if (!isExpired(error)) lost ??= Date.now();
  }
  showPlans();
}

async function act(plan: FlightPlan, send: (client: Api) => Promise<Reply<FlightPlan>>): Promise<void> {
  if (api === undefined) return;
  showProblem("plans-problem", "");
  try {
    const { status, body } = await send(api);
    if (status === 204) plans = plans.filter(({ metadata }) => metadata.name !== plan.metadata.name);
    else put(body);
  } catch (error) {
    if (error instanceof Changed) {
      put(error.plan);
      const text = differences(error.plan.spec, plan.spec) || `its state is now ${stateOf(error.plan)}`;
      showProblem("plans-problem", `The plan ${plan.metadata.name} was changed meanwhile: ${text}. Nothing was done.`);
    } else if (!isExpired(error)) showProblem("plans-problem", sentence(error));
  }
  showPlans();
}

/** Follows the changes of one plan. Browsers limit the connections to a server, so the other plans are read regularly. */
function follow(plan: FlightPlan): void {
  following.abort();
  following = new AbortController();
  followed = plan.metadata.name;
  // Read the records again if the plan was followed before.
  records.show(undefined, undefined);
  showPlans();
  showPlan(nameOf(plan));
  let state = stateOf(plan);
  const handle = (event: string, data: unknown): void => {
    if (event === "plan") {
      put(data as FlightPlan);
      if (stateOf(data as FlightPlan) !== state) setText(byId("announcer"), `${plan.metadata.name}: ${stateOf(data as FlightPlan)}`);
      state = stateOf(data as FlightPlan);
    }
    if (event === "error") showProblem("plans-problem", (data as { detail: string }).detail);
    if (event === "deleted") plans = plans.filter(({ metadata }) => metadata.name !== plan.metadata.name);
    showPlans();
  };
  api?.follow(pathOf(plan, "/events"), following.signal, handle).catch((error: unknown) => {
    if (!isExpired(error)) showProblem("plans-problem", sentence(error));
  });
}

function put(plan: FlightPlan): void {
  plans = [...plans.filter(({ metadata }) => metadata.name !== plan.metadata.name), plan];
}

function showPlans(): void {
  list.show(plans, followed);
  records.show(api, plans.find(({ metadata }) => metadata.name === followed));
  const others = plans.filter((plan) => RESERVING.has(stateOf(plan)) && plan.metadata.name !== changed?.metadata.name);
  map?.set("corridor", others.flatMap(({ status }) => volumeFeatures([...(status?.volumes ?? []), ...(status?.offNominalVolumes ?? [])])));
}

/** Shows a plan with the name namespace/name on the map. */
function showPlan(name: string): void {
  const plan = plans.find((each) => nameOf(each) === name);
  if (plan === undefined) {
    showProblem("submit-problem", `You cannot see the plan ${name}, because it is in another namespace or was deleted.`);
    return;
  }
  if (map === undefined) return;
  const features = [...specFeatures(plan.spec), ...volumeFeatures(plan.status?.volumes ?? [])];
  map.set("selected", features);
  map.fit(features);
}

// -- map and connection --

function showRoute(): void {
  map?.set("path", view === "flights" ? routeOfForm() : []);
  map?.set("landing", view === "flights" ? form.landingPlaces.map(pointFeature) : []);
}

function routeOfForm(): GeoJSON.Feature[] {
  return routeFeatures(form.route.points, form.route.isRegion);
}

function showDrones(): void {
  const positions = drones.flatMap(({ status }) => (status?.position ? [status.position] : []));
  map?.set("depot", positions.map(pointFeature));
}

function clicked(point: Point): void {
  if (api === undefined || clicks.deliver(point)) return;
  if (view === "flights") form.route.add(point);
  else restrictions.addPoint(point);
}

async function openMap(): Promise<void> {
  const style = getComputedStyle(document.documentElement);
  const colours = (name: string): string => style.getPropertyValue(`--${name}`).trim();
  try {
    const { PlanMap } = await import("./plan_map");
    map = new PlanMap(byId("map"), colours, clicked);
    const opened = map;
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => opened.paint(colours));
  } catch (error) {
    document.body.classList.add("without-map");
    byId("map").hidden = true;
    byId("legend").hidden = true;
    byId("no-map").hidden = false;
    byId("no-map").textContent = "This browser has no WebGL, which the map requires. Enter coordinates instead.";
    console.info("cannot show the map:", error);
    return;
  }
  showRoute();
  showDrones();
  showPlans();
  records.draw();
  restrictions.draw();
}

function showConnection(): void {
  setText(byId("connection"), lost === undefined ? "" : `Stale since ${clock(lost)} UTC: the server does not respond, reconnecting`);
  document.body.classList.toggle("stale", lost !== undefined);
}

/** Signs out and returns true if the server refuses the token. */
function isExpired(error: unknown): boolean {
  const expired = error instanceof Problem && error.status === 401;
  if (expired) signOut(error.message);
  return expired;
}

function sentence(error: unknown): string {
  return error instanceof TypeError ? "The server does not respond. Try again." : (error as Error).message;
}

function showProblem(id: string, text: string): void {
  setText(byId(id), text);
}

function nameOf({ metadata }: FlightPlan): string {
  return `${metadata.namespace ?? ""}/${metadata.name}`;
}

function pathOf({ metadata }: FlightPlan, action = ""): string {
  return `/plans/${metadata.name}${action}`;
}

function randomKey(): string {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

byId("sign-in").addEventListener("submit", (event) => {
  event.preventDefault();
  void signIn(byId<HTMLInputElement>("token").value.trim(), byId<HTMLInputElement>("namespace").value.trim());
});
byId("sign-out").addEventListener("click", () => {
  signOut();
  // The next user of the tab must not see the form and the map of this one.
  location.reload();
});
byId("plan").addEventListener("submit", (event) => {
  event.preventDefault();
  void submitPlan();
});
byId("view-flights").addEventListener("click", () => showView("flights"));
byId("view-restrictions").addEventListener("click", () => showView("restrictions"));
byId("keep").addEventListener("click", endChange);
setInterval(() => void refresh(), REFRESH_MS);
setInterval(showConnection, 250);
void openMap().then(() => {
  const token = sessionStorage.getItem("token");
  const namespace = sessionStorage.getItem("namespace") ?? "";
  byId<HTMLInputElement>("namespace").value = namespace;
  if (token !== null) void signIn(token, namespace);
});
