// What the server tells; `view/fractus_view/events.py` declares the same fields. Times are Unix milliseconds.

export interface Fix {
  type: "fix";
  drone: string;
  time_ms: number;
  lat: number;
  lon: number;
  amsl_m: number | null;
  heading_deg: number | null;
}

export interface State {
  type: "state";
  drone: string;
  time_ms: number;
  altitude_m: number | null;
  speed_mps: number | null;
  battery: number | null;
  mode: string;
  controller: string;
  phase: string;
  seen_ms: number | null;
}

export interface Gone {
  type: "gone";
  drone: string;
  time_ms: number;
}

export interface Verdict {
  type: "verdict";
  drone: string;
  time_ms: number;
  kind: string;
  component: string;
  method: string;
  action: string;
  code: string;
  reason: string;
  policies: string[];
  lat: number | null;
  lon: number | null;
}

export interface Note {
  type: "note";
  drone: string;
  time_ms: number;
  level: number;
  text: string;
}

export interface Band {
  lower?: number;
  upper?: number;
  reference?: string;
}

export interface Feature {
  type: "Feature";
  properties: {
    kind: string;
    name: string;
    application?: string;
    component?: string;
    altitude?: Band;
    description?: string;
    state?: string;
  };
  geometry: GeoJSON.Polygon | GeoJSON.MultiPolygon | GeoJSON.LineString | GeoJSON.MultiLineString | GeoJSON.Point;
}

export interface Areas {
  type: "areas";
  origin: string;
  time_ms: number;
  features: Feature[];
}

export interface Application {
  name: string;
  drone: string;
  phase: string;
  reason: string;
  text: string;
}

export interface Applications {
  type: "applications";
  time_ms: number;
  applications: Application[];
}

export interface Link {
  name: string;
  drone: string;
  node: string;
  lat: number;
  lon: number;
  phase: string;
  traffic: string;
  reason: string;
  text: string;
}

export interface Links {
  type: "links";
  time_ms: number;
  links: Link[];
}

export interface Policy {
  name: string;
  text: string;
  zones: string[];
}

export interface Policies {
  type: "policies";
  time_ms: number;
  policies: Policy[];
}

/** Whether what is shown is so now; told every second or so by sources that can lose sight of it. */
export interface Contact {
  type: "contact";
  time_ms: number;
  stale_since_ms: number | null;
  text: string;
}

export interface Picture {
  type: "picture";
  drone: string;
  time_ms: number;
  id: string;
}

export interface Problem {
  type: "problem";
  time_ms: number;
  text: string;
}

export type Event =
  | Fix
  | State
  | Gone
  | Verdict
  | Note
  | Areas
  | Applications
  | Links
  | Policies
  | Contact
  | Picture
  | Problem;

/** What was told before is void; all up to now was told; a recording has no more. */
export type Sign = { type: "reset" } | { type: "live" } | { type: "end" };
