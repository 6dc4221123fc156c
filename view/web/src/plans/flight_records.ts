// Records of the followed flight: verdicts, track and pictures. The page reads them from the drone as long as it follows the flight.

import { byId, setText } from "../elements";
import { clock, quantity } from "../text";
import { type Api, Problem, TEMPORARY } from "./api";
import { PictureList, latestPictures } from "./picture_list";
import { stateOf } from "./plan_list";
import type { PlanMap } from "./plan_map";
import { RecordPages } from "./record_pages";
import { hasPosition, trackFeatures } from "./shapes";
import type { FlightPlan, FlightVerdict, RecordedPicture, TrackPoint } from "./types";
import { VerdictList, type Zones, latestVerdicts, verdictSentence } from "./verdict_list";

/** Pause after a reading. Readings use the link of the drone, which sends records to one user at a time. */
const PAUSE_MS = 5_000;
const PAUSE_AFTER_ERROR_MS = 15_000;
const MAX_TRACK_POINTS = 4_000;
const READER_ROLES = "fractus-flightplan-editor and fractus-drone-viewer";

/** The parts of the page that records use. */
export interface RecordSurroundings {
  map(): PlanMap | undefined;
  zones: Zones;
  /** Announces a text to screen readers. */
  announce(text: string): void;
  /** Returns a sentence about an error. */
  explain(error: unknown): string;
}

export class FlightRecords {
  private client: Api | undefined;
  private name = "";
  private reading = new AbortController();
  private started = false;
  private ended = false;
  private track: TrackPoint[] = [];
  private pictures: PictureList | undefined;
  private readonly verdicts: VerdictList;
  private readonly status = byId("records-status");

  constructor(private readonly page: RecordSurroundings) {
    this.verdicts = new VerdictList(page.zones);
  }

  /** Shows the records of a plan from the start of its flight on. Called again at each change of the plan. Undefined: no records. */
  show(client: Api | undefined, plan: FlightPlan | undefined): void {
    const name = plan?.metadata.name ?? "";
    if (client !== this.client || name !== this.name) this.reset(client, name);
    if (client === undefined || plan === undefined) return;
    this.ended = stateOf(plan) === "Ended";
    if (this.started) return;
    this.started = Boolean(plan.status?.application);
    setText(this.status, this.started ? "The records are being read." : "The flight has no records, because it has not started.");
    if (this.started) void this.read(client, `/plans/${name}`, this.reading.signal);
  }

  /** Draws the track. */
  draw(): void {
    this.page.map()?.set("flown", trackFeatures(this.track));
  }

  private reset(client: Api | undefined, name: string): void {
    this.reading.abort();
    this.reading = new AbortController();
    this.client = client;
    this.name = name;
    this.started = false;
    this.verdicts.clear();
    this.pictures?.clear();
    this.showTrack([]);
    byId("records-section").hidden = client === undefined || name === "";
    byId("records").hidden = true;
    setText(byId("records-title"), `Records of ${name}`);
    setText(byId("pictures-status"), "");
  }

  /** Reads the records until another plan is followed, or until the flight has ended and a reading contained nothing new. */
  private async read(client: Api, path: string, signal: AbortSignal): Promise<void> {
    const verdicts = new RecordPages<FlightVerdict>(`${path}/verdicts`, latestVerdicts);
    const track = new RecordPages<TrackPoint>(`${path}/track`, thinned);
    const pictures = new RecordPages<RecordedPicture>(`${path}/pictures`, latestPictures);
    const list = new PictureList(client, `${path}/pictures`, signal, (error) => this.sentence(error));
    this.pictures = list;
    while (!signal.aborted) {
      const { ended } = this;
      let more: boolean;
      let pause = PAUSE_MS;
      try {
        more = await verdicts.read(client, signal);
        this.showVerdicts(verdicts.records);
        more = (await track.read(client, signal)) || more;
        this.showTrack(track.records);
        more = (await this.readPictures(client, pictures, list, signal)) || more;
        setText(this.status, "");
      } catch (error) {
        if (signal.aborted) return;
        setText(this.status, this.sentence(error));
        more = !(error instanceof Problem) || TEMPORARY.has(error.status);
        pause = PAUSE_AFTER_ERROR_MS;
      }
      if (ended && !more) return;
      await new Promise((resolve) => setTimeout(resolve, pause));
    }
  }

  /** Reads the list of pictures and at most one picture. Returns true if there was a new one. */
  private async readPictures(client: Api, pictures: RecordPages<RecordedPicture>, list: PictureList, signal: AbortSignal): Promise<boolean> {
    let more: boolean;
    try {
      more = await pictures.read(client, signal);
    } catch (error) {
      if (!(error instanceof Problem) || error.status !== 404) throw error;
      // The drone records no pictures, but has the other records.
      setText(byId("pictures-status"), error.message);
      return false;
    }
    setText(byId("pictures-status"), "");
    list.show(pictures.records);
    return (await list.loadNext()) || more;
  }

  private showVerdicts(verdicts: FlightVerdict[]): void {
    const added = this.verdicts.show(verdicts);
    const latest = added[0];
    // A user who begins to follow a flight reads the list.
    if (!byId("records").hidden && latest !== undefined) {
      const count = added.length === 1 ? "" : `${added.length} new verdicts, the latest: `;
      this.page.announce(`${this.name}: ${count}${verdictSentence(latest)}`);
    }
    byId("records").hidden = false;
  }

  private showTrack(track: TrackPoint[]): void {
    this.track = track;
    this.draw();
    const last = track.findLast(hasPosition);
    setText(byId("track"), last === undefined ? "No position yet." : positionText(last));
  }

  private sentence(error: unknown): string {
    const forbidden = error instanceof Problem && error.status === 403;
    return forbidden ? `You may not read the records. An administrator can give you the roles ${READER_ROLES}.` : this.page.explain(error);
  }
}

/** Returns a track with fewer points if it has too many. The older a part, the fewer of its points are kept. */
function thinned(points: TrackPoint[]): TrackPoint[] {
  return points.length <= MAX_TRACK_POINTS ? points : points.filter((_, index) => index % 2 === 0);
}

function positionText(point: TrackPoint): string {
  const place = `latitude ${point.lat?.toFixed(6)}°, longitude ${point.lon?.toFixed(6)}°`;
  const altitude = `altitude ${quantity(point.alt, 1, "m")} above home`;
  const speed = `speed ${quantity(point.speed, 1, "m/s")}`;
  const landed = point.inAir ? "in the air" : "on the ground";
  return `${clock(Date.parse(point.time))} UTC: ${place}, ${altitude}, ${speed}, ${landed}`;
}
