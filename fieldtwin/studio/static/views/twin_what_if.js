// What-if questions: a form with the horizon and the changed inputs, and the forecast beside the history of the same tags.

import { html, useEffect, useState } from "../vendor/preact.js";
import { get, post, remove } from "../lib/api.js";
import { number, yaml } from "../lib/format.js";
import { Copyable, Failure, useAction, useFetched } from "../lib/parts.js";
import { ForecastChart } from "./twin_forecast.js";

const LOOK_EVERY_MS = 1000;
const HORIZONS = [["1 min", 60], ["5 min", 300], ["10 min", 600], ["30 min", 1800], ["1 h", 3600], ["6 h", 21600], ["24 h", 86400]];
const MOST_SERIES = 4;

export function WhatIf({ store }) {
  const path = `${store.path}/what-if`;
  const [state, error, again] = useFetched(() => get(path), [path]);
  const now = state?.run;
  useEffect(() => {
    if (!now?.running) return undefined;
    const timer = setInterval(again, LOOK_EVERY_MS);
    return () => clearInterval(timer);
  }, [now?.running]);
  return html`<section class="card what-if" aria-label="What if">
    <header><h2>What if</h2><span class="soft">A prototype runs ahead in virtual time, from the present state. The plant is not touched.</span></header>
    <${Failure} text=${error} />
    <div class="asking">
      ${store.mayOperate && html`<${Form} store=${store} path=${path} running=${now?.running ?? false} again=${again} />`}
      <div>
        ${now ? html`<${Forecast} store=${store} run=${now} key=${now.began_ns} />` : state && html`<p class="empty">${store.mayOperate ? "Ask a question to see a forecast." : "No question was asked yet."}</p>`}
      </div>
    </div>
  </section>`;
}

const NO_COMMAND = { period_s: "", at_s: "0" };
const NO_FAULT = { name: "", device: "", from_s: "10", until_s: "" };
const filled = (text) => text.trim() !== "";

function Form({ store, path, running, again }) {
  const { devices } = store.about.system;
  const names = Object.entries(devices).flatMap(([d, { tags }]) => Object.entries(tags).filter(([, t]) => !t.secret).map(([t]) => `${d}.${t}`));
  const [horizon, setHorizon] = useState(300);
  const [series, setSeries] = useState(names.slice(0, 1));
  const [commands, setCommands] = useState([NO_COMMAND]);
  const [fault, setFault] = useState(NO_FAULT);
  const [requirement, setRequirement] = useState("");
  const [final, setFinal] = useState("");
  const [kinds] = useFetched(() => get("/faults"), []);
  const [run, error, busy] = useAction();
  const act = (action) => run(action).then(again);
  const ask = (e) => {
    e.preventDefault();
    act(() =>
      post(path, {
        horizon_s: horizon,
        series,
        commands: commands.filter((c) => filled(c.period_s)).map((c) => ({ period_s: Number(c.period_s), at_s: Number(c.at_s || 0) })),
        faults: fault.name ? [faultOf(fault)] : [],
        require: filled(requirement) ? [requirement] : [],
        finally: filled(final) ? [final] : [],
      }),
    );
  };
  const command = (n, key) => (e) => setCommands(commands.map((c, i) => (i === n ? { ...c, [key]: e.target.value } : c)));
  const ofFault = (key) => (e) => setFault({ ...fault, [key]: e.target.value });
  return html`<form onSubmit=${ask}>
    <${Failure} text=${error} />
    <div class="fields">
      <label><span>Horizon</span>
        <select value=${horizon} onChange=${(e) => setHorizon(Number(e.target.value))}>${HORIZONS.map(([title, s]) => html`<option value=${s}>${title}</option>`)}</select>
      </label>
      <label><span>Draw</span>
        <select value="" disabled=${series.length >= MOST_SERIES} onChange=${(e) => e.target.value && setSeries([...series, e.target.value])}>
          <option value="">add a tag</option>
          ${names.filter((t) => !series.includes(t)).map((t) => html`<option value=${t}>${t}</option>`)}
        </select>
      </label>
      <div class="tags">
        ${series.map((t) => html`<button type="button" class="chip" key=${t} aria-label="Do not draw ${t}" onClick=${() => setSeries(series.filter((o) => o !== t))}>${t} ×</button>`)}
      </div>
      ${commands.map(
        (c, n) => html`<div class="pair" key=${n}>
          <span>${n ? "Then period" : "Period"}</span>
          <label><input type="number" step="1" value=${c.period_s} placeholder="as now" aria-label="Commanded period in seconds" onInput=${command(n, "period_s")} /> s</label>
          <label>after <input type="number" min="0" step="any" value=${c.at_s} onInput=${command(n, "at_s")} /> s</label>
        </div>`,
      )}
      <p class="more">
        <button type="button" class="quiet" disabled=${commands.length > 4 || !filled(commands.at(-1).period_s)} onClick=${() => setCommands([...commands, { ...NO_COMMAND, at_s: "60" }])}>Add a command</button>
      </p>
      <label><span>Fault</span>
        <select value=${fault.name} onChange=${ofFault("name")}><option value="">none</option>${(kinds ?? []).map((k) => html`<option value=${k.name}>${k.name}</option>`)}</select>
      </label>
      ${fault.name &&
      html`<label><span>on device</span>
          <select value=${fault.device} onChange=${ofFault("device")}><option value="">any</option>${Object.keys(devices).map((d) => html`<option value=${d}>${d}</option>`)}</select>
        </label>
        <div class="pair">
          <span>from</span>
          <label><input type="number" min="0" step="any" value=${fault.from_s} aria-label="Begin of the fault in seconds from now" onInput=${ofFault("from_s")} /> s</label>
          <label>until <input type="number" min="0" step="any" value=${fault.until_s} placeholder="the end" onInput=${ofFault("until_s")} /> s</label>
        </div>`}
      <label><span>Always required</span><input value=${requirement} placeholder="quality(ctd.pressure) == 'good'" onInput=${(e) => setRequirement(e.target.value)} /></label>
      <label><span>At the end</span><input value=${final} placeholder="relay.period == 60" onInput=${(e) => setFinal(e.target.value)} /></label>
    </div>
    <footer class="bar">
      ${running
        ? html`<button type="button" class="danger" disabled=${busy} onClick=${() => act(() => remove(path))}>Stop</button>`
        : html`<button class="primary" disabled=${busy}>Ask</button>`}
    </footer>
  </form>`;
}

function faultOf({ name, device, from_s, until_s }) {
  return {
    name,
    ...(device && { device }),
    ...(filled(from_s) && { from: `${Number(from_s)}s` }),
    ...(filled(until_s) && { until: `${Number(until_s)}s` }),
  };
}

function Forecast({ store, run }) {
  const { result, asked } = run;
  return html`${run.running && html`<p role="status"><span class="chip accent">running</span> ${Math.round(run.elapsed_s)} s so far, ${number(asked.horizon_s / 60)} min ahead</p>`}
    ${!run.running && !result && html`<${Failure} text=${run.trouble} />`}
    ${result?.error && html`<${Failure} text=${result.error} />`}
    ${result &&
    html`<p role="status">
      <span class="chip ${result.met ? "good" : "bad"}">${result.requirements.length ? (result.met ? "all requirements met" : "not met") : result.error ? "failed" : "done"}</span>
      ${" "}<strong>${result.plan}</strong> <span class="soft">${number(result.horizon_s / 60)} min ahead, computed in ${run.elapsed_s.toFixed(1)} s</span>
    </p>`}
    ${asked.series.length > 0 && html`<${ForecastChart} store=${store} run=${run} />`}
    ${result?.requirements.length > 0 &&
    html`<ul class="requirements">
      ${result.requirements.map(
        (r) => html`<li><span class="chip ${r.met ? "good" : "bad"}">${r.met ? "met" : "not met"}</span> ${r.kind === "require" ? "always" : "at the end"} <code>${r.text}</code>
          ${!r.met && html` <span class="bad-text">from ${number(r.at_s)} s on, with ${r.seen}</span>`}</li>`,
      )}
    </ul>`}
    ${result?.not_taken.length > 0 && html`<p class="soft">Started without the present state of: ${result.not_taken.join(", ")}.</p>`}
    ${Object.entries(result?.states ?? {}).map(([program, states]) => html`<p class="soft">${program}: ${states.slice(0, 8).map(([t, s]) => `${s} at ${number(t)} s`).join(" → ")}${states.length > 8 ? " …" : ""}</p>`)}
    <details>
      <summary>The same on the command line</summary>
      <${Copyable} text=${run.command} />
      ${asked.faults.length > 0 && html`<p class="soft">with faults.yaml:</p><pre class="yaml">${`faults: [${asked.faults.map(yaml).join(", ")}]`}</pre>`}
    </details>`;
}
