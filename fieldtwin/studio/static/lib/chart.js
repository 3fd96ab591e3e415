// Series over time on one axis: gaps with the reason of the bad quality, marks, two cursors, and a zoom that several charts share.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import uPlot from "../vendor/uplot.js";
import { clock, number, reason } from "./format.js";
import { completeness, shown } from "./series.js";

const COLOURS = ["#2f77d0", "#c2571a", "#1d8a57", "#8b4fc0", "#b0892a", "#c23b6b", "#2a8fa0", "#6b7280"];
const HEIGHT = 220;
const AXIS_PX = 96; // the width of the axis of values; all charts have the same, so that their times are below each other
const LABEL_PX_OF_UNIT = 24; // of that width, what the unit takes
const TIMES_PX = 34; // the height of the axis of times
const NAMES_PX = [7, 24, 170]; // of an axis with names: for each letter, besides, and at most
const LEVEL_PX = [26, 12]; // the height of a chart with names for each of them, and for how many at most
const BESIDE_PX = 48; // and what it has above and below
const NARROW = 600; // on a page that is narrower than this, names take less room
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
function textAt(series, t, unit) {
  const { points } = series;
  const point = points[indexAt(points, t)];
  if (!point) return "no value yet";
  const [, value, quality, why] = point;
  if (isGood(point)) return `${number(shown(series, value))} ${unit}`.trim();
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

const NO_SERIES = { points: [], now_ns: 0 };

/** The height of a chart: with names, so much that each has a line. */
const heightOf = (levels) => (levels ? BESIDE_PX + LEVEL_PX[0] * Math.min(Math.max(levels.length, 2), LEVEL_PX[1]) : HEIGHT);

const short = (name, width) => {
  const most = Math.floor((width - NAMES_PX[1]) / NAMES_PX[0]);
  return name.length > most ? `${name.slice(0, Math.max(1, most - 1))}…` : name;
};

/**
 * `data`: by tag a series (series.js). `range`: the time from and to in s of all charts. `axis`: the width of the axis of values. `view`: {zoom: [from, to] in s or null, a, b: cursors in s
 * or null}, and `setView` changes it. `marks`: [{t_ns, kind, text}]. `instant`: the time in s of a further line, or null.
 */
function Chart({ started, unit, tags, colours, data, range, axis: room, marks = [], view, setView, instant = null }) {
  const place = useRef(null);
  const plot = useRef(null);
  const now = useRef({}); // what the hooks of uPlot draw
  const [near, setNear] = useState("");
  const levels = data[tags[0]]?.levels;
  now.current = { gaps: gapsOf(tags, data, started), marks, view, data, setView, instant, levels, room };
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
        height: heightOf(levels),
        padding: [12, 12, 0, 0],
        cursor: { sync: { key: "trends" }, drag: { x: true, y: false, setScale: false } },
        scales: { x: { time: false }, ...(levels && { y: { range: () => [-0.5, Math.max(1, now.current.levels.length - 1) + 0.5] } }) },
        axes: [{ ...axis, size: TIMES_PX, values: (_, ticks) => ticks.map((t) => clock(t * 1e9).replace(/\.?0+$/, (zeros) => (zeros.includes(".") ? "" : zeros))) }, { ...axis, ...(levels ? namesAxis(now) : unit
              ? { label: unit, labelSize: LABEL_PX_OF_UNIT, size: () => now.current.room - LABEL_PX_OF_UNIT }
              : { size: () => now.current.room }) }],
        series: [
          { label: "time", value: (_, v) => (v === null ? "" : clock(v * 1e9)) },
          ...tags.map((tag, n) => ({
            label: tag,
            stroke: colours[n],
            ...(levels && { fill: `${colours[n]}1f`, fillTo: 0 }),
            width: 1.8,
            paths: uPlot.paths.stepped({ align: 1 }),
            points: { show: false },
            value: (u, _v, _series, k) => (k === null || k === undefined ? "" : textAt(now.current.data[tag] ?? NO_SERIES, u.data[0][k] * 1e9 + started, unit)),
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
    const observer = new ResizeObserver(() => u.setSize({ width: place.current.clientWidth, height: heightOf(now.current.levels) }));
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
    const height = heightOf(levels);
    if (u.height !== height) u.setSize({ width: place.current.clientWidth, height });
    u.batch(() => {
      u.setData(joined(tags, data, started), false);
      const [min, max] = view.zoom ?? range;
      u.setScale("x", { min, max: Math.max(max, min + 1e-6) });
    });
  }, [data, marks, view, instant, range.join(), room]);
  const complete = tags.map((tag) => data[tag] && completeness(tag, data[tag])).filter(Boolean);
  return html`<section class="trend" aria-label="Trend of ${tags.join(", ")}">
    <div ref=${place}>
      <div class="plot"></div>
      ${["ink", "edge", "gap", "bad", "mark-fault", "mark-cleared", "mark-state"].map((name) => html`<i class="c-${name}" hidden></i>`)}
    </div>
    <footer>${complete.length > 0 && html`<p class="scans">${complete.join(" · ")}</p>`}<p class="mark-note" role="status">${near}</p></footer>
  </section>`;
}

/** An axis with the names of levels, of which every n-th is shown if there are many. */
const namesAxis = (now) => ({
  size: () => now.current.room,
  grid: { show: false },
  splits: () => {
    const { levels } = now.current;
    const every = Math.ceil(levels.length / LEVEL_PX[1]);
    return levels.map((_, n) => n).filter((n) => n % every === 0);
  },
  values: (_, splits) => splits.map((n) => short(now.current.levels[n] ?? "", now.current.room)),
});

/** A chart for each unit, and one for each series of values with names. */
export function Charts({ tags, data, ...others }) {
  const groups = new Map();
  for (const tag of tags) {
    const key = data[tag]?.levels ? `names of ${tag}` : (data[tag]?.unit ?? "");
    groups.set(key, [...(groups.get(key) ?? []), tag]);
  }
  const longest = Math.max(0, ...tags.flatMap((tag) => data[tag]?.levels ?? []).map((name) => name.length));
  const [least, most] = innerWidth < NARROW ? [AXIS_PX - 20, AXIS_PX] : [AXIS_PX, NAMES_PX[2]];
  const axis = Math.min(most, Math.max(least, longest * NAMES_PX[0] + NAMES_PX[1]));
  return [...groups].map(
    ([key, some]) => html`<${Chart} key=${`${key} ${some.join()}`} unit=${data[some[0]]?.unit ?? ""} tags=${some} data=${data} axis=${axis}
      colours=${some.map((tag) => COLOURS[tags.indexOf(tag) % COLOURS.length])} ...${others} />`,
  );
}

const named = ({ kind, text }) => (kind === "cleared" ? `${text}, cleared` : text);

/** The values of all series at the two cursors, with the differences. The sliders move the cursors without a pointer. */
export function Cursors({ started, tags, data, view, setView, from, to }) {
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
  const at = (tag, s) => textAt(data[tag] ?? NO_SERIES, s * 1e9 + started, "");
  const difference = (tag) => {
    const points = data[tag]?.points ?? [];
    const [a, b] = [view.a, view.b].map((s) => points[indexAt(points, s * 1e9 + started)]);
    return a && b && isGood(a) && isGood(b) && !data[tag].levels ? number(Number(b[1]) - Number(a[1])) : "–";
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
            <td>${data[tag]?.unit ?? ""}</td>
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
