// All registers and objects by name, with value, quality, age and a sparkline. In a prototype a value of the simulated device can be set.

import { html, useState } from "../vendor/preact.js";
import { post, put, remove } from "../lib/api.js";
import { age, number, value } from "../lib/format.js";
import { ChangesLost, Failure, NumberDialog, Quality, Sparkline, useAction } from "../lib/parts.js";
import { useStore } from "../lib/store.js";
import { address } from "../lib/address.js";

const MOST_ROWS = 500;

export function Devices({ store, query }) {
  useStore(store);
  const [search, setSearch] = useState("");
  const [device, setDevice] = useState(query.get("device") ?? "");
  const [onlyBad, setOnlyBad] = useState(false);
  const [setting, setSetting] = useState(null);
  const [writing, setWriting] = useState(null);
  const [run, error] = useAction();
  const { devices } = store.about.system;
  const rows = Object.entries(devices)
    .filter(([name]) => !device || name === device)
    .flatMap(([name, d]) => Object.entries(d.tags).map(([tag, about]) => ({ full: `${name}.${tag}`, name, about })))
    .filter(({ full, about }) => !search || `${full} ${about.at} ${about.unit}`.toLowerCase().includes(search.toLowerCase()))
    .filter(({ full, about }) => !onlyBad || (about.readable && store.tags[full]?.quality !== "good"));
  const set = store.status?.field?.set ?? {};
  const now = store.now();
  return html`<h1 class="visually-hidden">Devices</h1>
    <div class="bar">
      <input type="search" placeholder="Search name, address, unit" aria-label="Search" value=${search} onInput=${(e) => setSearch(e.target.value)} />
      <label>Device
        <select value=${device} onChange=${(e) => setDevice(e.target.value)}>
          <option value="">all</option>
          ${Object.keys(devices).map((name) => html`<option value=${name}>${name}</option>`)}
        </select>
      </label>
      <label><input type="checkbox" checked=${onlyBad} onChange=${(e) => setOnlyBad(e.target.checked)} /> only bad values</label>
      <span class="grow"></span>
      <${ChangesLost} store=${store} />
      <span class="soft">${rows.length} values</span>
    </div>
    <${Failure} text=${error} />
    <div class="scroll">
      <table class="list">
        <thead>
          <tr><th>Tag</th><th class="address">Address</th><th class="number">Value</th><th>Unit</th><th>Quality</th><th class="number">Age</th><th>Last minute</th><th><span class="visually-hidden">Actions</span></th></tr>
        </thead>
        <tbody>
          ${rows.slice(0, MOST_ROWS).map(({ full, about }) => {
            const seen = store.tags[full];
            return html`<tr key=${full} data-tag=${full}>
              <td><a href=${address(store.name, "trends", { tags: full })}>${full}</a></td>
              <td class="mono soft address">${about.at}</td>
              <td class="number">${value(seen, about)}</td>
              <td>${about.unit}</td>
              <td>${seen && html`<${Quality} quality=${seen.quality} why=${seen.reason} />`} ${full in set && html`<span class="chip warn">set</span>`}</td>
              <td class="number">${age(seen?.age_s)}</td>
              <td><${Sparkline} points=${store.recent.get(full)} now=${now} /></td>
              <td>
                ${store.isPrototype && store.mayOperate && !about.secret &&
                (full in set
                  ? html`<button class="quiet" onClick=${() => run(() => remove(`${store.path}/tags/${full}/set`))}>Release</button>`
                  : html`<button class="quiet" onClick=${() => setSetting({ full, about })}>Set …</button>`)}
                ${mayWrite(store, about) && html`<button class="quiet" onClick=${() => setWriting({ full, about })}>Write …</button>`}
              </td>
            </tr>`;
          })}
        </tbody>
      </table>
      ${rows.length > MOST_ROWS && html`<p class="empty">The first ${MOST_ROWS} are shown. Search for the others.</p>`}
      ${!rows.length && html`<p class="empty">No value fits.</p>`}
    </div>
    ${writing && html`<${WriteDialog} store=${store} ...${writing} onClose=${() => setWriting(null)} />`}
    ${setting && html`<${SetDialog} store=${store} ...${setting} onClose=${() => setSetting(null)} />`}`;
}

function SetDialog({ store, full, about, onClose }) {
  const now = store.tags[full]?.value;
  return html`<${NumberDialog}
    title="Set ${full} in the simulated device"
    label="Value"
    first=${typeof now === "number" ? number(now) : ""}
    unit=${about.unit}
    action="Set"
    send=${(wanted) => put(`${store.path}/tags/${full}/set`, { value: wanted })}
    above=${html`<p class="soft">The device holds this value until you release it. The gateway reads it over the bus, like any other value.</p>`}
    below=${() => html`<p class="soft">now ${number(now)} ${about.unit}${about.range ? `, range ${about.range.join(" to ")}` : ""}</p>`}
    onClose=${onClose}
  />`;
}

const mayWrite = (store, about) => store.mayOperate && about.writable && !about.secret && store.about.allow_writes;

/** A write through the gateway to the device. On a plant this is real hardware, so old and new value are confirmed. */
function WriteDialog({ store, full, about, onClose }) {
  const [old] = useState(() => store.tags[full]?.value ?? null);
  const plant = !store.isPrototype;
  return html`<${NumberDialog}
    title="Write ${full}"
    label="New value"
    unit=${about.unit}
    action="Write"
    danger=${plant}
    send=${(wanted) => post(`${store.path}/tags/${full}/write`, { value: wanted, old })}
    above=${html`${plant && html`<p class="error">This is a plant: the value is written to a real device.</p>`}
    ${about.impact && html`<p class="soft">Impact of a write: ${about.impact}</p>`}`}
    below=${(wanted) => html`<p>${number(old)} ${about.unit} → <strong>${wanted === null ? "…" : number(wanted)} ${about.unit}</strong></p>`}
    onClose=${onClose}
  />`;
}
