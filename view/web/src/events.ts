// Generated from view/fractus_view/events.py by `make generate`. Do not edit.

/**
 * Position of a drone.
 *
 * Attributes:
 *     drone: Name of the drone's node, as in all events.
 *     time_ms: Time in Unix milliseconds, as in all events.
 *     lat: Latitude in degrees.
 *     lon: Longitude in degrees.
 *     amsl_m: Altitude above mean sea level in metres, or null if it is unknown.
 *     heading_deg: Heading in degrees clockwise from north, or null if it is unknown.
 */
export interface Fix {
  type: "fix";
  drone: string;
  time_ms: number;
  lat: number;
  lon: number;
  amsl_m: number | null;
  heading_deg: number | null;
}

/**
 * State of a drone.
 *
 * Attributes:
 *     altitude_m: Altitude above home in metres.
 *     speed_mps: Ground speed in metres per second.
 *     battery: Remaining charge from 0 to 1.
 *     mode: Flight mode of the autopilot, or an empty string.
 *     controller: Control authority, or an empty string.
 *     phase: Phase of the flight, for people.
 *     seen_ms: Time of the drone's report in Unix milliseconds, or null if it equals `time_ms`.
 *     flight_ms: Start of the current or latest flight in Unix milliseconds, or null if the source contains no flight.
 */
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
  flight_ms: number | null;
}

/** A drone was removed. Its earlier events are void. */
export interface Gone {
  type: "gone";
  drone: string;
  time_ms: number;
}

/**
 * Verdict on a call or on the flight.
 *
 * Attributes:
 *     kind: Kind of the audit entry: `call`, `monitor` or `takeover`.
 *     component: Component that called, or an empty string.
 *     method: Called method, or an empty string.
 *     action: Verdict on a call: `allow`, `correct`, `deny` or `takeover`.
 *     code: Reason for programs.
 *     reason: Reason for people.
 *     policies: Names of the policies that decided.
 *     lat: Latitude of the drone in degrees, or null if it is unknown.
 *     lon: Longitude of the drone in degrees, or null if it is unknown.
 */
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

/** Log line. Levels are those of foxglove.Log, from 1 (debug) to 5 (fatal). */
export interface Note {
  type: "note";
  drone: string;
  time_ms: number;
  level: number;
  text: string;
}

/** Altitude limits of an area in metres. A missing limit is unlimited. */
export interface AltitudeBand {
  lower?: number;
  upper?: number;
  reference?: string;
}

/**
 * Properties of an area or place.
 *
 * Attributes:
 *     kind: zone, operationArea, corridor, path, controlPoint, depot or edgeNode.
 *     uses: Effects of the policies that select a zone, from the most to the least restrictive. Missing: unknown.
 *     number: Number of a control point, which is its index in `controlPoints`.
 */
export interface FeatureProperties {
  kind: string;
  name: string;
  uses?: ("exclusion" | "noPictures" | "inclusion" | "denial" | "pictureFilter" | "altitudeLimit" | "speedLimit" | "grant")[];
  number?: number;
  application?: string;
  component?: string;
  altitude?: AltitudeBand;
  description?: string;
  state?: string;
}

/** GeoJSON geometry. */
export interface Geometry {
  type: "Polygon" | "MultiPolygon" | "LineString" | "MultiLineString" | "Point";
  coordinates: any[];
}

/** GeoJSON feature: a zone, area, planned path or place. */
export interface Feature {
  type: "Feature";
  properties: FeatureProperties;
  geometry: Geometry;
}

/** Zones, areas, planned paths and places of one origin. They replace the earlier ones of this origin. */
export interface Areas {
  type: "areas";
  origin: string;
  time_ms: number;
  features: Feature[];
}

/** State of an application. `reason` is for programs, `text` for people. */
export interface Application {
  name: string;
  drone: string;
  phase: string;
  reason: string;
  text: string;
}

/** All current applications. */
export interface Applications {
  type: "applications";
  time_ms: number;
  applications: Application[];
}

/**
 * Possible direct link between a drone and a node.
 *
 * Attributes:
 *     lat: Latitude of the node in degrees.
 *     lon: Longitude of the node in degrees.
 *     traffic: Current path of the traffic, `cloud` or `direct`, or an empty string if it is unknown.
 */
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

/** All currently possible direct links. */
export interface Links {
  type: "links";
  time_ms: number;
  links: Link[];
}

/** Summary of a policy and its zones. Without zones, the policy applies everywhere. */
export interface Policy {
  name: string;
  text: string;
  zones: string[];
}

/** All current policies. */
export interface Policies {
  type: "policies";
  time_ms: number;
  policies: Policy[];
}

/**
 * Staleness of the shown state. Sent about once per second, even without changes.
 *
 * Attributes:
 *     stale_since_ms: Time of the last contact in Unix milliseconds, or null if the state is current.
 *     text: Reason in one sentence, or an empty string.
 */
export interface Contact {
  type: "contact";
  time_ms: number;
  stale_since_ms: number | null;
  text: string;
}

/**
 * Completeness of the verdicts. Without this event, the source always has all verdicts.
 *
 * Attributes:
 *     verdicts_problem: Reason why verdicts may be missing, or an empty string.
 */
export interface Records {
  type: "records";
  time_ms: number;
  verdicts_problem: string;
}

/**
 * Completeness of the pictures of a cluster. Without this event, a cluster provides no pictures.
 *
 * Attributes:
 *     problem: Reason why pictures may be missing, or an empty string.
 */
export interface PictureSource {
  type: "picturesource";
  time_ms: number;
  problem: string;
}

/** Picture after privacy filters. The page requests it by `id`. */
export interface Picture {
  type: "picture";
  drone: string;
  time_ms: number;
  id: string;
}

/** Problem with the shown data, in one sentence. */
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
  | Records
  | PictureSource
  | Picture
  | Problem;

/** Markers of the stream: the complete current state follows, later events are live, the recording has ended. */
export type Marker = { type: "reset" } | { type: "live" } | { type: "end" };
