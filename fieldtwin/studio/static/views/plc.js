// The PLC: states, cycle time, variables, forces, and the source of its programs with live values.

import { html, useEffect, useState } from "../vendor/preact.js";
import { address } from "../lib/address.js";
import { get, post } from "../lib/api.js";
import { number, typed, unitAfter } from "../lib/format.js";
import { Failure, Quality, useAction, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";
import { ForceDialog, ReleaseDialog, Why } from "./plc_dialogs.js";
import { Drawings } from "./plc_drawings.js";
import { Source } from "./plc_source.js";
import { States, Transitions } from "./plc_states.js";

export function Plc({ store }) {
  useStore(store);
  const plc = store.status?.plc;
  const [run, error] = useAction();
  const [open, setOpen] = useState(null); // the open dialog: [component, its properties]
  const [transitions] = useFetched(() => get(`${store.path}/plc/transitions${store.isTrace ? `?at_ns=${store.settled ?? 0}` : ""}`), [store.settled, JSON.stringify(store.status?.transitions ?? {})]);
  const [drawings] = useFetched(() => (store.isTrace ? Promise.resolve({}) : get(`${store.path}/plc/drawings`)), [store.path, Boolean(plc), plc?.pid, plc?.restarts, plc?.programs_replaced]);
  if (!plc) return html`<p class="empty">The PLC does not answer.</p>`;
  const act = (path, body) => () => run(() => post(`${store.path}/plc/${path}`, body));
  const programs = Object.keys(store.about.system.programs);
  const [Opened, properties] = open ?? [];
  const tags = html`<${Tags} store=${store} plc=${plc} onOpen=${(...dialog) => setOpen(dialog)} />`;
  return html`<h1 class="visually-hidden">PLC</h1>
    <${Failure} text=${error} />
    <div class="bar">
      ${!store.isTrace && html`<span class="chip ${plc.state === "running" ? "good" : "warn"}">${plc.state}</span>`}
      ${store.mayOperate &&
      html`${plc.state === "paused"
        ? html`<button class="primary" onClick=${act("continue")}>Continue</button><button onClick=${act("step", { count: 1 })}>Step one scan</button>`
        : html`<button onClick=${act("pause")}>Pause</button>`}`}
      <span class="grow"></span>
      <span class="soft">scan every ${number(plc.cycle_ms)} ms${!store.isTrace && ` · ${plc.scans} scans · ${plc.missed_periods} missed periods · ${plc.overruns} overruns`}</span>
    </div>
    <div class="columns plc">
      <div class="stack">
        ${programs.map((name) => html`<${Program} key=${name} store=${store} name=${name} plc=${plc} changes=${transitions?.[name] ?? []} />`)}
        ${programs.map((name) => drawings?.[name] && html`<${Drawings} key=${name} store=${store} program=${name} drawings=${drawings[name]} />`)}
        ${!store.isTrace && html`${tags}<${Internal} store=${store} />`}
        ${store.isTrace &&
        programs.length > 0 &&
        !store.about.programs_described &&
        html`<p class="card soft">The trace does not describe its programs, so their diagrams and sources are missing. A run in virtual time describes them.</p>`}
      </div>
      <div class="stack">
        ${store.isTrace && tags}
        <${Durations} title="Duration of scans" spread=${plc.duration_us} buckets=${plc.duration_buckets} most=${plc.cycle_ms} of="the cycle time" />
        <${Durations} title="Lateness of scans" spread=${plc.lateness_us} buckets=${plc.lateness_buckets} most=${plc.late_ms} of="the permitted delay" />
      </div>
    </div>
    <div class="stack sources">${programs.map((name) => html`<${Source} key=${name} store=${store} name=${name} />`)}</div>
    ${Opened && html`<${Opened} store=${store} ...${properties} onClose=${() => setOpen(null)} />`}`;
}

function Program({ store, name, plc, changes }) {
  const about = store.programs[name];
  const waiting = plc.waiting[name];
  if (!waiting && !about?.machine) return null;
  return html`<section class="card" aria-label="Program ${name}">
    <header>
      <h2>${name}${about?.machine && html`: <span class="now-state">${store.word(name, "state", store.variable(name, "state"))}</span>`}</h2>
      <span class="soft mono">${store.about.system.programs[name].source}</span>
    </header>
    ${waiting && html`<p class="error">It has not started; missing ${waiting.reason}</p>`}
    ${about?.machine && html`<${States} store=${store} name=${name} changes=${changes} /><${Transitions} store=${store} name=${name} changes=${changes} />`}
  </section>`;
}

const COUNTER = /\.(taken|consumed)$/; // counts the messages of a mailbox
const ORDER = ["output", "local", "input", "messages", "watched", "internal", "counter"];

/** The tags in the PLC: [kind, name, present value, its description], those that programs use first. */
function tagsOf(store, plc) {
  const known = new Map();
  const read = new Map();
  for (const { variables } of Object.values(store.programs)) {
    for (const v of Object.values(variables)) {
      if (v.role === "input") read.set(v.tag, v);
      else known.set(v.tag, v);
    }
  }
  const inputs = Object.entries(plc.inputs).map(([name, v]) => {
    return [COUNTER.test(name) ? "counter" : read.has(name) ? "input" : "watched", name, v, { words: {}, unit: "", type: read.get(name)?.type }];
  });
  const outputs = Object.entries(plc.outputs).map(([name, value]) => {
    const v = known.get(name);
    const kind = COUNTER.test(name) ? "counter" : v?.kind === "message" ? "messages" : (v?.role ?? "output");
    return [kind, name, { value }, v ?? { words: {}, unit: "" }];
  });
  return [...outputs, ...inputs].sort(([a], [b]) => ORDER.indexOf(a) - ORDER.indexOf(b));
}

function Tags({ store, plc, onOpen }) {
  return html`<div class="scroll" role="group" tabindex="0" aria-label="Tags of the PLC">
    <table class="list one-line">
      <thead><tr><th>Tag</th><th>Kind</th><th class="number">Value</th><th>Quality</th><th><span class="visually-hidden">Actions</span></th></tr></thead>
      <tbody>
        ${tagsOf(store, plc).map(([kind, name, v, { words, type, unit: given }]) => {
          const force = plc.forces[name];
          const word = (value) => words[String(value)] ?? typed(value, type);
          const unit = unitAfter(given, type);
          return html`<tr key=${kind + name} data-tag=${name}>
            <td title=${name}>${name}</td><td class="soft">${kind}</td>
            <td class="number">${word(force ? force.value : v.value)}${unit && html` <span class="soft">${unit}</span>`}</td>
            <td>${force ? html`<span class="chip warn">forced</span>` : v.quality && html`<${Quality} quality=${v.quality} why=${v.reason} />`}</td>
            <td>
              ${!store.isTrace && html`<button class="quiet" onClick=${() => onOpen(Why, { tag: name, input: "quality" in v, word })}>Why?</button>`}
              ${store.mayOperate &&
              (force
                ? html`<button class="quiet" onClick=${() => onOpen(ReleaseDialog, { name })}>Release …</button>`
                : html`<button class="quiet" onClick=${() => onOpen(ForceDialog, { name, words, unit: given, now: v.value })}>Force …</button>`)}
            </td>
          </tr>`;
        })}
      </tbody>
    </table>
  </div>`;
}

/** Variables of programs that are not tags. The PLC answers for them itself, so it is asked once a second, and only while they are shown. */
function Internal({ store }) {
  const [open, setOpen] = useState(false);
  const [second, setSecond] = useState(0);
  useEffect(() => {
    if (!open) return undefined;
    const timer = setInterval(() => setSecond((n) => n + 1), 1000);
    return () => clearInterval(timer);
  }, [open]);
  const [found, error] = useFetched(() => (open ? get(`${store.path}/plc/internal`) : Promise.resolve(null)), [open, second]);
  return html`<details class="card" open=${open} onToggle=${(event) => setOpen(event.target.open)}>
    <summary>Variables that are not tags: members of blocks, arrays, strings</summary>
    <${Failure} text=${error} />
    ${found && found.variables.length === 0 && html`<p class="soft">The programs have none.</p>`}
    ${found &&
    found.variables.length > 0 &&
    html`<div class="scroll">
      <table class="list one-line">
        <thead><tr><th>Variable</th><th class="iec-type">Type</th><th class="number">Value</th><th><span class="visually-hidden">Actions</span></th></tr></thead>
        <tbody>
          ${found.variables.map((v) => {
            const unit = unitAfter(v.unit, v.type);
            return html`<tr key=${v.name} data-variable=${v.name}>
              <td title=${v.name}>${v.name}</td><td class="soft iec-type">${v.type}</td>
              <td class="number" title=${v.value}>${typed(v.value, v.type)}${unit && html` <span class="soft">${unit}</span>`}</td>
              <td><a class="quiet" href="${address(store.name, "trends")}?variable=${encodeURIComponent(v.name)}" aria-label="Trend of ${v.name}">Trend</a></td>
            </tr>`;
          })}
        </tbody>
      </table>
    </div>`}
    ${found?.more > 0 && html`<p class="soft note">${found.more} more: fieldtwin plc watch shows them.</p>`}
  </details>`;
}

const PERCENTILES = { p50: "median", p99: "99 % within", p999: "99.9 % within", max: "longest" };
const milliseconds = (us) => `${(us / 1000).toFixed(us < 1000 ? 3 : 1)} ms`;
const short = (count) => (count < 1000 ? String(count) : count < 1e6 ? `${Math.floor(count / 1000)}k` : `${Math.floor(count / 1e6)}M`);
const limit = (us) => (us < 1000 ? `${number(us)} µs` : us < 1e6 ? `${number(us / 1000)} ms` : `${number(us / 1e6)} s`);

/** A histogram with bars of logarithmic height, so that a single long scan among millions is visible. `most` in ms. */
function Durations({ title, spread, buckets, most, of }) {
  if (!spread?.count) return null;
  const tallest = Math.log10(1 + Math.max(...(buckets ?? []).map(([, count]) => count)));
  const text = (us, count) => `${count} scans, up to ${limit(us)}`;
  return html`<section class="card" aria-label=${title}>
    <header><h2>${title}</h2><span class="soft">${spread.count} scans</span></header>
    ${buckets?.length > 0 &&
    html`<div class="bars" role="img" aria-label="${title}: ${buckets.filter(([, n]) => n).map(([us, n]) => text(us, n)).join("; ")}">
        ${buckets.map(
          ([us, count]) => html`<div key=${us} title=${text(us, count)}>
            <span class="bar-count">${count ? short(count) : ""}</span>
            <i class=${us > most * 1000 ? "beyond" : ""} style=${{ height: `${count ? Math.max(2, (Math.log10(1 + count) / tallest) * 78) : 0}px` }}></i>
            <small>${limit(us)}</small>
          </div>`,
        )}
      </div>
      <p class="soft note">Up to each time, logarithmic. Orange: longer than ${of}, ${number(most)} ms.</p>`}
    <dl class="facts">
      ${Object.entries(PERCENTILES).map(([key, name]) => spread[key] !== undefined && html`<dt>${name}</dt><dd class="mono">${milliseconds(spread[key])}</dd>`)}
    </dl>
  </section>`;
}
