// The alarm list: states after ISA-18.2 with acknowledgement and shelving. Alarms that need attention come first.

import { html, useState } from "../vendor/preact.js";
import { post, put, remove } from "../lib/api.js";
import { age } from "../lib/format.js";
import { Failure, NumberDialog, Quality, useAction } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

const PRIORITIES = ["critical", "high", "medium", "low"];
const UNACKNOWLEDGED = ["active_unacknowledged", "returned_unacknowledged"];
const COLOURS = { active_unacknowledged: "bad", active_acknowledged: "bad", returned_unacknowledged: "warn", shelved: "accent" };

export function Alarms({ store }) {
  useStore(store);
  const [run, failed] = useAction();
  const [shelving, setShelving] = useState("");
  const known = store.status?.gateway?.alarms;
  const rows = Object.entries(known ?? {}).sort(([, a], [, b]) => rank(a) - rank(b));
  const act = (name, action) => run(() => action(`${store.path}/alarms/${encodeURIComponent(name)}`));
  return html`<h1 class="visually-hidden">Alarms</h1>
    <${Failure} text=${failed} />
    ${!known && html`<p class="error" role="alert">The gateway does not answer, so no alarm is shown.</p>`}
    <div class="scroll">
      <table class="list">
        <thead>
          <tr><th>State</th><th>Priority</th><th>Alarm</th><th>Text</th><th>Quality</th><th class="number">For</th><th class="address">Condition</th><th><span class="visually-hidden">Actions</span></th></tr>
        </thead>
        <tbody>
          ${rows.map(
            ([name, alarm]) => html`<tr key=${name}>
              <td><span class="chip ${COLOURS[alarm.state] ?? ""}">${words(alarm.state)}</span></td>
              <td>${alarm.priority}</td>
              <td>${name}</td>
              <td>${alarm.text}${alarm.by && html` <span class="soft">(by ${alarm.by})</span>`}</td>
              <td><${Quality} quality=${alarm.quality} why=${alarm.reason} /></td>
              <td class="number">${age(alarm.in_state_s)}</td>
              <td class="address"><code>${alarm.condition}</code></td>
              <td>
                ${store.mayOperate && UNACKNOWLEDGED.includes(alarm.state) &&
                html`<button aria-label="Acknowledge ${name}" onClick=${() => act(name, (path) => post(`${path}/acknowledge`))}>Acknowledge</button>`}
                ${store.mayOperate &&
                (alarm.state === "shelved"
                  ? html`<button class="quiet" aria-label="End the shelving of ${name}" onClick=${() => act(name, (path) => remove(`${path}/shelving`))}>Unshelve</button>`
                  : html`<button class="quiet" aria-label="Shelve ${name}" onClick=${() => setShelving(name)}>Shelve …</button>`)}
              </td>
            </tr>`,
          )}
        </tbody>
      </table>
    </div>
    ${shelving && html`<${ShelveDialog} store=${store} name=${shelving} onClose=${() => setShelving("")} />`}`;
}

/** The number of alarms that are active or wait for an acknowledgement. */
export const standing = (store) =>
  Object.values(store.status?.gateway?.alarms ?? {}).filter((alarm) => !["normal", "shelved"].includes(alarm.state)).length;

const words = (state) => state.replaceAll("_", " ");

function rank(alarm) {
  const urgency = UNACKNOWLEDGED.includes(alarm.state) ? 0 : alarm.state === "active_acknowledged" ? 1 : alarm.quality === "bad" ? 2 : alarm.state === "shelved" ? 3 : 4;
  return urgency * PRIORITIES.length + PRIORITIES.indexOf(alarm.priority);
}

function ShelveDialog({ store, name, onClose }) {
  return html`<${NumberDialog}
    title="Shelve ${name}"
    label="For"
    first="60"
    unit="min"
    action="Shelve"
    send=${(minutes) => put(`${store.path}/alarms/${encodeURIComponent(name)}/shelving`, { for_s: minutes * 60 })}
    above=${html`<p class="soft">The alarm is suppressed for this time, at most 24 hours. Afterwards it is normal, or active and not acknowledged.</p>`}
    below=${() => null}
    onClose=${onClose}
  />`;
}
