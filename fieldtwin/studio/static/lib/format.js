// Values, times and durations as text.

export function number(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "true" : "false";
  if (typeof value !== "number") return String(value);
  if (Number.isInteger(value)) return String(value);
  return String(Number(value.toPrecision(6)));
}

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
