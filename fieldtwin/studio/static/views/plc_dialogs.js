// Dialogs of the PLC view: why a tag has its value, and forces.

import { html, useState } from "../vendor/preact.js";
import { get, post, remove } from "../lib/api.js";
import { age, clock, number, reason } from "../lib/format.js";
import { Dialog, Failure, useAction, useFetched } from "../lib/parts.js";

/** Why a tag has its value. `word` shows one of its values. */
export function Why({ store, tag, input, word, onClose }) {
  return html`<${Dialog} title="Why does ${tag} have this value?" onClose=${onClose}>
    ${input ? html`<${FromGateway} store=${store} tag=${tag} />` : html`<${FromProgram} store=${store} tag=${tag} word=${word} />`}
    <footer><button class="primary" onClick=${onClose}>Close</button></footer>
  <//>`;
}

function FromGateway({ store, tag }) {
  const force = store.status.plc.forces[tag];
  const input = store.status.plc.inputs[tag];
  const seen = store.tags[tag];
  if (force) return html`<p>A force${force.by ? ` by ${force.by}` : ""} sets it to ${number(force.value)}, ${age(force.age_ms / 1000)} ago.</p>`;
  return html`<p>
    It is an input: the gateway reads ${number(input.value)} from the device. Its quality is ${input.quality}${input.reason && input.reason !== "none" ? ` (${reason(input.reason)})` : ""}.
    ${seen && seen.age_s !== null ? ` The device's value is ${age(seen.age_s)} old.` : ""}
  </p>`;
}

/** The statement in Structured Text that made a change, and what decided that it was executed. */
function Decision({ decided }) {
  const variables = Object.entries(decided.variables);
  return html`<pre class="decision">${decided.statement}</pre>
    ${decided.executed_in && html`<p>Executed in <strong>${decided.executed_in}</strong>.</p>`}
    ${decided.conditions.length > 0 &&
    html`<ul class="conditions">
      ${decided.conditions.map((c) => html`<li key=${c.line + c.text}>line ${c.line}: <code>${c.text}</code> ${c.holds ? "was true" : "was false"}</li>`)}
    </ul>`}
    ${variables.length > 0 &&
    html`<table class="list">
      <thead><tr><th>Variable after the scan</th><th class="number">Value</th></tr></thead>
      <tbody>${variables.map(([name, v]) => html`<tr key=${name}><td>${name}</td><td class="number">${v}</td></tr>`)}</tbody>
    </table>`}
    ${Object.keys(decided.indices ?? {}).length > 0 &&
    html`<p>In this line ${Object.entries(decided.indices).map(([name, v], n) => html`${n ? ", " : ""}${name} was <strong>${v}</strong>`)}.</p>`}
    ${Object.entries(decided.pointed ?? {}).map(([name, path]) => html`<p key=${name}>In this line ${name} pointed to <strong>${path}</strong>.</p>`)}
    ${(decided.notes ?? []).map((note) => html`<p key=${note} class="soft">Not followed: ${note}.</p>`)}
    ${(decided.inside ?? []).map((one) => html`<p key=${one.instance + one.place}>In <strong>${one.instance}</strong>${one.block ? ` (${one.block})` : ""}, line <code>${one.place}</code>${one.scan ? `, scan ${one.scan}` : ""}:</p>
      <${Decision} decided=${one} />`)}`;
}

function FromProgram({ store, tag, word }) {
  const [found, error] = useFetched(() => get(`${store.path}/plc/why/${tag}`), [tag]);
  if (error) return html`<${Failure} text=${error} />`;
  if (!found) return html`<p class="soft">Asking the PLC …</p>`;
  if (found.waits_for) return html`<p>The program that sets it has not started. Missing: ${found.waits_for}.</p>`;
  const [last, ...earlier] = found.changes;
  if (!last) return html`<p>It has not changed since the programs began, so it has its initial value.</p>`;
  const time = (change) => clock(found.now_ns - change.age_ms * 1e6 - store.about.started_ns);
  const inputs = Object.entries(last.inputs);
  return html`<p>
      ${last.forced ? "A force, applied in program " : "Program "}<strong>${last.program}</strong>${last.forced ? "," : ""} changed it from
      ${" "}<strong>${word(last.before)}</strong> to <strong>${word(last.after)}</strong> ${age(last.age_ms / 1000)} ago
      (${time(last)} in the run, scan ${last.scan})${last.place ? html`, in line <code>${last.place}</code>` : ""}.
    </p>
    ${last.decided && html`<${Decision} decided=${last.decided} />`}
    ${inputs.length > 0 &&
    html`<p>In that scan the program had read:</p>
      <table class="list">
        <thead><tr><th>Input</th><th class="number">Value</th></tr></thead>
        <tbody>${inputs.map(([name, v]) => html`<tr key=${name}><td>${name}</td><td class="number">${shown(v)}</td></tr>`)}</tbody>
      </table>`}
    ${earlier.length > 0 &&
    html`<h3 class="earlier">Earlier changes</h3>
      <div class="scroll transitions">
        <table class="list">
          <thead><tr><th>Time in the run</th><th class="number">Scan</th><th class="number">From</th><th class="number">To</th><th>Line</th></tr></thead>
          <tbody>
            ${earlier.map(
              (c) => html`<tr key=${c.scan}>
                <td class="mono">${time(c)}</td><td class="number">${c.scan}</td><td class="number">${word(c.before)}</td>
                <td class="number">${word(c.after)}</td><td class="soft">${c.forced ? "force" : c.place}</td>
              </tr>`,
            )}
          </tbody>
        </table>
      </div>`}`;
}

const shown = (v) => (v !== null && typeof v === "object" ? JSON.stringify(v) : number(v));

/** Force a tag. `words`: the names of its values, if it has such. */
export function ForceDialog({ store, name, now, words, unit, onClose }) {
  const [text, setText] = useState(now === null || now === undefined ? "" : String(now));
  const [run, error, busy] = useAction();
  const plant = !store.isPrototype;
  const wanted = text === "true" ? true : text === "false" ? false : Number(text);
  const valid = text.trim() !== "" && (typeof wanted === "boolean" || Number.isFinite(wanted));
  const choices = typeof now === "boolean" ? [["false", "false"], ["true", "true"]] : Object.entries(words ?? {}).map(([code, word]) => [code, `${word} (${code})`]);
  const change = (e) => setText(e.target.value);
  const send = async (e) => {
    e.preventDefault();
    if (await run(() => post(`${store.path}/plc/forces`, { tag: name, value: wanted }))) onClose();
  };
  return html`<${Dialog} title="Force ${name}" onClose=${onClose}>
    <form onSubmit=${send}>
      ${plant && html`<p class="error">This is a plant: the force acts on real devices until you remove it.</p>`}
      <${Failure} text=${error} />
      <p>
        now ${store.wordOf(name, now)} →${" "}
        ${choices.length
          ? html`<select aria-label="New value" value=${text} onChange=${change}>${choices.map(([v, label]) => html`<option value=${v}>${label}</option>`)}</select>`
          : html`<input autofocus aria-label="New value${unit && ` in ${unit}`}" value=${text} onInput=${change} /> ${unit}`}
      </p>
      <footer>
        <button type="button" onClick=${onClose}>Cancel</button>
        <button class=${plant ? "danger" : "primary"} disabled=${!valid || busy}>Force</button>
      </footer>
    </form>
  <//>`;
}

/** Release a forced tag, with the value that it has now and the source of the next one. */
export function ReleaseDialog({ store, name, onClose }) {
  const [run, error, busy] = useAction();
  const plc = store.status.plc;
  const force = plc.forces[name];
  const seen = store.tags[name];
  const word = (v) => store.wordOf(name, v);
  const next = name in plc.inputs ? (seen ? `${word(seen.value)}, the device's value` : "the device's value") : "the value that the program computes in the next scan";
  const send = async (e) => {
    e.preventDefault();
    if (await run(() => remove(`${store.path}/plc/forces/${name}`))) onClose();
  };
  return html`<${Dialog} title="Release ${name}" onClose=${onClose}>
    <form onSubmit=${send}>
      ${!store.isPrototype && html`<p class="error">This is a plant: its devices get the program's values again.</p>`}
      <${Failure} text=${error} />
      <p>${force ? `now ${word(force.value)}${force.by ? `, forced by ${force.by}` : ""}` : "not forced any more"} → ${next}</p>
      <footer>
        <button type="button" onClick=${onClose}>Cancel</button>
        <button autofocus class="primary" disabled=${!force || busy}>Release</button>
      </footer>
    </form>
  <//>`;
}
