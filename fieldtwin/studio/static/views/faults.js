// Faults of the simulated devices: forms made from the faults' own schemas, and the active ones with their counts.

import { html, useState } from "../vendor/preact.js";
import { get, post, remove } from "../lib/api.js";
import { number, yaml } from "../lib/format.js";
import { Failure, useAction, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

const AIMS = ["device", "register", "bus"]; // the usual ones; the others are conditions that few faults need
const UNITS = { _ms: "ms", per_s: "per second" };
const HINTS = { nth: "only this frame", every: "each n-th frame", probability: "0 to 1", direction: "request or reply" };

export function Faults({ store, query }) {
  useStore(store);
  const [kinds, error] = useFetched(() => get("/faults"), []);
  const [run, failed] = useAction();
  const field = store.status?.field;
  const active = field?.faults ?? [];
  const set = Object.entries(field?.set ?? {});
  return html`<h1 class="visually-hidden">Faults</h1>
    <${Failure} text=${error || failed} />
    <div class="columns">
      <div>
        <div class="bar">
          <h2 class="grow">Active</h2>
          ${store.mayOperate && active.length + set.length > 0 &&
          html`<button
            onClick=${() =>
              run(async () => {
                await remove(`${store.path}/faults`);
                for (const [tag] of set) await remove(`${store.path}/tags/${tag}/set`);
              })}
          >
            Clear all
          </button>`}
        </div>
        <table class="list">
          <thead><tr><th>Fault</th><th>On</th><th class="number">Took effect</th><th><span class="visually-hidden">Actions</span></th></tr></thead>
          <tbody>
            ${active.map(
              (f) => html`<tr key=${f.id}>
                <td>${f.name}</td><td>${f.device || f.bus}</td><td class="number">${f.struck} times</td>
                <td>${store.mayOperate && html`<button class="quiet" onClick=${() => run(() => remove(`${store.path}/faults/${encodeURIComponent(f.id)}`))}>Clear</button>`}</td>
              </tr>`,
            )}
            ${set.map(
              ([tag, v]) => html`<tr key=${tag}>
                <td>set ${number(v)}</td><td>${tag}</td><td></td>
                <td>${store.mayOperate && html`<button class="quiet" onClick=${() => run(() => remove(`${store.path}/tags/${tag}/set`))}>Release</button>`}</td>
              </tr>`,
            )}
          </tbody>
        </table>
        ${!active.length && !set.length && html`<p class="empty">No fault is active.</p>`}
        ${field?.struck?.length > 0 &&
        html`<h2 style=${{ marginTop: "20px" }}>In this run</h2>
          <table class="list">
            <tbody>
              ${[...field.struck].reverse().slice(0, 50).map((f) => html`<tr key=${f.number}><td>${f.name}</td><td>${f.on}</td><td class="number">${f.struck} times</td></tr>`)}
            </tbody>
          </table>`}
      </div>
      ${kinds && store.mayOperate && html`<${Form} store=${store} kinds=${kinds} device=${query.get("device") ?? ""} />`}
    </div>`;
}

function Form({ store, kinds, device }) {
  const [name, setName] = useState("silence");
  const [fields, setFields] = useState(device ? { device } : {});
  const [run, error, busy] = useAction();
  const kind = kinds.find((k) => k.name === name) ?? kinds[0];
  const { system } = store.about;
  const aims = kind.aims.filter((a) => !["from", "until", "optional"].includes(a));
  const fault = { name: kind.name, ...Object.fromEntries(Object.entries(fields).filter(([k, v]) => v !== "" && (aims.includes(k) || k in kind.parameters))) };
  const change = (key, text) => setFields({ ...fields, [key]: text });
  const inject = (e) => {
    e.preventDefault();
    run(() => post(`${store.path}/faults`, { fault }));
  };
  const choice = (key) => {
    if (key === "device") return Object.keys(system.devices);
    if (key === "bus") return Object.keys(system.buses);
    if (key === "register" && fields.device) return Object.keys(system.devices[fields.device]?.tags ?? {});
    return null;
  };
  const aim = (key) => {
    const values = choice(key);
    return html`<label key=${key}><span>${titled(key)}</span>
      ${values
        ? html`<select value=${fields[key] ?? ""} onChange=${(e) => change(key, e.target.value)}><option value="">any</option>${values.map((v) => html`<option value=${v}>${v}</option>`)}</select>`
        : html`<input size="12" placeholder=${HINTS[key] ?? ""} value=${fields[key] ?? ""} onInput=${(e) => change(key, typed(e.target.value))} />`}
    </label>`;
  };
  const rare = aims.filter((key) => !AIMS.includes(key));
  return html`<form class="card" onSubmit=${inject}>
    <header><h2>Inject a fault</h2></header>
    <${Failure} text=${error} />
    <p><label>Fault <select value=${kind.name} onChange=${(e) => setName(e.target.value)}>${kinds.map((k) => html`<option value=${k.name}>${k.name}</option>`)}</select></label></p>
    <p class="soft">${kind.summary}</p>
    <div class="fields">
      ${AIMS.filter((key) => aims.includes(key)).map(aim)}
      ${Object.entries(kind.parameters).map(
        ([key, about]) => html`<label title=${about.description ?? ""}><span>${titled(key)}</span>
          ${about.enum
            ? html`<select value=${fields[key] ?? about.default} onChange=${(e) => change(key, e.target.value)}>${about.enum.map((v) => html`<option value=${v}>${v}</option>`)}</select>`
            : html`<input size="12" placeholder=${about.default ?? ""} value=${fields[key] ?? ""} onInput=${(e) => change(key, typed(e.target.value))} />`}
        </label>`,
      )}
    </div>
    ${rare.length > 0 &&
    html`<details open=${rare.some((key) => fields[key])}>
      <summary>More conditions</summary>
      <div class="fields">${rare.map(aim)}</div>
    </details>`}
    <h3 style=${{ marginTop: "12px" }}>As YAML</h3>
    <pre class="yaml">- ${yaml(fault)}</pre>
    <button class="primary" disabled=${busy}>Inject</button>
  </form>`;
}

/** The name of a field with the unit of its value: by_ms becomes "by_ms (ms)". */
function titled(key) {
  const unit = Object.entries(UNITS).find(([end]) => key.endsWith(end))?.[1];
  return unit ? `${key} (${unit})` : key;
}

/** Numbers and truth values as such, everything else as text. */
function typed(text) {
  if (text === "true" || text === "false") return text === "true";
  return text.trim() !== "" && Number.isFinite(Number(text)) ? Number(text) : text;
}
