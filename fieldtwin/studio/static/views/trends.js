// Tags over time. Bad values are gaps; the server keeps the history, so a page that is opened late shows the beginning too.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import uPlot from "../vendor/uplot.js";
import { get } from "../lib/api.js";
import { clock, number, reason } from "../lib/format.js";
import { Failure } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

const COLOURS = ["#2f77d0", "#c2571a", "#1d8a57", "#8b4fc0", "#b0892a", "#c23b6b", "#2a8fa0", "#6b7280"];
const AGAIN_MS = 1000;
const SPANS = [["1 min", 60], ["10 min", 600], ["1 h", 3600], ["all", 0]];

export function Trends({ store, query }) {
  useStore(store);
  const numeric = Object.entries(store.about.system.devices).flatMap(([d, { tags }]) => Object.keys(tags).map((t) => `${d}.${t}`));
  const [chosen, setChosen] = useState(() => (query.get("tags")?.split(",") ?? numeric.slice(0, 3)).filter((t) => numeric.includes(t)));
  const [span, setSpan] = useState(60);
  const [data, setData] = useState({});
  const [error, setError] = useState("");
  const [frozen, setFrozen] = useState(false);
  useEffect(() => {
    if (frozen) return undefined;
    let current = true;
    const fetchAll = async () => {
      try {
        const from = span ? Math.max(0, Math.round(store.now() - span * 1e9)) : 0;
        const to = store.isTrace ? `&to_ns=${span ? store.now() : store.about.end_ns}` : "";
        const found = await Promise.all(chosen.map(async (tag) => [tag, await get(`${store.path}/tags/${tag}/history?from_ns=${from}${to}`)]));
        if (current) setData(Object.fromEntries(found));
        if (current) setError("");
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
  const byUnit = new Map();
  for (const tag of chosen) {
    const unit = store.tagOf(tag)?.unit ?? "";
    byUnit.set(unit, [...(byUnit.get(unit) ?? []), tag]);
  }
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
      ${SPANS.map(([title, s]) => html`<button aria-pressed=${s === span} class=${s === span ? "primary" : ""} onClick=${() => setSpan(s)}>${title}</button>`)}
      ${!store.isTrace && html`<button onClick=${() => setFrozen(!frozen)} aria-pressed=${frozen}>${frozen ? "Continue" : "Hold"}</button>`}
      <button onClick=${() => save(store, data)}>CSV</button>
    </div>
    <${Failure} text=${error} />
    ${[...byUnit].map(([unit, tags]) => html`<${Chart} key=${tags.join()} store=${store} unit=${unit} tags=${tags} data=${data} />`)}
    ${!chosen.length && html`<p class="empty">Add a tag to see it over time.</p>`}
    <p class="soft">
      ${store.isTrace ? "The vertical line is the present instant." : `Recorded since ${clock(Math.max(0, store.about.history_from_ns - store.about.started_ns))} after the start of the run.`}
      ${" "}Gaps are times without a good value.
    </p>`;
}

/** Join the series of several tags on one axis of time: each value holds until the next one, and bad values are null. */
function joined(tags, data, started) {
  // A value ends 1 ns before a bad one begins; with one point only it would not be drawn.
  const of = (t) => (data[t]?.points ?? []).flatMap(([at, , quality]) => (quality === "good" ? [at] : [at - 1, at]));
  const times = [...new Set(tags.flatMap(of))].sort((a, b) => a - b);
  const now = Math.max(0, ...tags.map((t) => data[t]?.now_ns ?? 0));
  if (now) times.push(now);
  const columns = tags.map((tag) => {
    const points = data[tag]?.points ?? [];
    let n = -1;
    return times.map((t) => {
      while (n + 1 < points.length && points[n + 1][0] <= t) n += 1;
      const point = points[n];
      return point && point[2] === "good" && typeof point[1] !== "string" ? Number(point[1]) : null;
    });
  });
  return [times.map((t) => (t - started) / 1e9), ...columns];
}

function Chart({ store, unit, tags, data }) {
  const place = useRef(null);
  const plot = useRef(null);
  const started = store.about.started_ns;
  useEffect(() => {
    // A canvas takes no variables of the style sheet, so colours are read from elements that use them.
    const ink = () => getComputedStyle(place.current).color;
    const edge = () => getComputedStyle(place.current.parentElement).borderTopColor;
    const axis = { stroke: ink, grid: { stroke: edge, width: 1 }, ticks: { stroke: edge, width: 1 }, font: "12px sans-serif" };
    plot.current = new uPlot(
      {
        width: place.current.clientWidth,
        height: 220,
        cursor: { sync: { key: "trends" }, drag: { x: true, y: false } },
        hooks: store.isTrace ? { draw: [(u) => drawInstant(u, (store.now() - started) / 1e9, ink())] } : {},
        scales: { x: { time: false } },
        axes: [{ ...axis, values: (_, ticks) => ticks.map((t) => clock(t * 1e9).replace(/\.000$/, "")) }, { ...axis, label: unit, size: 70 }],
        series: [
          { label: "time", value: (_, v) => (v === null ? "" : clock(v * 1e9)) },
          ...tags.map((tag, n) => ({
            label: tag,
            stroke: COLOURS[n % COLOURS.length],
            width: 1.8,
            paths: uPlot.paths.stepped({ align: 1 }),
            points: { show: false },
            value: (_, v) => (v === null ? "no good value" : `${number(v)} ${unit}`),
          })),
        ],
      },
      joined(tags, data, started),
      place.current,
    );
    const observer = new ResizeObserver(() => plot.current?.setSize({ width: place.current.clientWidth, height: 220 }));
    observer.observe(place.current);
    return () => {
      observer.disconnect();
      plot.current.destroy();
    };
  }, []);
  useEffect(() => {
    const zoomed = plot.current.scales.x.min !== undefined && plot.current.cursor.drag && plot.current.select.width > 0;
    plot.current.setData(joined(tags, data, started), !zoomed);
  }, [data]);
  const bad = tags.map((t) => [t, store.tags[t]]).filter(([, s]) => s && s.quality !== "good");
  return html`<section class="trend" aria-label="Trend of ${tags.join(", ")}">
    <div ref=${place}></div>
    ${bad.map(([t, s]) => html`<p class="soft">${t}: ${s.quality}, ${reason(s.reason)}</p>`)}
  </section>`;
}

/** A vertical line at the instant of a trace. */
function drawInstant(u, seconds, colour) {
  const { min, max } = u.scales.x;
  if (seconds < min || seconds > max) return;
  const x = Math.round(u.valToPos(seconds, "x", true));
  u.ctx.save();
  u.ctx.strokeStyle = colour;
  u.ctx.setLineDash([4, 3]);
  u.ctx.beginPath();
  u.ctx.moveTo(x, u.bbox.top);
  u.ctx.lineTo(x, u.bbox.top + u.bbox.height);
  u.ctx.stroke();
  u.ctx.restore();
}

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
