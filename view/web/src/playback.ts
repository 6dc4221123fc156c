// Which moment is shown.

/** Further behind what happens than this, the page jumps instead of catching up. */
const JUMP_MS = 15_000;
const BEHIND_MS = 1_000;

export class Playback {
  time = 0;
  playing = false;
  speed = 1;
  /** Whether the page follows what happens now. */
  following = false;

  /** Let some milliseconds pass. What is told comes in pieces: the moment moves on evenly all the same. */
  tick(passed: number, begin: number, end: number): void {
    if (!Number.isFinite(begin)) return;
    if (this.following) {
      const behind = end - this.time;
      const rate = behind > 2 * BEHIND_MS ? 1.25 : 1;
      this.time = behind > JUMP_MS || behind < 0 ? end : Math.min(this.time + passed * rate, end);
      return;
    }
    if (this.playing) this.time += passed * this.speed;
    this.time = Math.max(this.time, begin);
    if (this.time >= end) {
      this.time = end;
      this.playing = false;
    }
  }

  /** Show another moment. */
  seek(time: number): void {
    this.following = false;
    this.time = time;
  }

  /** Begin to play, again from the beginning if it is at the end. */
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
