// The values of a tag or variable as a chart draws them: numbers in the unit of its axis, or steps between values with names.

const MOST_LEVELS = 40; // further texts share one level
const OTHERS = "other values";
const NS_PER_S = 1e9;

/** A series of a fetched history. `words`: names of numbers. `known`: the levels of this series so far, so that a level keeps its place. */
export function seriesOf(answer, { unit = "", words = {} }, known = []) {
  // In a trace, variables of programs have no quality.
  const found = { ...answer, points: answer.points.map(([t, value, quality, why]) => [t, value, quality || "good", why]) };
  const values = found.points.map(([, value]) => value).filter((value) => value !== null && value !== undefined);
  const have = (test) => values.length > 0 && values.every(test);
  if (have((v) => typeof v === "boolean")) return stepped(found, ["FALSE", "TRUE"], (v) => (v ? "TRUE" : "FALSE"));
  if (have((v) => String(v) in words)) return stepped(found, ordered(values.map((v) => words[String(v)]), Object.values(words), known), (v) => words[String(v)]);
  if (values.some((v) => typeof v === "string")) return stepped(found, ordered(values.map(String), Object.values(words), known), String);
  if (unit !== "ns") return { ...found, unit };
  return { ...found, unit: "s", points: found.points.map(([t, value, ...rest]) => [t, value === null ? null : value / NS_PER_S, ...rest]) };
}

function stepped(found, levels, name) {
  const last = levels.length - 1;
  const at = (value) => {
    const n = levels.indexOf(name(value));
    return n < 0 ? last : n;
  };
  return { ...found, unit: "", levels, points: found.points.map(([t, value, ...rest]) => [t, value === null ? null : at(value), ...rest]) };
}

/** The levels: names that a declaration orders as it does, others in the order in which they were seen. */
function ordered(seen, declared, known) {
  const names = [...new Set([...known.filter((name) => name !== OTHERS), ...seen])];
  const rank = new Map(declared.map((name, n) => [name, n]));
  names.sort((a, b) => (rank.get(a) ?? Infinity) - (rank.get(b) ?? Infinity) || 0);
  return names.length > MOST_LEVELS ? [...names.slice(0, MOST_LEVELS - 1), OTHERS] : names;
}

/** A value of a series as text, without its unit. */
export const shown = (series, value) => (series.levels ? (series.levels[value] ?? "") : value);

/** How many of the recorded scans a series shows, and what is missing; empty for a tag whose changes are all shown. */
export function completeness(name, { scans, shown: drawn, thinned, missed = 0, dropped = 0, points }) {
  const parts = [];
  if (scans !== undefined) parts.push(thinned ? `${drawn} of ${scans} scans shown, extremes included` : `all ${scans} scans shown`);
  else if (thinned) parts.push(`thinned to ${points.length} values, extremes included`);
  if (missed > 0) parts.push(`${missed} scans not recorded`);
  if (dropped > 0) parts.push(`${dropped} earlier scans no longer kept`);
  return parts.length ? `${name}: ${parts.join(", ")}` : "";
}
