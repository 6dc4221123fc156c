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
  properties: { kind: string; name: string; component?: string; altitude?: Band; description?: string };
  geometry: GeoJSON.Polygon | GeoJSON.MultiPolygon | GeoJSON.LineString;
}

export interface Areas {
  type: "areas";
  origin: string;
  time_ms: number;
  features: Feature[];
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

export type Event = Fix | State | Verdict | Note | Areas | Picture | Problem;

/** What was told before is void; all up to now was told; a recording has no more. */
export type Sign = { type: "reset" } | { type: "live" } | { type: "end" };
