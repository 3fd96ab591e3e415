// The time of a trace: a slider with marks, keys, and playing at a chosen speed.

import { html, useEffect, useRef } from "../vendor/preact.js";
import { clock } from "../lib/format.js";

const SPEEDS = [0.1, 0.25, 1, 2, 5, 10, 60];
const WORDS = { failed: "failed check", fault: "fault", cleared: "end of a fault", state: "transition" };
const ORDER = ["state", "cleared", "fault", "failed"]; // the last ones are drawn above the others

export function Timeline({ store }) {
  const { end_ns: end, marks } = store.about;
  const track = useRef(null);
  const knob = useRef(null);
  const dragging = useRef(false);
  const at = store.instant ?? 0;
  const part = (t) => `${end ? (100 * t) / end : 0}%`;
  const next = () => marks.find((m) => m.t_ns > at);
  const previous = () => marks.findLast((m) => m.t_ns < at);
  const jump = (mark) => mark && store.go(mark.t_ns);
  const point = (e) => {
    const box = track.current.getBoundingClientRect();
    store.go((end * (e.clientX - box.left)) / box.width);
  };
  const keys = (e) => {
    const step = Math.max(1, end) / (e.shiftKey ? 20 : 200);
    const actions = {
      ArrowLeft: () => (e.ctrlKey ? jump(previous()) : store.go(at - step)),
      ArrowRight: () => (e.ctrlKey ? jump(next()) : store.go(at + step)),
      ArrowDown: () => store.go(at - 1e7),
      ArrowUp: () => store.go(at + 1e7),
      PageUp: () => jump(previous()),
      PageDown: () => jump(next()),
      Home: () => store.go(0),
      End: () => store.go(end),
      " ": () => store.play(!store.playing),
    };
    if (!(e.key in actions)) return;
    e.preventDefault();
    actions[e.key]();
  };
  // Everywhere on the page, but not in a field or table that uses the keys itself: comma and full stop are the previous and the next mark.
  useEffect(() => {
    const pressed = (e) => {
      if (e.target.closest("input, select, textarea, dialog") || e.ctrlKey || e.altKey || e.metaKey) return;
      if (e.key === ",") jump(previous());
      else if (e.key === ".") jump(next());
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  });
  const shown = [...marks].sort((a, b) => ORDER.indexOf(a.kind) - ORDER.indexOf(b.kind));
  const step = store.status?.step;
  return html`<section class="timeline-bar" aria-label="Time of the run">
    <div class="controls">
      <button onClick=${() => jump(previous())} disabled=${!previous()} aria-label="Previous mark" title="Previous mark (,)">◂ Mark</button>
      <button class="primary play" onClick=${() => store.play(!store.playing)} aria-pressed=${store.playing}>${store.playing ? "Pause" : "Play"}</button>
      <button onClick=${() => jump(next())} disabled=${!next()} aria-label="Next mark" title="Next mark (.)">Mark ▸</button>
      <label>Speed
        <select value=${store.speed} onChange=${(e) => ((store.speed = Number(e.target.value)), store.tell())}>
          ${SPEEDS.map((s) => html`<option value=${s}>${s} ×</option>`)}
        </select>
      </label>
      <output class="mono instant" aria-live="off">${clock(at)}</output><span class="soft">of ${clock(end)}</span>
      ${step && html`<span class="soft step" title=${step.text}>step ${step.number}: ${step.text}</span>`}
      <span class="grow"></span>
      ${(store.status?.field.faults ?? []).map((f) => html`<span class="chip warn" key=${f.id}>fault: ${f.name} on ${f.device || f.bus}</span>`)}
      ${store.about.behind_bytes > 0 && html`<span class="chip warn" role="status">reading the trace …</span>`}
      ${store.about.growing && html`<span class="chip accent" role="status">the run continues</span>`}
      ${store.about.marks_left_out > 0 && html`<span class="chip" title="Transitions that are not marked">${store.about.marks_left_out} not marked</span>`}
    </div>
    <div
      class="track"
      ref=${track}
      onPointerDown=${(e) => {
        dragging.current = true;
        track.current.setPointerCapture(e.pointerId);
        store.play(false);
        knob.current.focus();
        e.preventDefault(); // else the browser would move the focus away again
        point(e);
      }}
      onPointerMove=${(e) => dragging.current && point(e)}
      onPointerUp=${() => (dragging.current = false)}
      onPointerCancel=${() => (dragging.current = false)}
    >
      <div class="rail"><div class="done" style=${{ width: part(at) }}></div></div>
      ${faults(marks, end).map(([from, to, text], n) => html`<div class="spell" key=${`s${n}`} title=${text} style=${{ left: part(from), width: `max(2px, ${part(to - from)})` }}></div>`)}
      ${shown.map(
        (m, n) => html`<button
          key=${`${m.kind}${n}`}
          class="mark ${m.kind}"
          tabindex="-1"
          style=${{ left: part(m.t_ns) }}
          title="${clock(m.t_ns)} ${WORDS[m.kind]}: ${m.text}"
          aria-label="${WORDS[m.kind]} at ${clock(m.t_ns)}: ${m.text}"
          onPointerDown=${(e) => e.stopPropagation()}
          onClick=${() => jump(m)}
        ></button>`,
      )}
      <div
        class="knob"
        ref=${knob}
        role="slider"
        tabindex="0"
        aria-label="Instant"
        aria-valuemin="0"
        aria-valuemax=${end / 1e9}
        aria-valuenow=${at / 1e9}
        aria-valuetext=${clock(at)}
        onKeyDown=${keys}
        style=${{ left: part(at) }}
      ></div>
    </div>
  </section>`;
}

/** The times of faults as [from, to, text], from the marks of their begin and end. */
function faults(marks, end) {
  const open = new Map();
  const found = [];
  for (const mark of marks) {
    if (mark.kind === "fault") open.set(mark.text, mark.t_ns);
    if (mark.kind !== "cleared") continue;
    const text = mark.text.replace(/ ends$/, "");
    if (open.has(text)) found.push([open.get(text), mark.t_ns, text]);
    open.delete(text);
  }
  return [...found, ...[...open].map(([text, from]) => [from, end, text])];
}

/** What failed in the run; the check of the present instant is emphasised. */
export function FailedChecks({ store }) {
  const { failed, verdict, reason } = store.about;
  if (!failed.length)
    return verdict && verdict !== "passed" ? html`<div class="banner bad" role="status"><span class="grow">The run ${verdict}: ${reason}</span></div>` : null;
  return failed.slice(0, 3).map(
    (c) => html`<div class="banner bad" role="status">
      <span class="grow">
        <strong>${verdict === "error" ? "Error" : "Failed"}: ${c.number && `step ${c.number}, `.replace("step always", "always")}${c.text}</strong>
        ${c.expected && ` · expected ${c.expected}`}${c.got && ` · got ${c.got}`}${c.where && html` · <span class="mono">${c.where}</span>`}
      </span>
      ${c.t_ns !== null &&
      (c.t_ns === store.instant ? html`<span class="chip bad">this instant</span>` : html`<button onClick=${() => store.go(c.t_ns)}>Show ${clock(c.t_ns)}</button>`)}
    </div>`,
  );
}
