// Selects the time that the page shows.

/** The page jumps to the latest event if it is further behind than this. Otherwise it catches up. */
const MAX_CATCH_UP_MS = 15_000;
/** Usual delay of a live page. */
const LIVE_DELAY_MS = 1_000;
const CATCH_UP_RATE = 1.25;

export class Playback {
  /** Shown time in Unix milliseconds. */
  time = 0;
  playing = false;
  speed = 1;
  /** True if the page follows live events. */
  following = false;

  /** Advances the shown time. It advances evenly, although events arrive in batches. */
  tick(elapsedMs: number, begin: number, end: number): void {
    if (!Number.isFinite(begin)) return;
    if (this.following) {
      const behindMs = end - this.time;
      const rate = behindMs > 2 * LIVE_DELAY_MS ? CATCH_UP_RATE : 1;
      const jumps = behindMs > MAX_CATCH_UP_MS || behindMs < 0;
      this.time = jumps ? end : Math.min(this.time + elapsedMs * rate, end);
      return;
    }
    if (this.playing) this.time += elapsedMs * this.speed;
    this.time = Math.max(this.time, begin);
    if (this.time >= end) {
      this.time = end;
      this.playing = false;
    }
  }

  seek(time: number): void {
    this.following = false;
    this.time = time;
  }

  /** Plays from the shown time, or from the beginning if the shown time is the end. */
  play(begin: number, end: number): void {
    if (this.time >= end) this.time = begin;
    this.following = false;
    this.playing = true;
  }

  pause(): void {
    this.following = false;
    this.playing = false;
  }

  follow(end: number): void {
    this.following = true;
    this.time = end;
  }
}
