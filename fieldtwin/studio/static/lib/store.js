// The state of one instance in this page: its description, the latest statuses, and the latest value of each tag.

import { useEffect, useState } from "../vendor/preact.js";
import { follow, get, of } from "./api.js";
import { number, typed } from "./format.js";

const RECENT_MS = 60_000;
const MOST_RECENT = 600;

export class Store {
  constructor(name) {
    this.name = name;
    this.about = null; // what GET /instances/NAME says
    this.status = null;
    this.programs = {}; // what GET /instances/NAME/plc/programs says
    this.programsOf = ""; // the PLC's process and restart that `programs` describes
    this.error = "";
    this.connected = false;
    this.dropped = 0;
    this.frames = { total: 0, behind_bytes: 0 };
    this.recent = new Map(); // tag -> [[time in ns, number or null], ...] of the last minute, for sparklines
    this.rates = {}; // bus -> requests in a second
    this.listeners = new Set();
    this.frameListeners = new Set(); // called when the number of frames has changed
    this.waiting = 0;
    this.beginning = false; // whether the description of another run is being fetched
    this.path = of(name);
  }

  async open() {
    try {
      this.about = await get(this.path);
    } catch (error) {
      this.error = error.message;
      this.tell();
      return;
    }
    this.leave = follow(
      this.name,
      (update) => this.take(update),
      (connected) => {
        this.connected = connected;
        this.tell();
      },
    );
    this.tell();
  }

  close() {
    this.leave?.();
    cancelAnimationFrame(this.waiting);
  }

  take(update) {
    if (update.type === "hello") this.begin(update);
    else if (this.beginning) return; // the hello has all of it
    else if (update.type === "status") this.takeStatus(update.status);
    else if (update.type === "tags") this.takeTags(update.changes);
    else if (update.type === "frames") {
      this.frames = update;
      for (const listener of this.frameListeners) listener(); // at once: the rows are then fetched without waiting for the next drawing
    }
    else if (update.type === "dropped") this.dropped = update.count;
    this.tell();
  }

  /** A connection begins. If another run has started under the same name, everything that is known of the earlier one is dropped. */
  async begin({ started_ns, status }) {
    if (this.about.started_ns !== started_ns) {
      Object.assign(this, { status: null, programs: {}, programsOf: "", rates: {}, dropped: 0 });
      this.recent.clear();
      this.beginning = true;
      try {
        this.about = await get(this.path);
      } catch (error) {
        this.error = error.message;
      }
      this.beginning = false;
    }
    this.takeStatus(status);
    this.tell();
    this.fetchRecent();
  }

  /** The last minute before this page was opened, or before the connection was made again. Later changes arrive as updates. */
  async fetchRecent() {
    let found;
    try {
      found = await get(`${this.path}/recent`);
    } catch {
      return; // the sparklines then begin with the next change
    }
    for (const [name, points] of Object.entries(found)) {
      const last = points.length ? points[points.length - 1][0] : -Infinity;
      this.recent.set(name, [...points, ...(this.recent.get(name) ?? []).filter(([t]) => t > last)]);
    }
    this.tell();
  }

  takeStatus(status) {
    const before = this.status;
    if (before?.gateway && status.gateway) {
      const seconds = (status.now_ns - before.now_ns) / 1e9;
      for (const [name, bus] of Object.entries(status.gateway.buses)) {
        const count = traffic(bus) - traffic(before.gateway.buses[name]);
        if (seconds > 0.2) this.rates[name] = Math.max(0, count / seconds);
      }
    }
    this.status = status;
    this.at = performance.now();
    if (status.frames) this.frames = status.frames;
    if (status.plc) this.describePrograms(`${status.plc.pid} ${status.plc.restarts}`);
  }

  async describePrograms(run) {
    if (run === this.programsOf) return;
    this.programsOf = run;
    try {
      this.programs = await get(`${this.path}/plc/programs`);
    } catch {
      this.programsOf = ""; // tried again with the next status
    }
    this.tell();
  }

  /** A value of a program's variable: by its name, if the program gives names to its values; a time as a literal. */
  word(program, variable, value) {
    const about = this.programs[program]?.variables[variable];
    return about?.words[String(value)] ?? typed(value, about?.type);
  }

  /** A value of a tag: by its name, if a program or the profile gives names to its values. */
  wordOf(tag, value) {
    for (const { variables } of Object.values(this.programs))
      for (const v of Object.values(variables)) if (v.tag === tag && (v.words[String(value)] || v.type)) return v.words[String(value)] ?? typed(value, v.type);
    return this.tagOf(tag)?.values[String(value)] ?? number(value);
  }

  /** The present value of a program's variable; undefined if the PLC does not answer. */
  variable(program, variable) {
    const plc = this.status?.plc;
    const about = this.programs[program]?.variables[variable];
    if (about?.role === "input") return plc?.forces[about.tag]?.value ?? plc?.inputs[about.tag]?.value ?? plc?.outputs[about.tag];
    return plc?.variables[`${program}.${variable}`];
  }

  takeTags(changes) {
    for (const [name, t, value, quality, reason] of changes) {
      const seen = this.status?.gateway?.tags?.[name];
      if (seen) {
        Object.assign(seen, { value, quality, reason, age_s: Math.max(0, (this.now() - t) / 1e9) });
        delete seen.text;
      }
      if (typeof value === "string") continue; // a text has no sparkline
      const points = this.recent.get(name) ?? [];
      points.push([t, quality === "good" ? Number(value) : null]);
      const oldest = t - RECENT_MS * 1e6;
      while (points.length > MOST_RECENT || (points.length > 1 && points[1][0] < oldest)) points.shift();
      this.recent.set(name, points);
    }
  }

  /** The present time on the run's clock. */
  now() {
    return this.status ? this.status.now_ns + (performance.now() - this.at) * 1e6 : 0;
  }

  get tags() {
    return this.status?.gateway?.tags ?? {};
  }

  /** Whether this is a trace as of one instant (trace_store.js), and not a running instance. */
  get isTrace() {
    return false;
  }

  get mayOperate() {
    return this.about?.role === "operate";
  }

  get isPrototype() {
    return this.about?.mode === "prototype";
  }

  tagOf(full) {
    const at = full.lastIndexOf(".");
    return this.about?.system.devices[full.slice(0, at)]?.tags[full.slice(at + 1)];
  }

  /** Views are drawn once a frame at most, however many updates arrive. */
  tell() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      for (const listener of this.listeners) listener();
    });
  }
}

const traffic = (bus) =>
  bus ? (bus.counters.requests ?? bus.counters.sdo_requests ?? 0) + (bus.counters.pdos ?? 0) + (bus.counters.heartbeats ?? 0) : 0;

/** Draw the component again when the store changes. */
export function useStore(store) {
  const [, again] = useState(0);
  useEffect(() => {
    const listener = () => again((n) => n + 1);
    store.listeners.add(listener);
    return () => store.listeners.delete(listener);
  }, [store]);
  return store;
}
