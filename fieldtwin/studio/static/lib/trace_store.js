// The state of a trace at one instant, in the form that the views know from a running instance (store.js). It is read only.

import { get } from "./api.js";
import { Store } from "./store.js";

export const PREFIX = "trace:";
const GROWS_MS = 1000; // how often a trace that is not read to its end is asked for its extent
const SETTLED_MS = 120; // after this time without a move, what takes longer is fetched
const MOVING_MS = 400; // while the user moves or the run plays, it is fetched this often
const TICK_MS = 50;

export class TraceStore extends Store {
  constructor(name, seconds) {
    super(name);
    this.path = `/traces/${encodeURIComponent(name.slice(PREFIX.length))}`;
    this.instant = seconds === null ? null : Math.round(seconds * 1e9); // the wanted instant in ns
    this.settled = null; // the instant at which the user stayed
    this.settledAt = 0;
    this.speed = 1;
    this.playing = false;
    this.busy = false;
    this.connected = true;
  }

  async open() {
    await this.extend();
    if (!this.about) return;
    if (this.instant === null) this.instant = this.about.failed.find((check) => check.t_ns !== null)?.t_ns ?? (this.about.growing ? this.about.end_ns : 0);
    this.go(this.instant);
  }

  close() {
    super.close();
    clearTimeout(this.growing);
    clearTimeout(this.settling);
    clearInterval(this.player);
    this.closed = true;
  }

  /** Read the extent and the marks, and again while the trace grows. */
  async extend() {
    const followed = this.about && this.about.growing && this.instant >= this.about.end_ns && !this.playing;
    try {
      this.about = await get(this.path);
      this.error = "";
      this.connected = true;
    } catch (error) {
      if (!this.about) this.error = error.message;
      this.connected = false;
    }
    if (this.closed) return;
    if (this.about && (this.about.growing || this.about.behind_bytes > 0 || !this.connected)) {
      this.growing = setTimeout(() => this.extend(), GROWS_MS);
      if (this.instant !== null) followed ? this.go(this.about.end_ns) : this.show();
    }
    this.tell();
  }

  /** Move to an instant in ns, within the trace. */
  go(t) {
    this.instant = Math.max(0, Math.min(this.about.end_ns, Math.round(t)));
    clearTimeout(this.settling);
    const moved = performance.now() - this.settledAt;
    this.settling = setTimeout(() => this.settle(), moved > MOVING_MS ? 0 : SETTLED_MS);
    this.show();
    this.tell();
  }

  /** Fetch the state at the wanted instant. While an answer is awaited, only the latest wish is kept. */
  async show() {
    if (this.busy) {
      this.again = true;
      return;
    }
    this.busy = true;
    try {
      const status = await get(`${this.path}/state?at_ns=${this.instant}`);
      this.connected = true;
      if (!this.closed) this.takeStatus(status);
      this.rates = status.rates;
    } catch (error) {
      this.connected = false;
      this.failure = error.message;
    }
    this.busy = false;
    this.tell();
    if (this.again && !this.closed) {
      this.again = false;
      this.show();
    }
  }

  async settle() {
    const at = this.instant;
    this.settled = at;
    this.settledAt = performance.now();
    const [path] = location.hash.split("?");
    history.replaceState(null, "", `${path}?t=${at / 1e9}`);
    this.tell();
    try {
      const recent = await get(`${this.path}/recent?at_ns=${at}`);
      if (at === this.instant) this.recent = new Map(Object.entries(recent));
    } catch {
      this.recent = new Map(); // the state's own request shows the reason
    }
    this.tell();
  }

  play(on) {
    clearInterval(this.player);
    this.playing = on;
    if (on) {
      if (this.instant >= this.about.end_ns) this.instant = 0;
      let before = performance.now();
      this.player = setInterval(() => {
        const now = performance.now();
        this.go(this.instant + (now - before) * 1e6 * this.speed);
        before = now;
        if (this.instant >= this.about.end_ns && !this.about.growing) this.play(false);
      }, TICK_MS);
    }
    this.tell();
  }

  /** The instant that is shown; time does not pass by itself. */
  now() {
    return this.status?.now_ns ?? this.instant ?? 0;
  }

  get isTrace() {
    return true;
  }

  get mayOperate() {
    return false;
  }
}
