// Charts, ladder and function block diagrams of programs with their present values. The server draws them; this marks their parts.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import { get } from "../lib/api.js";
import { Failure, useFetched } from "../lib/parts.js";

const EVERY_MS = 500;
const SVG = "http://www.w3.org/2000/svg";
const seconds = (s) => (s < 100 ? `${s.toFixed(1)} s` : `${Math.round(s)} s`);

/** The drawings of a program, one at a time. `drawings`: [{number, name, svg}]. */
export function Drawings({ store, program, drawings }) {
  const [chosen, setChosen] = useState(0);
  const shown = drawings[Math.min(chosen, drawings.length - 1)];
  return html`<section class="card" aria-label="Drawing of ${program}">
    <header>
      <h2>${shown.name}</h2>
      ${drawings.length > 1 &&
      html`<label>Drawing <select value=${chosen} onChange=${(event) => setChosen(Number(event.target.value))}>
        ${drawings.map((one, n) => html`<option key=${one.name} value=${n}>${one.name}</option>`)}
      </select></label>`}
    </header>
    <${Live} key=${shown.name} store=${store} program=${program} drawing=${shown} />
  </section>`;
}

function Live({ store, program, drawing }) {
  const ref = useRef(null);
  const [round, setRound] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => document.hidden || setRound((n) => n + 1), EVERY_MS);
    return () => clearInterval(timer);
  }, []);
  const [values, error] = useFetched(() => get(`${store.path}/plc/drawings/${program}/${drawing.number}`), [round]);
  useEffect(() => {
    if (values && ref.current) mark(ref.current, values);
  }, [values]);
  const active = Object.entries(values?.steps ?? {}).filter(([, step]) => step.active);
  return html`<${Failure} text=${error} />
    ${active.length > 0 && html`<p class="active-steps">Active: ${active.map(([name, step]) => `${name} (${seconds(step.time_s ?? 0)})`).join(", ")}</p>`}
    <div class="scroll drawn" role="group" tabindex="0" aria-label="Drawing ${drawing.name}" ref=${ref} dangerouslySetInnerHTML=${{ __html: drawing.svg }}></div>`;
}

/** Mark the parts of a drawing by their present values. */
function mark(root, { steps = {}, transitions = {}, actions = {}, nodes = {}, wires = {} }) {
  for (const part of root.querySelectorAll("g.step")) {
    const step = steps[part.dataset.step];
    part.classList.toggle("active", Boolean(step?.active));
    timeOf(part).textContent = step?.active ? seconds(step.time_s ?? 0) : "";
  }
  for (const part of root.querySelectorAll("g.transition")) {
    const one = transitions[part.dataset.transition];
    part.classList.toggle("enabled", Boolean(one?.enabled));
    part.classList.toggle("true", one?.true === true);
  }
  for (const part of root.querySelectorAll("g.action")) part.classList.toggle("active", actions[part.dataset.of] === true);
  for (const part of root.querySelectorAll("g.contact, g.coil")) flow(part, nodes[part.dataset.node]);
  for (const part of root.querySelectorAll("g.wire")) flow(part, wires[`${part.dataset.from}.${part.dataset.pin}`]);
}

function flow(part, value) {
  part.classList.toggle("on", value === true);
  let title = part.querySelector("title");
  if (!title) title = part.insertBefore(document.createElementNS(SVG, "title"), part.firstChild);
  title.dataset.name ??= title.textContent;
  title.textContent = [title.dataset.name, value ?? ""].filter((text) => text !== "").join(": ");
}

/** The text with the time in a step, inside its box below its name. */
function timeOf(part) {
  const known = part.querySelector(".time");
  if (known) return known;
  const box = part.querySelector(".box");
  const text = part.appendChild(document.createElementNS(SVG, "text"));
  const place = { class: "time", "text-anchor": "middle", x: Number(box.getAttribute("x")) + box.width.baseVal.value / 2, y: Number(box.getAttribute("y")) + 34.5 };
  for (const [name, value] of Object.entries(place)) text.setAttribute(name, value);
  return text;
}
