// Scenarios: record what is done to the simulated devices as one, and run those of the system with their verdicts as a timeline.

import { html, useEffect, useState } from "../vendor/preact.js";
import { get, post, remove } from "../lib/api.js";
import { Failure, useAction, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

const LOOK_EVERY_MS = 1000;

export function Scenario({ store }) {
  useStore(store);
  const path = `${store.path}/scenarios`;
  const [list, error, again] = useFetched(() => get(path), [path]);
  return html`<h1 class="visually-hidden">Scenario</h1>
    <${Failure} text=${error} />
    <div class="scenarios">
      <div>
        ${store.isPrototype && html`<${Record} store=${store} path=${path} onSaved=${again} />`}
      </div>
      <${Run} store=${store} path=${path} files=${list?.files} first=${list?.run} />
    </div>`;
}

/** Fetch every second while `active`: [latest result, error, fetch now]. */
function usePolled(fetcher, active) {
  const [result, error, again] = useFetched(fetcher, []);
  useEffect(() => {
    if (!active(result)) return undefined;
    const timer = setInterval(again, LOOK_EVERY_MS);
    return () => clearInterval(timer);
  }, [active(result)]);
  return [result, error, again];
}

function Record({ store, path, onSaved }) {
  const [state, error, again] = usePolled(
    () => get(`${path}/recording`),
    () => true, // another page may begin or finish it
  );
  const [run, failed, busy] = useAction();
  const [name, setName] = useState("recorded");
  const [saved, setSaved] = useState("");
  const act = (action) => run(action).then(again);
  const begin = () => {
    setSaved("");
    act(() => post(`${path}/recording`));
  };
  const save = (e) => {
    e.preventDefault();
    act(async () => {
      setSaved((await post(path, { name })).path);
      onSaved();
    });
  };
  return html`<section class="card">
    <header>
      <h2>Record</h2>
      ${state?.recording && html`<span class="chip bad" role="status">recording, ${state.elapsed_s.toFixed(0)} s</span>`}
    </header>
    <${Failure} text=${failed || error} />
    ${!state?.recording &&
    html`<p class="soft">
      Begin a recording, then inject faults and set values on the other views. At the end, Studio proposes a scenario with expectations for
      what it has observed.
    </p>`}
    ${state?.recording &&
    html`<ol class="actions">
      ${state.actions.map(([t, said]) => html`<li><span class="mono soft">${t.toFixed(1)} s</span> ${said}</li>`)}
      ${!state.actions.length && html`<li class="soft">Nothing was done yet.</li>`}
    </ol>`}
    ${store.mayOperate &&
    html`<p>
      ${state?.recording
        ? html`<button class="primary" disabled=${busy} onClick=${() => act(() => remove(`${path}/recording`))}>Finish</button>`
        : html`<button class="primary" disabled=${busy || !state} onClick=${begin}>Record</button>`}
    </p>`}
    ${state?.draft &&
    !state.recording &&
    html`<h3>Proposed scenario</h3>
      <pre class="yaml draft" role="group" tabindex="0" aria-label="Proposed scenario">${state.draft}</pre>
      ${store.mayOperate &&
      html`<form class="bar" onSubmit=${save}>
        <label>Name <input size="20" required value=${name} onInput=${(e) => setName(e.target.value)} /></label>
        <span class="soft mono">.scenario.yaml</span>
        <button disabled=${busy}>Save</button>
      </form>`}
      ${saved && html`<p role="status">Saved as <code>${saved}</code>. Run it here, or with <code>fieldtwin test</code>.</p>`}`}
  </section>`;
}

function Run({ store, path, files, first }) {
  const [chosen, setChosen] = useState("");
  const [target, setTarget] = useState("virtual");
  const [state, error, again] = usePolled(
    () => get(`${path}/run`),
    (latest) => latest?.run?.running ?? false,
  );
  const [run, failed, busy] = useAction();
  const now = state?.run ?? first;
  const file = files?.find((f) => f.path === chosen) ?? files?.[0];
  const act = (action) => run(action).then(again);
  return html`<section class="card">
    <header><h2>Run</h2></header>
    <${Failure} text=${failed || error} />
    ${files?.length === 0 && html`<p class="empty">No scenario file names this system, neither in its folder nor in Studio's working directory.</p>`}
    ${file &&
    html`<div class="bar">
      <label>Scenario
        <select value=${file.path} disabled=${now?.running} onChange=${(e) => setChosen(e.target.value)}>
          ${files.map((f) => html`<option value=${f.path} title=${f.path}>${f.title || f.path} (${f.path.split("/").pop()})</option>`)}
        </select>
      </label>
      <label>Target
        <select value=${target} disabled=${now?.running} onChange=${(e) => setTarget(e.target.value)}>
          <option value="virtual">virtual time</option>
          <option value="local">processes of this computer</option>
        </select>
      </label>
      ${store.mayOperate &&
      (now?.running
        ? html`<button class="danger" disabled=${busy} onClick=${() => act(() => remove(`${path}/run`))}>Stop</button>`
        : html`<button class="primary" disabled=${busy} onClick=${() => act(() => post(`${path}/run`, { path: file.path, target }))}>Run</button>`)}
    </div>`}
    ${now && html`<${Verdict} run=${now} />`}
  </section>`;
}

const TONE = { passed: "good", failed: "bad", error: "bad" };

function Verdict({ run }) {
  const { result } = run;
  if (run.running)
    return html`<p role="status"><span class="chip accent">running</span> ${run.path.split("/").pop()}, ${run.elapsed_s.toFixed(0)} s. The steps are shown at its end.</p>`;
  if (!result) return html`<${Failure} text=${`${run.path.split("/").pop()}: ${run.trouble}`} />`;
  const whole = Math.max(result.simulated_s, ...result.checks.map((c) => c.t_s), 0.001);
  return html`<p role="status">
      <span class="chip ${TONE[result.verdict] ?? "warn"}">${result.verdict}</span> <strong>${result.name}</strong>${" "}
      <span class="soft">${result.simulated_s.toFixed(1)} s of the system, target ${result.target}; the run took ${run.elapsed_s.toFixed(1)} s</span>
    </p>
    ${result.reason && html`<p>${result.reason}</p>`}
    ${result.faults.length > 0 &&
    html`<p class="soft">${result.faults.map((f) => `Fault ${f.id} (${f.name} on ${f.on}) took effect ${f.struck} times.`).join(" ")}</p>`}
    <table class="list timeline">
      <thead>
        <tr><th>Step</th><th>Verdict</th><th class="number">Decided</th><th>Time</th><th>Step or check</th></tr>
      </thead>
      <tbody>
        ${result.checks.map((check, n) => {
          const from = isStep(check) && n > 0 ? result.checks[n - 1].t_s : 0;
          return html`<tr key=${n}>
            <td>${check.number}</td>
            <td><span class="chip ${TONE[check.verdict] ?? "warn"}">${check.verdict}</span></td>
            <td class="number">${check.t_s.toFixed(2)} s</td>
            <td><${Span} from=${from / whole} to=${check.t_s / whole} tone=${TONE[check.verdict] ?? "warn"} /></td>
            <td class="what">
              ${check.text}
              ${check.verdict !== "passed" &&
              html`<div class="bad-text">${[check.expected && `expected: ${check.expected}`, check.got && `got: ${check.got}`, check.reason].filter(Boolean).join("; ")}</div>`}
              ${check.verdict !== "passed" && check.where && html`<div class="soft mono">${check.where}</div>`}
            </td>
          </tr>`;
        })}
      </tbody>
    </table>`;
}

const isStep = (check) => /^\d+$/.test(check.number);
const WIDTH = 110;

const Span = ({ from, to, tone }) =>
  html`<svg class="span" width=${WIDTH} height="14" aria-hidden="true">
    <rect class="ground" width=${WIDTH} height="14" rx="3" />
    <rect class=${tone} x=${from * WIDTH} width=${Math.max(2, (to - from) * WIDTH)} height="14" rx="2" />
  </svg>`;
