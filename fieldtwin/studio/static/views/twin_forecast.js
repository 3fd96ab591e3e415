// The drawing of a forecast: the history of the tags as solid lines, the forecast dashed, and a line at the present time.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import uPlot from "../vendor/uplot.js";
import { get } from "../lib/api.js";
import { clock, number } from "../lib/format.js";
import { Failure } from "../lib/parts.js";

const COLOURS = ["#2f77d0", "#c2571a", "#1d8a57", "#8b4fc0"];
const AGAIN_MS = 1000;
const LEAST_HISTORY_S = 60;
const HEIGHT = 240;
const DASH = [7, 5];
const BEFORE_GAP_S = 0.001;

/** Seconds relative to the fork: "+1:30", "-0:20". */
const relative = (s) => (Math.abs(s) < 0.0005 ? "0" : `${s < 0 ? "−" : "+"}${clock(Math.abs(s) * 1e9).replace(/\.?0+$/, "").replace(/:$/, ":00")}`);

export function ForecastChart({ store, run }) {
  const { asked, began_ns: began } = run;
  const [history, setHistory] = useState({});
  const [error, setError] = useState("");
  const shown = Math.max(LEAST_HISTORY_S, asked.horizon_s / 2);
  useEffect(() => {
    let current = true;
    const from = Math.max(0, Math.round(began - shown * 1e9));
    const to = Math.round(began + asked.horizon_s * 1e9);
    let timer = 0;
    const fetchAll = async () => {
      try {
        const tags = asked.series.filter((name) => store.tagOf(name)); // a program's variable has no history
        const found = await Promise.all(tags.map(async (tag) => [tag, await get(`${store.path}/tags/${tag}/history?from_ns=${from}&to_ns=${to}&points=2000`)]));
        if (current) setHistory(Object.fromEntries(found));
        if (current) setError("");
      } catch (e) {
        if (current) setError(e.message);
      }
      if (current && store.now() < to) timer = setTimeout(fetchAll, AGAIN_MS);
    };
    fetchAll();
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [began]);
  const byUnit = new Map();
  for (const tag of asked.series) {
    const unit = store.tagOf(tag)?.unit ?? "";
    byUnit.set(unit, [...(byUnit.get(unit) ?? []), tag]);
  }
  return html`<${Failure} text=${error} />
    ${[...byUnit].map(([unit, tags]) => html`<${Chart} key=${tags.join()} store=${store} run=${run} unit=${unit} tags=${tags} history=${history} from=${-shown} />`)}`;
}

/** The columns of the plot: time, then for each tag its history and its forecast. A value holds until the next one. */
function columns(tags, history, run, now) {
  const began = run.began_ns;
  const lines = tags.flatMap((tag) => {
    const past = (history[tag]?.points ?? []).map(([t, v, quality]) => [(t - began) / 1e9, quality === "good" && typeof v !== "string" ? Number(v) : null]);
    const ahead = run.result?.series?.[tag] ?? [];
    return [
      { points: past, end: Math.min(now, run.asked.horizon_s) },
      { points: ahead, end: ahead.length ? run.asked.horizon_s : -Infinity },
    ];
  });
  // A line is drawn up to the last of its points, so the value before a gap needs one at the end of its time.
  const gaps = lines.flatMap(({ points }) => points.filter(([, v]) => v === null).map(([t]) => t - BEFORE_GAP_S));
  const ends = lines.map(({ end }) => end).filter(Number.isFinite);
  const times = [...new Set([...lines.flatMap(({ points }) => points.map(([t]) => t)), ...gaps, ...ends])].sort((a, b) => a - b);
  const values = lines.map(({ points, end }) => {
    let n = -1;
    return times.map((t) => {
      while (n + 1 < points.length && points[n + 1][0] <= t) n += 1;
      return n < 0 || t > end ? null : points[n][1];
    });
  });
  return [times, ...values];
}

function Chart({ store, run, unit, tags, history, from }) {
  const place = useRef(null);
  const plot = useRef(null);
  const now = () => (store.now() - run.began_ns) / 1e9;
  const horizon = run.asked.horizon_s;
  useEffect(() => {
    // A canvas takes no variables of the style sheet, so colours are read from elements that use them.
    const ink = () => getComputedStyle(place.current).color;
    const edge = () => getComputedStyle(place.current.parentElement).borderTopColor;
    const axis = { stroke: ink, grid: { stroke: edge, width: 1 }, ticks: { stroke: edge, width: 1 }, font: "12px sans-serif" };
    plot.current = new uPlot(
      {
        width: place.current.clientWidth,
        height: HEIGHT,
        padding: [20, null, null, null],
        cursor: { drag: { x: false, y: false } },
        scales: { x: { time: false, range: () => [from, horizon] } },
        axes: [{ ...axis, values: (_, ticks) => ticks.map(relative) }, { ...axis, label: unit, size: 70 }],
        hooks: { draw: [(u) => mark(u, 0, "forecast begins", "right", ink()), (u) => now() < horizon && mark(u, now(), "now", "left", ink())] },
        legend: { markers: { width: 2, dash: (_, n) => (n % 2 ? "solid" : "dashed") } },
        series: [
          { label: "time", value: (_, v) => (v === null ? "" : relative(v)) },
          ...tags.flatMap((tag, n) => [
            line(tag, COLOURS[n % COLOURS.length], unit),
            { ...line(`${tag}, forecast`, COLOURS[n % COLOURS.length], unit), dash: DASH },
          ]),
        ],
      },
      columns(tags, history, run, now()),
      place.current,
    );
    const observer = new ResizeObserver(() => plot.current?.setSize({ width: place.current.clientWidth, height: HEIGHT }));
    observer.observe(place.current);
    return () => {
      observer.disconnect();
      plot.current.destroy();
    };
  }, []);
  useEffect(() => plot.current.setData(columns(tags, history, run, now())), [history, run.result]);
  return html`<div class="trend" role="img" aria-label="History and forecast of ${tags.join(", ")}. ${described(tags, run, unit)}"><div ref=${place}></div></div>`;
}

const line = (label, stroke, unit) => ({
  label,
  stroke,
  width: 1.8,
  paths: uPlot.paths.stepped({ align: 1 }),
  points: { show: false },
  value: (_, v) => (v === null || v === undefined ? "–" : `${number(v)} ${unit}`),
});

/** Draw a vertical line with a label above the plot, on one side of the line. */
function mark(u, at, text, side, colour) {
  const { ctx, bbox } = u;
  const scale = uPlot.pxRatio ?? devicePixelRatio;
  const x = Math.round(u.valToPos(at, "x", true));
  ctx.save();
  ctx.strokeStyle = ctx.fillStyle = colour;
  ctx.lineWidth = scale;
  ctx.setLineDash([]);
  ctx.beginPath();
  ctx.moveTo(x, bbox.top);
  ctx.lineTo(x, bbox.top + bbox.height);
  ctx.stroke();
  ctx.font = `${12 * scale}px sans-serif`;
  ctx.textBaseline = "bottom";
  ctx.textAlign = side;
  ctx.fillText(text, x + (side === "right" ? -5 : 5) * scale, bbox.top - 3 * scale);
  ctx.restore();
}

/** The forecast in words, for readers who cannot see the drawing. */
function described(tags, run, unit) {
  const { result } = run;
  if (!result) return "There is no forecast yet.";
  return tags
    .map((tag) => [tag, result.variables[tag]])
    .filter(([, v]) => v && v.min !== undefined)
    .map(([tag, v]) => `Forecast of ${tag}: ${number(v.min)} to ${number(v.max)} ${unit}, at the end ${number(v.last)} ${unit}.`)
    .join(" ");
}
