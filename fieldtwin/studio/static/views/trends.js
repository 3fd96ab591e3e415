// Tags and variables of programs over time. Bad values are gaps; the server keeps the history of tags, so a page that is opened late
// shows the beginning too. The PLC records a variable after each scan from the first time on that a page shows it.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import { get } from "../lib/api.js";
import { Charts, Cursors, Marks } from "../lib/chart.js";
import { clock } from "../lib/format.js";
import { ChangesLost, Failure, useFetched } from "../lib/parts.js";
import { seriesOf, shown } from "../lib/series.js";
import { useStore } from "../lib/store.js";

const AGAIN_MS = 1000;
const SPANS = [["1 min", 60], ["10 min", 600], ["1 h", 3600], ["all", 0]];
const NOTHING = { zoom: null, a: null, b: null };

export function Trends({ store, query }) {
  useStore(store);
  const numeric = Object.entries(store.about.system.devices).flatMap(([d, { tags }]) => Object.keys(tags).map((t) => `${d}.${t}`));
  const isTag = (name) => numeric.includes(name);
  const historyOf = (name) => (isTag(name) || store.isTrace ? `${store.path}/tags/${encodeURIComponent(name)}/history` : `${store.path}/plc/variables/${encodeURIComponent(name)}/history`);
  const [chosen, setChosen] = useState(() => {
    const variables = query.getAll("variable");
    return [...(query.get("tags")?.split(",") ?? (variables.length ? [] : numeric.slice(0, 3))).filter(isTag), ...variables];
  });
  const [span, setSpan] = useState(60);
  const [data, setData] = useState({});
  const [range, setRange] = useState([0, 1]);
  const levels = useRef({}); // of each series with names, so that a name keeps its place
  const [marks, setMarks] = useState([]);
  const [view, setView] = useState(NOTHING);
  const [error, setError] = useState("");
  const [held, setHeld] = useState(null); // the end in ns of the times that are held
  useEffect(() => {
    let current = true;
    const fetchAll = async () => {
      try {
        const end = held ?? (store.isTrace && !span ? store.about.end_ns : Math.round(store.now()));
        const from = span ? Math.max(0, end - span * 1e9) : 0;
        // Of a zoomed range more values are fetched, so that it shows every scan if it is short enough.
        const [first, until] = view.zoom ? view.zoom.map((s) => Math.max(0, Math.round(started + s * 1e9))) : [from, end];
        const to = store.isTrace || held !== null || view.zoom ? `&to_ns=${until}` : "";
        const [found, all] = await Promise.all([
          Promise.all(chosen.map(async (name) => [name, await get(`${historyOf(name)}?from_ns=${first}${to}`).catch((e) => e)])),
          store.isTrace ? [] : get(`${store.path}/marks`), // a trace has its marks in the line of time above the view
        ]);
        if (!current) return;
        const failed = found.filter(([, answer]) => answer instanceof Error);
        const series = found.filter(([, answer]) => !(answer instanceof Error)).map(([name, answer]) => [name, drawn(name, answer)]);
        const begins = series.flatMap(([, { points }]) => points.slice(0, 1).map(([t]) => t));
        const last = to ? end : Math.max(end, ...series.map(([, { now_ns }]) => now_ns));
        setRange([span ? Math.max(from, started) : Math.min(last, ...begins), last].map(seconds));
        setData(Object.fromEntries(series));
        setMarks(all.filter((mark) => mark.t_ns >= from));
        setError([...new Set(failed.map(([name, e]) => `${name}: ${e.message}`))].join("; "));
      } catch (e) {
        if (current) setError(e.message);
      }
    };
    fetchAll();
    const timer = store.isTrace || held !== null ? 0 : setInterval(fetchAll, AGAIN_MS);
    return () => {
      current = false;
      clearInterval(timer);
    };
  }, [chosen.join(), span, held, store.settled, view.zoom?.join(), Object.keys(store.programs).join()]);
  const started = store.about.started_ns;
  const seconds = (ns) => (ns - started) / 1e9;
  const drawn = (name, answer) => {
    const [program, ...path] = name.split(".");
    const about = store.programs[program]?.variables[path.join(".")];
    const described = isTag(name) ? { unit: store.tagOf(name).unit, words: store.tagOf(name).values } : { unit: answer.unit ?? about?.unit, words: about?.words };
    const series = seriesOf(answer, described, levels.current[name]);
    levels.current[name] = series.levels;
    return series;
  };
  const choose = (s) => {
    setSpan(s);
    setView({ ...view, zoom: null });
  };
  return html`<h1 class="visually-hidden">Trends</h1>
    <div class="bar">
      <label>Add
        <select value="" onChange=${(e) => e.target.value && setChosen([...chosen, e.target.value])}>
          <option value="">choose a tag</option>
          ${numeric.filter((t) => !chosen.includes(t)).map((t) => html`<option value=${t}>${t}</option>`)}
        </select>
      </label>
      <${AddVariable} store=${store} chosen=${chosen} onAdd=${(name) => setChosen([...chosen, name])} />
      <div class="tags">
        ${chosen.map((t) => html`<button class="chip" onClick=${() => setChosen(chosen.filter((o) => o !== t))} aria-label="Remove ${t}">${t} ×</button>`)}
      </div>
      <span class="grow"></span>
      <${ChangesLost} store=${store} />
      ${SPANS.map(([title, s]) => html`<button aria-pressed=${s === span && !view.zoom} class=${s === span && !view.zoom ? "primary" : ""} onClick=${() => choose(s)}>${title}</button>`)}
      ${view.zoom && html`<button class="primary" onClick=${() => setView({ ...view, zoom: null })}>Reset zoom</button>`}
      ${!store.isTrace && html`<button onClick=${() => setHeld(held === null ? Math.round(store.now()) : null)} aria-pressed=${held !== null}>${held !== null ? "Continue" : "Hold"}</button>`}
      ${view.a === null && html`<button disabled=${!chosen.length} onClick=${() => setView({ ...view, a: middle(view.zoom ?? range, 1 / 3), b: middle(view.zoom ?? range, 2 / 3) })}>Cursors</button>`}
      <button onClick=${() => save(store, data)} disabled=${!Object.keys(data).length}>CSV</button>
    </div>
    <${Failure} text=${error} />
    <${Cursors} started=${started} tags=${chosen} data=${data} view=${view} setView=${setView} from=${range[0]} to=${range[1]} />
    <${Charts} started=${started} tags=${chosen} data=${data} range=${range} marks=${marks} view=${view} setView=${setView} instant=${store.isTrace ? seconds(store.now()) : null} />
    ${!chosen.length && html`<p class="empty">Add a tag or a variable to see it over time.</p>`}
    <${Marks} started=${started} marks=${marks} view=${view} setView=${setView} />
    <p class="soft">
      ${store.isTrace ? "The dashed line is the present instant." : since(store.about)}
      ${" "}${!store.isTrace && "The PLC records a variable after each scan while a page shows it. "}Shaded times have no good value. Drag to zoom, click for a cursor, double-click to reset both.
    </p>`;
}

/** Choose a variable of a program by its name. Elements of arrays are not offered, but can be named. */
function AddVariable({ store, chosen, onAdd }) {
  const [text, setText] = useState("");
  const [names] = useFetched(() => get(`${store.path}/plc/variables`), [store.path, store.programsOf]);
  const add = (e) => {
    e.preventDefault();
    const name = text.trim();
    if (name && !chosen.includes(name)) onAdd(name);
    setText("");
  };
  return html`<form class="add-variable" onSubmit=${add}>
    <label>Variable <input list="variables" placeholder="program.timer.ET" value=${text} onInput=${(e) => setText(e.target.value)} spellcheck=${false} autocomplete="off" /></label>
    <datalist id="variables">${(names ?? []).filter((name) => !chosen.includes(name)).map((name) => html`<option value=${name}></option>`)}</datalist>
    <button disabled=${!text.trim()}>Add</button>
  </form>`;
}

const LATE_NS = 5e9; // the gateway of a run starts within this time

/** Since when there are values, and why not from the beginning of the run. */
function since({ history_from_ns: from, started_ns: started }) {
  const said = `Values are recorded since ${clock(Math.max(0, from - started))} after the start of the run`;
  return from - started < LATE_NS ? `${said}.` : `${said}: the gateway keeps a limited number of changes, since its last start.`;
}

const middle = ([from, to], share) => from + (to - from) * share;

function save(store, data) {
  const lines = ["time_s,tag,value,quality,reason,unit"];
  for (const [tag, series] of Object.entries(data))
    for (const [t, v, quality, why] of series.points)
      lines.push([((t - store.about.started_ns) / 1e9).toFixed(6), tag, v === null ? "" : shown(series, v), quality, why, series.unit].map(cell).join());
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" }));
  link.download = `${store.name}-trends.csv`;
  link.click();
  URL.revokeObjectURL(link.href);
}

/** A cell of a CSV file. A text that a spreadsheet would take for a formula begins with an apostrophe. */
function cell(value) {
  const text = String(value);
  const safe = typeof value === "string" && /^[=+\-@\t]/.test(text) && !/^-?\d/.test(text) ? `'${text}` : text;
  return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}
