// Series over time on one axis: gaps with the reason of the bad quality, marks, two cursors, and a zoom that several charts share.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import uPlot from "../vendor/uplot.js";
import { clock, number, reason } from "./format.js";

const COLOURS = ["#2f77d0", "#c2571a", "#1d8a57", "#8b4fc0", "#b0892a", "#c23b6b", "#2a8fa0", "#6b7280"];
const HEIGHT = 220;
const NEAR_PX = 6; // a mark as near as this to the pointer is named
const LABEL_PX = 54; // a narrower gap has no text
const JUST_BEFORE_NS = 1000;

const isGood = ([, value, quality]) => quality === "good" && typeof value !== "string" && value !== null;

/** The index of the point that is valid at a time, -1 before the first. */
function indexAt(points, t) {
  let low = 0;
  let high = points.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (points[middle][0] <= t) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** The value of a series at a time in words. */
function textAt(points, t, unit) {
  const point = points[indexAt(points, t)];
  if (!point) return "no value yet";
  const [, value, quality, why] = point;
  if (isGood(point)) return `${number(typeof value === "boolean" ? value : Number(value))} ${unit}`.trim();
  return `${quality}${reason(why) ? `: ${reason(why)}` : ""}`;
}

/** Join series on one axis of time: each value holds until the next one, and bad values are null. */
function joined(tags, data, started) {
  // A good value holds until the moment before a bad one.
  const edges = (point, n, points) => (n > 0 && !isGood(point) && isGood(points[n - 1]) ? [point[0] - JUST_BEFORE_NS, point[0]] : [point[0]]);
  const times = [...new Set(tags.flatMap((t) => (data[t]?.points ?? []).flatMap(edges)))].sort((a, b) => a - b);
  const now = Math.max(0, ...tags.map((t) => data[t]?.now_ns ?? 0));
  if (now && now > (times[times.length - 1] ?? 0)) times.push(now);
  const columns = tags.map((tag) => {
    const points = data[tag]?.points ?? [];
    let n = -1;
    return times.map((t) => {
      while (n + 1 < points.length && points[n + 1][0] <= t) n += 1;
      return points[n] && isGood(points[n]) ? Number(points[n][1]) : null;
    });
  });
  return [times.map((t) => (t - started) / 1e9), ...columns];
}

/** The times without a good value: [tag number, from, to, reason], in s after the start. */
function gapsOf(tags, data, started) {
  return tags.flatMap((tag, n) => {
    const { points = [], now_ns = 0 } = data[tag] ?? {};
    const found = [];
    points.forEach((point, k) => {
      if (isGood(point) || (typeof point[1] === "string" && point[2] === "good")) return;
      const from = (point[0] - started) / 1e9;
      const to = ((points[k + 1]?.[0] ?? now_ns) - started) / 1e9;
      const why = reason(point[3]) || point[2];
      const last = found[found.length - 1];
      if (last && last[2] === from && last[3] === why) last[2] = to;
      else found.push([n, from, to, why]);
    });
    return found;
  });
}

/**
 * `data`: by tag {points: [[time in ns, value, quality, reason]], now_ns}. `view`: {zoom: [from, to] in s or null, a, b: cursors in s
 * or null}, and `setView` changes it. `marks`: [{t_ns, kind, text}]. `instant`: the time in s of a further line, or null.
 */
function Chart({ started, unit, tags, data, marks = [], view, setView, instant = null }) {
  const place = useRef(null);
  const plot = useRef(null);
  const now = useRef({}); // what the hooks of uPlot draw
  const [near, setNear] = useState("");
  now.current = { gaps: gapsOf(tags, data, started), marks, view, data, setView, instant };
  useEffect(() => {
    // A canvas takes no variables of the style sheet, so colours are read from elements that use them.
    const colour = (name) => getComputedStyle(place.current.querySelector(`.c-${name}`)).color;
    const ink = () => colour("ink");
    const edge = () => colour("edge");
    const axis = { stroke: ink, grid: { stroke: edge, width: 1 }, ticks: { stroke: edge, width: 1 }, font: "12px sans-serif" };
    const ratio = devicePixelRatio;
    const drawGaps = (u) => {
      const { left, top, width, height } = u.bbox;
      u.ctx.save();
      u.ctx.beginPath();
      u.ctx.rect(left, top, width, height);
      u.ctx.clip();
      u.ctx.textAlign = "left";
      u.ctx.textBaseline = "alphabetic";
      for (const [n, from, to, why] of now.current.gaps) {
        const x = u.valToPos(from, "x", true);
        const end = u.valToPos(to, "x", true);
        if (end < left || x > left + width) continue;
        u.ctx.fillStyle = colour("gap");
        u.ctx.fillRect(x, top, Math.max(ratio, end - x), height);
        const begin = Math.max(x, left);
        if (Math.min(end, left + width) - begin < LABEL_PX * ratio) continue;
        u.ctx.save();
        u.ctx.beginPath();
        u.ctx.rect(begin, top, Math.min(end, left + width) - begin, height);
        u.ctx.clip();
        u.ctx.fillStyle = colour("bad");
        u.ctx.font = `${11 * ratio}px sans-serif`;
        u.ctx.fillText(tags.length > 1 ? `${tags[n].split(".").pop()}: ${why}` : why, begin + 4 * ratio, top + (13 + 14 * n) * ratio);
        u.ctx.restore();
      }
      u.ctx.restore();
    };
    const drawLines = (u) => {
      const { left, top, width, height } = u.bbox;
      const line = (s, style, dash, label = "") => {
        const x = Math.round(u.valToPos(s, "x", true));
        if (x < left || x > left + width) return;
        u.ctx.save();
        u.ctx.strokeStyle = u.ctx.fillStyle = style;
        u.ctx.lineWidth = 1.5 * ratio;
        u.ctx.setLineDash(dash.map((d) => d * ratio));
        u.ctx.beginPath();
        u.ctx.moveTo(x, top);
        u.ctx.lineTo(x, top + height);
        u.ctx.stroke();
        if (label) {
          u.ctx.font = `bold ${11 * ratio}px sans-serif`;
          u.ctx.textAlign = "left";
          u.ctx.textBaseline = "alphabetic";
          u.ctx.fillText(label, x + 3 * ratio, top + height - 4 * ratio);
        } else {
          u.ctx.beginPath(); // the head of a mark, above the data
          u.ctx.moveTo(x - 4 * ratio, top - 7 * ratio);
          u.ctx.lineTo(x + 4 * ratio, top - 7 * ratio);
          u.ctx.lineTo(x, top);
          u.ctx.fill();
        }
        u.ctx.restore();
      };
      for (const mark of now.current.marks) line((mark.t_ns - started) / 1e9, colour(`mark-${mark.kind}`), [2, 3]);
      if (now.current.instant !== null) line(now.current.instant, ink(), [4, 3], " ");
      for (const name of ["a", "b"]) if (now.current.view[name] !== null) line(now.current.view[name], ink(), [], name.toUpperCase());
    };
    plot.current = new uPlot(
      {
        width: place.current.clientWidth,
        height: HEIGHT,
        padding: [12, 12, 0, 0],
        cursor: { sync: { key: "trends" }, drag: { x: true, y: false, setScale: false } },
        scales: { x: { time: false } },
        axes: [{ ...axis, values: (_, ticks) => ticks.map((t) => clock(t * 1e9).replace(/\.?0+$/, (zeros) => (zeros.includes(".") ? "" : zeros))) }, { ...axis, label: unit, size: 70 }],
        series: [
          { label: "time", value: (_, v) => (v === null ? "" : clock(v * 1e9)) },
          ...tags.map((tag, n) => ({
            label: tag,
            stroke: COLOURS[n % COLOURS.length],
            width: 1.8,
            paths: uPlot.paths.stepped({ align: 1 }),
            points: { show: false },
            value: (u, _v, _series, k) => (k === null || k === undefined ? "" : textAt(now.current.data[tag]?.points ?? [], u.data[0][k] * 1e9 + started, unit)),
          })),
        ],
        hooks: {
          drawClear: [drawGaps],
          draw: [drawLines],
          setCursor: [
            (u) => {
              const found = now.current.marks.filter((mark) => Math.abs(u.valToPos((mark.t_ns - started) / 1e9, "x") - u.cursor.left) <= NEAR_PX);
              setNear(found.map((mark) => `${clock(mark.t_ns - started)} ${named(mark)}`).join("; "));
            },
          ],
          setSelect: [
            (u) => {
              if (u.select.width < 3) return;
              const [from, to] = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")];
              u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
              now.current.setView({ ...now.current.view, zoom: [from, to] });
            },
          ],
        },
      },
      joined(tags, data, started),
      place.current.querySelector(".plot"),
    );
    const u = plot.current;
    let pressed = 0;
    u.over.addEventListener("mousedown", (e) => (pressed = e.clientX));
    u.over.addEventListener("click", (e) => {
      if (Math.abs(e.clientX - pressed) > 3) return; // the end of a selection
      const { view: seen, setView: set } = now.current;
      const at = u.posToVal(e.offsetX, "x");
      set(seen.a === null || seen.b !== null ? { ...seen, a: at, b: null } : { ...seen, b: at });
    });
    u.over.addEventListener("dblclick", () => now.current.setView({ ...now.current.view, zoom: null, a: null, b: null }));
    const observer = new ResizeObserver(() => u.setSize({ width: place.current.clientWidth, height: HEIGHT }));
    observer.observe(place.current);
    const redraw = () => u.redraw(); // a canvas keeps its colours when the theme changes
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", redraw);
    const theme = new MutationObserver(redraw);
    theme.observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme"] });
    return () => {
      observer.disconnect();
      theme.disconnect();
      dark.removeEventListener("change", redraw);
      u.destroy();
    };
  }, []);
  useEffect(() => {
    const u = plot.current;
    u.batch(() => {
      u.setData(joined(tags, data, started), view.zoom === null);
      if (view.zoom !== null) u.setScale("x", { min: view.zoom[0], max: view.zoom[1] });
    });
  }, [data, marks, view, instant]);
  return html`<section class="trend" aria-label="Trend of ${tags.join(", ")}">
    <div ref=${place}>
      <div class="plot"></div>
      ${["ink", "edge", "gap", "bad", "mark-fault", "mark-cleared", "mark-state"].map((name) => html`<i class="c-${name}" hidden></i>`)}
    </div>
    <p class="mark-note" role="status">${near}</p>
  </section>`;
}

/** A chart for each unit. */
export function Charts({ tags, unitOf, ...others }) {
  const byUnit = new Map();
  for (const tag of tags) byUnit.set(unitOf(tag), [...(byUnit.get(unitOf(tag)) ?? []), tag]);
  return [...byUnit].map(([unit, some]) => html`<${Chart} key=${some.join()} unit=${unit} tags=${some} ...${others} />`);
}

const named = ({ kind, text }) => (kind === "cleared" ? `${text}, cleared` : text);

/** The values of all series at the two cursors, with the differences. The sliders move the cursors without a pointer. */
export function Cursors({ started, tags, data, unitOf, view, setView, from, to }) {
  if (view.a === null) return null;
  const [low, high] = view.zoom ?? [from, to];
  const slider = (name) =>
    view[name] !== null &&
    html`<label>${name.toUpperCase()}
      <input type="range" min="0" max="1000" aria-label="Cursor ${name.toUpperCase()}" aria-valuetext=${clock(view[name] * 1e9)}
        value=${Math.round(((view[name] - low) / (high - low || 1)) * 1000)}
        onInput=${(e) => setView({ ...view, [name]: low + (Number(e.target.value) / 1000) * (high - low) })} />
      <span class="mono">${clock(view[name] * 1e9)}</span>
    </label>`;
  const at = (tag, s) => textAt(data[tag]?.points ?? [], s * 1e9 + started, "");
  const difference = (tag) => {
    const points = data[tag]?.points ?? [];
    const [a, b] = [view.a, view.b].map((s) => points[indexAt(points, s * 1e9 + started)]);
    return a && b && isGood(a) && isGood(b) ? number(Number(b[1]) - Number(a[1])) : "–";
  };
  return html`<section class="card cursors" aria-label="Cursors">
    <div class="bar">
      ${slider("a")} ${slider("b")}
      ${view.b === null ? html`<span class="soft">Click into a diagram for the second cursor.</span>` : html`<strong class="mono">B − A = ${number(view.b - view.a)} s</strong>`}
      <span class="grow"></span>
      ${view.b === null && html`<button onClick=${() => setView({ ...view, b: (view.a + high) / 2 })}>Add cursor B</button>`}
      <button onClick=${() => setView({ ...view, a: null, b: null })}>Remove cursors</button>
    </div>
    <table class="list">
      <thead><tr><th>Tag</th><th class="number">A</th>${view.b !== null && html`<th class="number">B</th><th class="number">B − A</th>`}<th>Unit</th></tr></thead>
      <tbody>
        ${tags.map(
          (tag) => html`<tr key=${tag}>
            <td>${tag}</td><td class="number">${at(tag, view.a)}</td>
            ${view.b !== null && html`<td class="number">${at(tag, view.b)}</td><td class="number">${difference(tag)}</td>`}
            <td>${unitOf(tag)}</td>
          </tr>`,
        )}
      </tbody>
    </table>
  </section>`;
}

/** The marks as a list, for readers without a pointer. A mark sets the cursor. */
export function Marks({ started, marks, view, setView }) {
  if (!marks.length) return null;
  return html`<details class="marks">
    <summary>${marks.length} marks: faults and changes of states</summary>
    <ul>
      ${marks.map(
        (mark) => html`<li>
          <button class="quiet mono" onClick=${() => setView({ ...view, a: (mark.t_ns - started) / 1e9, b: null })}>${clock(mark.t_ns - started)}</button>
          <span class="mark ${mark.kind}">${named(mark)}</span>
        </li>`,
      )}
    </ul>
  </details>`;
}
