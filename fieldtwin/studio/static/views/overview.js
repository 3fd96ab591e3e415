// The drawing of the system with its present state: the controller on the left, a line for each bus with its devices below it.

import { html, useEffect, useState } from "../vendor/preact.js";
import { address } from "../lib/address.js";
import { age, number, reason, value } from "../lib/format.js";
import { Sparkline } from "../lib/parts.js";

const LEFT = 250; // width of the controller, in units of the drawing
const NARROW = 236; // width of a device
const WIDE = 420; // from this width on, a device shows two columns of values with their last minute
const ROOMY = 280; // in a narrower column the last minute would lie below the texts
const TALL = 116;
const LEAST_SCALE = 0.8; // a drawing that does not fit the window is scrolled rather than drawn smaller
const MOST_VALUES = 3; // in a column
const GAP = 16;
const WIDEST = 1240;
const NARROWEST = 740;
const AROUND = 32; // around the drawing in a narrow window, where the views are listed above it
const LIST = 176; // the list of views on the left

export function Overview({ store }) {
  const { system } = store.about;
  const gateway = store.status?.gateway;
  const buses = Object.entries(system.buses).map(([name, bus]) => ({
    name,
    ...bus,
    devices: Object.entries(system.devices).filter(([, d]) => d.bus === name),
  }));
  // Buses with few devices leave room, so their devices are wider.
  const total = useWidth();
  const space = total - LEFT - 40;
  const most = Math.max(1, Math.floor(space / (NARROW + GAP)));
  const columns = Math.min(most, Math.max(1, ...buses.map((bus) => bus.devices.length)));
  const box = Math.floor(space / columns) - GAP;
  let y = 14;
  for (const bus of buses) {
    bus.y = y;
    y += 60 + Math.max(1, Math.ceil(bus.devices.length / columns)) * (TALL + 22);
  }
  const height = Math.max(y, 240);
  return html`<h1 class="visually-hidden">Overview of ${store.name}</h1>
    <svg class="plan" viewBox="0 0 ${total} ${height}" style=${{ minHeight: `${Math.round(LEAST_SCALE * height)}px` }} role="group" aria-label="Buses and devices of ${system.name}">
      <${Controller} store=${store} height=${height - 14} />
      ${buses.map((bus) => html`<${BusLine} store=${store} bus=${bus} seen=${gateway?.buses[bus.name]} columns=${columns} box=${box} />`)}
    </svg>
    ${!gateway && html`<p class="soft">The gateway does not answer, so no state is shown.</p>`}`;
}

/** The width of the drawing: that of the page, so that texts are not smaller in a narrow window. */
function useWidth() {
  const read = () => Math.max(NARROWEST, Math.min(WIDEST, innerWidth - AROUND - (innerWidth > 900 ? LIST : 0)));
  const [width, setWidth] = useState(read);
  useEffect(() => {
    const changed = () => setWidth(read());
    addEventListener("resize", changed);
    return () => removeEventListener("resize", changed);
  }, []);
  return width;
}

function Controller({ store, height }) {
  const { plc, gateway } = store.status ?? {};
  const late = plc?.lateness_us?.p99;
  const programs = Object.keys(store.about.system.programs);
  const lines = programs.length
    ? [
        ["PLC", "name"],
        [plc ? (store.isTrace ? `scan every ${number(plc.cycle_ms)} ms` : `${plc.state}, scan ${number(plc.cycle_ms)} ms`) : "no answer", store.isTrace ? "soft" : plc?.state === "running" ? "good-text" : "bad-text"],
        [plc && !store.isTrace ? `${plc.scans} scans, late p99 ${late === undefined ? "–" : (late / 1000).toFixed(2)} ms` : "", "soft"],
        ...programs.map((name) => [`${name}: ${shownState(store, name)}`, ""]),
      ]
    : [["no PLC program", "soft"]];
  const served = [...Object.entries(gateway?.serve ?? {}), ...Object.entries(gateway?.bridge ?? {})];
  return html`<g>
    <a href=${address(store.name, "plc")}>
      <rect class="box" x="1" y="14" width=${LEFT - 2} height=${height - 14} rx="10" />
      <text class="name" x="16" y="40">gateway</text>
      <text class=${gateway ? "soft" : "bad-text"} x="16" y="60">
        ${gateway ? (store.isTrace ? "as recorded" : `${gateway.published} values published`) : "no answer"}
      </text>
      <text class="soft" x="16" y="80">${gateway?.writes ? (gateway.writes.allowed ? `${gateway.writes.done} ${gateway.writes.done === 1 ? "write" : "writes"}` : "read-only") : ""}</text>
      ${lines.map(([text, cls], n) => html`<text class=${cls} x="16" y=${116 + n * 20}>${text}</text>`)}
      ${served.map(
        ([name, front], n) =>
          html`<text class=${front.error ? "bad-text" : "soft"} x="16" y=${126 + (lines.length + n) * 20}>${name} ← ${front.listening ?? front.error}</text>`,
      )}
    </a>
  </g>`;
}

function shownState(store, program) {
  const plc = store.status?.plc;
  if (plc?.waiting?.[program]) return "waits for its inputs";
  const state = store.variable(program, "state");
  return state === undefined ? (plc ? "runs" : "") : store.word(program, "state", state);
}

function BusLine({ store, bus, seen, columns, box }) {
  const step = box + GAP;
  const rate = store.rates[bus.name];
  const errors = seen ? (seen.counters.timeouts ?? 0) + (seen.counters.crc_errors ?? 0) + (seen.counters.aborts ?? 0) : 0;
  const rows = Math.max(1, Math.ceil(bus.devices.length / columns));
  const line = `line${store.isPrototype || store.isTrace ? " emulated" : ""}${seen?.error ? " bad" : ""}`;
  const lineY = bus.y + 46;
  const last = Math.min(bus.devices.length, columns);
  return html`<g>
    <a href=${address(store.name, "bus", { bus: bus.name })}>
      <text class="name" x=${LEFT + 40} y=${bus.y + 14}>${bus.name}</text>
      <text class="soft" x=${LEFT + 40 + 9 * bus.name.length + 14} y=${bus.y + 14}>${bus.kind} ${bus.endpoint}</text>
      <text x=${LEFT + 40} y=${bus.y + 34} class=${seen?.error ? "bad-text" : ""}>
        ${seen?.error ? seen.error : rate === undefined ? "" : `${rate.toFixed(rate < 10 ? 1 : 0)} messages/s`}
        <tspan class=${errors ? "warn-text" : "soft"}>${seen && !seen.error ? `   ${errors} timeouts and errors` : ""}</tspan>
      </text>
    </a>
    <path class=${line} d="M${LEFT},${lineY} H${LEFT + 40 + Math.max(0, last - 1) * step + NARROW / 2}" />
    ${Array.from({ length: rows - 1 }, (_, r) => {
      const at = lineY + (r + 1) * (TALL + 22);
      return html`<path class=${line} d="M${LEFT + 18},${lineY} V${at} H${LEFT + 40 + NARROW / 2}" />`;
    })}
    ${bus.devices.map(([name, device], n) => {
      const x = LEFT + 40 + (n % columns) * step;
      const y = lineY + Math.floor(n / columns) * (TALL + 22);
      return html`<${Device} store=${store} name=${name} device=${device} x=${x} y=${y} width=${box} line=${line} />`;
    })}
  </g>`;
}

function Device({ store, name, device, x, y, width, line }) {
  const halves = width >= WIDE ? 2 : 1;
  const half = width / halves;
  const seen = store.status?.gateway?.devices?.[name];
  const tags = Object.keys(device.tags).map((tag) => store.tags[`${name}.${tag}`]).filter(Boolean);
  const good = tags.filter((t) => t.quality === "good").length;
  const oldest = Math.max(0, ...tags.filter((t) => t.age_s !== null && t.quality === "good").map((t) => t.age_s));
  const shown = Object.entries(device.tags)
    .map(([tag, about]) => [tag, about, store.tags[`${name}.${tag}`]])
    .filter(([, about, now]) => now && !about.secret)
    .slice(0, halves * MOST_VALUES);
  const fault = store.status?.field?.faults?.find((f) => f.device === name);
  const lamp = !seen ? "" : !seen.online ? "bad" : good < tags.length ? "warn" : "good";
  const state = !seen ? "unknown" : seen.online ? "answers" : seen.error || "does not answer";
  return html`<g>
    <path class=${line} d="M${x + NARROW / 2},${y} v14" />
    <a href=${address(store.name, "devices", { device: name })}>
      <rect class="box" x=${x} y=${y + 14} width=${width} height=${TALL - 10} rx="8" />
      <circle class="lamp ${lamp}" cx=${x + 16} cy=${y + 32} r="5" />
      <text class="name" x=${x + 28} y=${y + 37}>${name}</text>
      <text class="soft" x=${x + width - 12} y=${y + 37} text-anchor="end">${device.protocol === "canopen" ? "node" : "unit"} ${device.address}</text>
      <text class=${fault ? "warn-text" : lamp === "bad" ? "bad-text" : "soft"} x=${x + 12} y=${y + 56}>
        ${cut(fault ? `fault: ${fault.name}` : lamp === "bad" ? state : tags.length ? `${good} of ${tags.length} good, oldest ${age(oldest)}` : "", 34)}
      </text>
      ${shown.map(([tag, about, now], n) => {
        const bad = now.quality !== "good";
        const left = x + Math.floor(n / MOST_VALUES) * half;
        const row = y + 76 + (n % MOST_VALUES) * 17;
        return html`<text class=${bad ? "bad-text" : "soft"} x=${left + 12} y=${row}>${cut(tag, 16)}</text>
          ${halves > 1 &&
          half >= ROOMY &&
          html`<g transform="translate(${left + half / 2 - 60}, ${row - 12})">
            <${Sparkline} points=${store.recent.get(`${name}.${tag}`)} now=${store.now()} width=${100} height=${14} />
          </g>`}
          <text class=${bad ? "bad-text" : ""} x=${left + half - 12} y=${row} text-anchor="end">
            ${cut(bad ? reason(now.reason) || now.quality : `${value(now, about)} ${about.unit}`, 20)}
          </text>`;
      })}
    </a>
  </g>`;
}

const cut = (text, most) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);
