// Values, times and durations as text.

export function number(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "true" : "false";
  if (typeof value !== "number") return String(value);
  if (Number.isInteger(value)) return String(value);
  return String(Number(value.toPrecision(6)));
}

const DURATION = [["d", 86_400_000_000_000n], ["h", 3_600_000_000_000n], ["m", 60_000_000_000n], ["s", 1_000_000_000n], ["ms", 1_000_000n], ["us", 1_000n], ["ns", 1n]];
const LONG_NS = 1e6; // from this on, a duration is shown in whole microseconds

/** A number of ns as IEC 61131-3 writes a duration: T#1m2s500ms. */
function duration(ns) {
  const size = Math.abs(ns);
  let rest = BigInt(size < LONG_NS ? Math.round(size) : Math.round(size / 1000) * 1000);
  let text = "";
  for (const [unit, of] of DURATION) {
    if (rest >= of) text += `${rest / of}${unit}`;
    rest %= of;
  }
  return `T#${ns < 0 ? "-" : ""}${text || "0s"}`;
}

const moment = (ns, from, to) => new Date(ns / 1e6).toISOString().slice(from, to);
const LITERALS = {
  TIME: duration,
  LTIME: duration,
  DATE: (ns) => `D#${moment(ns, 0, 10)}`,
  LDATE: (ns) => `LD#${moment(ns, 0, 10)}`,
  TOD: (ns) => `TOD#${moment(ns, 11, 19)}`,
  LTOD: (ns) => `LTOD#${moment(ns, 11, 19)}`,
  DT: (ns) => `DT#${moment(ns, 0, 10)}-${moment(ns, 11, 19)}`,
  LDT: (ns) => `LDT#${moment(ns, 0, 10)}-${moment(ns, 11, 19)}`,
};
LITERALS.TIME_OF_DAY = LITERALS.TOD;
LITERALS.DATE_AND_TIME = LITERALS.DT;
const MOST_MS = 8.64e15; // the limit of a Date

/** A value of a variable of an IEC type: times and dates, which are numbers of ns, as literals. */
export function typed(value, type) {
  const literal = typeof value === "number" && Math.abs(value) / 1e6 <= MOST_MS && LITERALS[type];
  return literal ? literal(value) : number(value);
}

/** The unit to show after a value that `typed` shows: a literal has its own. */
export const unitAfter = (unit, type) => (type in LITERALS ? "" : (unit ?? ""));

/** A tag's value: with the name that the profile gives to it, if there is one. */
export function value(seen, tag) {
  if (!seen) return "–";
  const name = seen.text ?? (typeof seen.value === "number" ? tag?.values?.[String(seen.value)] : undefined);
  return name ? `${number(seen.value)} (${name})` : number(seen.value);
}

export function age(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  seconds = Math.max(0, seconds);
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return `${Math.round(seconds / 3600)} h`;
}

export function milliseconds(ns) {
  if (ns === null || ns === undefined) return "";
  const ms = ns / 1e6;
  return ms < 10 ? `${ms.toFixed(2)} ms` : ms < 1000 ? `${ms.toFixed(1)} ms` : `${(ms / 1000).toFixed(2)} s`;
}

/** A time since the start of the run: 1:02:03.456. */
export function clock(ns) {
  const s = Math.max(0, ns) / 1e9;
  const hours = Math.floor(s / 3600);
  const minutes = Math.floor(s / 60) % 60;
  const seconds = (s % 60).toFixed(3).padStart(6, "0");
  return hours ? `${hours}:${String(minutes).padStart(2, "0")}:${seconds}` : `${minutes}:${seconds}`;
}

/** Reasons of the gateway in words: never_read becomes "never read". */
export const reason = (text) => (text && text !== "none" ? text.replaceAll("_", " ") : "");

export const hex = (bytes) => (bytes ?? "").replace(/../g, "$& ").trim();

/** A fault or scenario part as YAML of one level, which is what people copy into a file. */
export function yaml(fields) {
  const plain = (v) => (typeof v === "string" ? (/^[A-Za-z_][\w .-]*$/.test(v) ? v : JSON.stringify(v)) : JSON.stringify(v));
  return "{" + Object.entries(fields).map(([k, v]) => `${k}: ${plain(v)}`).join(", ") + "}";
}

/** A number of things: "1 tag", "2 tags". */
export const count = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
