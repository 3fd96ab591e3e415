// Tags over time. Bad values are gaps; the server keeps the history, so a page that is opened late shows the beginning too.

import { html, useEffect, useState } from "../vendor/preact.js";
import { get } from "../lib/api.js";
import { Charts, Cursors, Marks } from "../lib/chart.js";
import { clock } from "../lib/format.js";
import { ChangesLost, Failure } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

const AGAIN_MS = 1000;
const SPANS = [["1 min", 60], ["10 min", 600], ["1 h", 3600], ["all", 0]];
const NOTHING = { zoom: null, a: null, b: null };

export function Trends({ store, query }) {
  useStore(store);
  const numeric = Object.entries(store.about.system.devices).flatMap(([d, { tags }]) => Object.keys(tags).map((t) => `${d}.${t}`));
  const [chosen, setChosen] = useState(() => (query.get("tags")?.split(",") ?? numeric.slice(0, 3)).filter((t) => numeric.includes(t)));
  const [span, setSpan] = useState(60);
  const [data, setData] = useState({});
  const [marks, setMarks] = useState([]);
  const [view, setView] = useState(NOTHING);
  const [error, setError] = useState("");
  const [frozen, setFrozen] = useState(false);
  useEffect(() => {
    if (frozen) return undefined;
    let current = true;
    const fetchAll = async () => {
      try {
        const from = span ? Math.max(0, Math.round(store.now() - span * 1e9)) : 0;
        const to = store.isTrace ? `&to_ns=${span ? store.now() : store.about.end_ns}` : "";
        const [found, all] = await Promise.all([
          Promise.all(chosen.map(async (tag) => [tag, await get(`${store.path}/tags/${tag}/history?from_ns=${from}${to}`)])),
          store.isTrace ? [] : get(`${store.path}/marks`), // a trace has its marks in the line of time above the view
        ]);
        if (!current) return;
        setData(Object.fromEntries(found));
        setMarks(all.filter((mark) => mark.t_ns >= from));
        setError("");
      } catch (e) {
        if (current) setError(e.message);
      }
    };
    fetchAll();
    const timer = store.isTrace ? 0 : setInterval(fetchAll, AGAIN_MS);
    return () => {
      current = false;
      clearInterval(timer);
    };
  }, [chosen.join(), span, frozen, store.settled]);
  const started = store.about.started_ns;
  const unitOf = (tag) => store.tagOf(tag)?.unit ?? "";
  const seconds = (ns) => (ns - started) / 1e9;
  const begins = Object.values(data).flatMap(({ points }) => points.slice(0, 1).map(([t]) => seconds(t)));
  const range = [Math.min(...begins, seconds(store.now())), seconds(store.now())];
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
      <div class="tags">
        ${chosen.map((t) => html`<button class="chip" onClick=${() => setChosen(chosen.filter((o) => o !== t))} aria-label="Remove ${t}">${t} ×</button>`)}
      </div>
      <span class="grow"></span>
      <${ChangesLost} store=${store} />
      ${SPANS.map(([title, s]) => html`<button aria-pressed=${s === span && !view.zoom} class=${s === span && !view.zoom ? "primary" : ""} onClick=${() => choose(s)}>${title}</button>`)}
      ${view.zoom && html`<button class="primary" onClick=${() => setView({ ...view, zoom: null })}>Reset zoom</button>`}
      ${!store.isTrace && html`<button onClick=${() => setFrozen(!frozen)} aria-pressed=${frozen}>${frozen ? "Continue" : "Hold"}</button>`}
      ${view.a === null && html`<button disabled=${!chosen.length} onClick=${() => setView({ ...view, a: middle(view.zoom ?? range, 1 / 3), b: middle(view.zoom ?? range, 2 / 3) })}>Cursors</button>`}
      <button onClick=${() => save(store, data)}>CSV</button>
    </div>
    <${Failure} text=${error} />
    <${Cursors} started=${started} tags=${chosen} data=${data} unitOf=${unitOf} view=${view} setView=${setView} from=${range[0]} to=${range[1]} />
    <${Charts} started=${started} tags=${chosen} unitOf=${unitOf} data=${data} marks=${marks} view=${view} setView=${setView} instant=${store.isTrace ? seconds(store.now()) : null} />
    ${!chosen.length && html`<p class="empty">Add a tag to see it over time.</p>`}
    <${Marks} started=${started} marks=${marks} view=${view} setView=${setView} />
    <p class="soft">
      ${store.isTrace ? "The dashed line is the present instant." : since(store.about)}
      ${" "}Shaded times have no good value. Drag to zoom, click for a cursor, double-click to reset both.
    </p>`;
}

const LATE_NS = 5e9; // the gateway of a run starts within this time

/** Since when there are values, and why not from the beginning of the run. */
function since({ history_from_ns: from, started_ns: started }) {
  const said = `Values are recorded since ${clock(Math.max(0, from - started))} after the start of the run`;
  return from - started < LATE_NS ? `${said}.` : `${said}: the gateway keeps a limited number of changes, since its last start.`;
}

const middle = ([from, to], share) => from + (to - from) * share;

function save(store, data) {
  const lines = ["time_s,tag,value,quality,reason"];
  for (const [tag, { points }] of Object.entries(data))
    for (const [t, v, quality, why] of points) lines.push([((t - store.about.started_ns) / 1e9).toFixed(6), tag, v ?? "", quality, why].map(cell).join());
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
