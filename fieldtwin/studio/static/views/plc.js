// The PLC: state, cycle time, variables, forces and the reasons of values.

import { html, useState } from "../vendor/preact.js";
import { get, post, remove } from "../lib/api.js";
import { number } from "../lib/format.js";
import { Dialog, Failure, Quality, useAction, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

export function Plc({ store }) {
  useStore(store);
  const plc = store.status?.plc;
  const [run, error] = useAction();
  const [forcing, setForcing] = useState(null);
  const [why, setWhy] = useState(null);
  if (!plc) return html`<p class="empty">The PLC does not answer.</p>`;
  const act = (path, body) => () => run(() => post(`${store.path}/plc/${path}`, body));
  const rows = [
    ...Object.entries(plc.inputs).map(([name, v]) => ["input", name, v]),
    ...Object.entries(plc.outputs).map(([name, v]) => ["output", name, { value: v }]),
  ];
  const programs = Object.keys(store.about.system.programs);
  return html`<h1 class="visually-hidden">PLC</h1>
    <${Failure} text=${error} />
    <div class="bar">
      <span class="chip ${plc.state === "running" ? "good" : "warn"}">${plc.state}</span>
      ${store.mayOperate &&
      html`${plc.state === "paused"
        ? html`<button class="primary" onClick=${act("continue")}>Continue</button><button onClick=${act("step", { count: 1 })}>Step one scan</button>`
        : html`<button onClick=${act("pause")}>Pause</button>`}`}
      <span class="grow"></span>
      <span class="soft">scan every ${number(plc.cycle_ms)} ms · ${plc.scans} scans · ${plc.missed_periods} missed periods · ${plc.overruns} overruns</span>
    </div>
    <div class="columns">
      <div>
        ${programs.map((name) => html`<${Program} store=${store} name=${name} plc=${plc} />`)}
        <div class="scroll" style=${{ marginTop: "14px" }}>
          <table class="list">
            <thead><tr><th>Tag</th><th>Kind</th><th class="number">Value</th><th>Quality</th><th><span class="visually-hidden">Actions</span></th></tr></thead>
            <tbody>
              ${rows.map(([kind, name, v]) => {
                const force = plc.forces[name];
                return html`<tr key=${kind + name} data-tag=${name}>
                  <td>${name}</td><td class="soft">${kind}</td><td class="number">${number(force ? force.value : v.value)}</td>
                  <td>${v.quality && html`<${Quality} quality=${v.quality} why=${v.reason} />`} ${force && html`<span class="chip warn">forced</span>`}</td>
                  <td>
                    <button class="quiet" onClick=${() => setWhy(name)}>Why?</button>
                    ${store.mayOperate &&
                    (force
                      ? html`<button class="quiet" onClick=${() => run(() => remove(`${store.path}/plc/forces/${name}`))}>Release</button>`
                      : html`<button class="quiet" onClick=${() => setForcing({ name, now: v.value })}>Force …</button>`)}
                  </td>
                </tr>`;
              })}
            </tbody>
          </table>
        </div>
      </div>
      <div>
        <${Durations} title="Lateness of scans" spread=${plc.lateness_us} />
        <${Durations} title="Duration of scans" spread=${plc.duration_us} />
        ${why && html`<${Why} store=${store} tag=${why} onClose=${() => setWhy(null)} />`}
      </div>
    </div>
    ${forcing && html`<${ForceDialog} store=${store} ...${forcing} onClose=${() => setForcing(null)} />`}`;
}

function Program({ store, name, plc }) {
  const about = store.about.system.programs[name];
  const variables = Object.entries(plc.variables).filter(([full]) => full.startsWith(`${name}.`));
  const waiting = plc.waiting[name];
  return html`<section class="card" style=${{ marginBottom: "12px" }}>
    <header><h2>${name}</h2><span class="soft mono">${about.source}</span></header>
    ${waiting && html`<p class="error">has not started; missing ${waiting.reason}</p>`}
    <dl class="facts">${variables.map(([full, v]) => html`<dt>${full.slice(name.length + 1)}</dt><dd class="mono">${number(v)}</dd>`)}</dl>
  </section>`;
}

function Durations({ title, spread }) {
  if (!spread?.count) return null;
  const ms = (us) => `${(us / 1000).toFixed(us < 1000 ? 3 : 1)} ms`;
  return html`<section class="card" style=${{ marginBottom: "12px" }}>
    <header><h2>${title}</h2><span class="soft">${spread.count} scans</span></header>
    <dl class="facts">
      ${["p50", "p99", "p999", "max"].map((key) => spread[key] !== undefined && html`<dt>${key}</dt><dd class="mono">${ms(spread[key])}</dd>`)}
    </dl>
  </section>`;
}

function Why({ store, tag, onClose }) {
  const [found, error] = useFetched(() => get(`${store.path}/plc/why/${tag}`), [tag]);
  return html`<section class="card" aria-label="Why">
    <header><h2>Why ${tag}?</h2><button class="quiet" onClick=${onClose}>Close</button></header>
    <${Failure} text=${error} />
    ${found?.changes?.map(
      (c) => html`<dl class="facts" style=${{ marginBottom: "10px" }}>
        ${Object.entries(c).map(([k, v]) => html`<dt>${k}</dt><dd class="mono">${typeof v === "object" ? JSON.stringify(v) : number(v)}</dd>`)}
      </dl>`,
    )}
    ${found && !found.changes?.length && html`<p class="soft">No program has changed it yet.</p>`}
  </section>`;
}

function ForceDialog({ store, name, now, onClose }) {
  const [text, setText] = useState(now === null || now === undefined ? "" : String(now));
  const [run, error, busy] = useAction();
  const plant = !store.isPrototype;
  const wanted = text === "true" ? true : text === "false" ? false : Number(text);
  const valid = text.trim() !== "" && (typeof wanted === "boolean" || Number.isFinite(wanted));
  const send = async (e) => {
    e.preventDefault();
    if (await run(() => post(`${store.path}/plc/forces`, { tag: name, value: wanted }))) onClose();
  };
  return html`<${Dialog} title="Force ${name}" onClose=${onClose}>
    <form onSubmit=${send}>
      ${plant && html`<p class="error">This is a plant: the force acts on real devices until you remove it.</p>`}
      <${Failure} text=${error} />
      <p>now ${number(now)} → <input autofocus aria-label="New value" value=${text} onInput=${(e) => setText(e.target.value)} /></p>
      <footer>
        <button type="button" onClick=${onClose}>Cancel</button>
        <button class=${plant ? "danger" : "primary"} disabled=${!valid || busy}>Force</button>
      </footer>
    </form>
  <//>`;
}
