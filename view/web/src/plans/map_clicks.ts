// Clicks on the map: the next one selects a place if an input waits for it.

import type { Point } from "./types";

export class MapClicks {
  private waiting: { pick: (point: Point) => void; ended: () => void } | undefined;

  /** Passes the next click to `pick`, and calls `ended` after it, or when another input waits for a click. */
  wait(pick: (point: Point) => void, ended: () => void): void {
    this.cancel();
    this.waiting = { pick, ended };
  }

  cancel(): void {
    const { waiting } = this;
    this.waiting = undefined;
    waiting?.ended();
  }

  /** Returns true if an input was waiting for the click. */
  deliver(point: Point): boolean {
    const { waiting } = this;
    this.cancel();
    waiting?.pick(point);
    return waiting !== undefined;
  }
}
