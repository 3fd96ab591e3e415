// The state diagram of a program with its present state, and the program's last transitions.

import { html, useMemo } from "../vendor/preact.js";
import { clock } from "../lib/format.js";
import { arrowsOf, layout, lineHeight, path, tip } from "../lib/state_layout.js";

const SHOWN = 50;

export function States({ store, name, changes }) {
  const machine = store.programs[name]?.machine;
  const word = (code) => store.word(name, "state", code);
  const seen = changes.map((c) => [word(c.before), word(c.after)]);
  const pairs = JSON.stringify([...new Set(seen.map((pair) => JSON.stringify(pair)))].sort());
  const drawing = useMemo(() => {
    if (!machine) return null;
    const arrows = arrowsOf(machine, JSON.parse(pairs).map((pair) => JSON.parse(pair)));
    return layout(machine, arrows);
  }, [machine, pairs]);
  if (!drawing) return null;
  const now = word(store.variable(name, "state"));
  const last = seen[seen.length - 1];
  return html`<svg class="states" viewBox=${drawing.view.join(" ")} role="img" aria-label="State machine of ${name}, present state ${now}">
    ${drawing.initial &&
    html`<circle class="dot" cx=${drawing.initial.x} cy=${drawing.initial.y - 52} r="5" />
      <path d="M${drawing.initial.x},${drawing.initial.y - 46} v24" />
      <polygon points=${tip([null, [drawing.initial.x, drawing.initial.y - 46], [drawing.initial.x, drawing.initial.y - 20]])} />`}
    ${drawing.arrows.map((a) => {
      const taken = last && last[1] === a.target && (last[0] === a.source || !a.source);
      return html`<g key=${`${a.source}>${a.target}`} class="arrow ${taken ? "taken" : ""}">
        <title>${a.source || "any state"} to ${a.target}${a.labels.length ? `: ${a.labels.join("; ")}` : ""}</title>
        <path d=${path(a.points)} /><polygon points=${tip(a.points)} />
      </g>`;
    })}
    ${Object.entries(drawing.boxes).map(
      ([state, b]) => html`<g key=${state} class="state ${state === now ? "now" : ""}">
        <rect x=${b.x - b.w / 2} y=${b.y - b.h / 2} width=${b.w} height=${b.h} rx="9" /><text x=${b.x} y=${b.y + 4.5}>${state}</text>
      </g>`,
    )}
    ${drawing.arrows.map(
      ({ label, lines }) =>
        label &&
        html`<rect class="paper" x=${label.x - label.w / 2} y=${label.y - label.h / 2} width=${label.w} height=${label.h} rx="3" />
          ${lines.map((line, n) => html`<text class="label" x=${label.x} y=${label.y - label.h / 2 + 13 + n * lineHeight}>${line}</text>`)}`,
    )}
  </svg>
  ${!machine.declared && html`<p class="soft">The program does not declare its transitions: the arrows are those that Studio has seen.</p>`}`;
}

export function Transitions({ store, name, changes }) {
  if (!changes.length) return html`<p class="soft">No transition since the programs began.</p>`;
  const word = (code) => store.word(name, "state", code);
  return html`<div class="scroll transitions" role="group" tabindex="0" aria-label="Last transitions of ${name}">
    <table class="list">
      <thead><tr><th>Time in the run</th><th>From</th><th>To</th><th class="number">Scan</th><th>Set by</th></tr></thead>
      <tbody>
        ${changes
          .slice(-SHOWN)
          .reverse()
          .map(
            (c) => html`<tr key=${c.t_ns}>
              <td class="mono">${clock(c.t_ns - store.about.started_ns)}</td><td>${word(c.before)}</td><td><strong>${word(c.after)}</strong></td>
              <td class="number">${c.scan ?? "–"}</td><td class="soft">${c.forced ? "a force" : c.place || "the program"}</td>
            </tr>`,
          )}
      </tbody>
    </table>
  </div>`;
}
