// Scenarios: record what is done to the simulated devices as one, and run those of the system with their verdicts as a timeline.

import { html, useEffect, useMemo, useRef, useState } from "../vendor/preact.js";
import { address } from "../lib/address.js";
import { get, post, remove, url } from "../lib/api.js";
import { Charts, Cursors, Marks } from "../lib/chart.js";
import { seriesOf } from "../lib/series.js";
import { Failure, useAction, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";
import { PREFIX } from "../lib/trace_store.js";

const LOOK_EVERY_MS = 1000;
const FOLLOW_EVERY_MS = 300;

export function Scenario({ store }) {
  useStore(store);
  const path = `${store.path}/scenarios`;
  const [list, error, again] = useFetched(() => get(path), [path]);
  const [run, values, runError, lookAgain] = useRun(path);
  return html`<h1 class="visually-hidden">Scenario</h1>
    <${Failure} text=${error} />
    <div class="scenarios">
      <div>
        ${store.isPrototype && html`<${Record} store=${store} path=${path} onSaved=${again} />`}
      </div>
      <${Run} store=${store} path=${path} files=${list?.files} run=${run} error=${runError} again=${lookAgain} />
    </div>
    ${run &&
    html`<div class="columns run-view">
      <${Timeline} run=${run} />
      <${Values} store=${store} run=${run} values=${values} key=${run.number} />
    </div>`}`;
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

function Run({ store, path, files, run: now, error, again }) {
  const [chosen, setChosen] = useState("");
  const [target, setTarget] = useState("virtual");
  const [act, failed, busy] = useAction();
  const file = files?.find((f) => f.path === chosen) ?? files?.[0];
  const does = (action) => act(action).then(again);
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
        ? html`<button class="danger" disabled=${busy} onClick=${() => does(() => remove(`${path}/run`))}>Stop</button>`
        : html`<button class="primary" disabled=${busy} onClick=${() => does(() => post(`${path}/run`, { path: file.path, target }))}>Run</button>`)}
    </div>`}
    ${now && html`<${Summary} run=${now} path=${path} />`}
  </section>`;
}

const TONE = { passed: "good", failed: "bad", error: "bad" };

function Summary({ run, path }) {
  const { result, progress } = run;
  const file = run.path.split("/").pop();
  if (run.running) return html`<p role="status"><span class="chip accent">running</span> ${file}, ${progress.t_s.toFixed(1)} s of the system in ${run.elapsed_s.toFixed(0)} s</p>`;
  if (!result) return html`<${Failure} text=${`${file}: ${run.trouble}`} />`;
  return html`<p role="status">
      <span class="chip ${TONE[result.verdict] ?? "warn"}">${result.verdict}</span> <strong>${result.name}</strong>${" "}
      <span class="soft">${result.simulated_s.toFixed(1)} s of the system, target ${result.target}; the run took ${run.elapsed_s.toFixed(1)} s</span>
    </p>
    <p class="bar ways">
      ${run.report && html`<a href=${url(`${path}/run/report`)} target="_blank" rel="noopener">Report</a>`}
      ${run.trace && html`<a href=${address(PREFIX + run.trace)}>Look into the run at any instant</a>`}
    </p>
    ${result.reason && html`<p>${result.reason}</p>`}
    ${result.faults.length > 0 &&
    html`<p class="soft">${result.faults.map((f) => `Fault ${f.id} (${f.name} on ${f.on}) took effect ${f.struck} times.`).join(" ")}</p>`}`;
}

/** Steps and checks of the whole run: what the progress says, completed by the result at the end. */
function rowsOf({ progress, result, running }) {
  const decided = new Map((result?.checks ?? []).map((check) => [check.number, check]));
  const named = [...progress.steps, ...progress.checks];
  const known = new Set(named.map(({ number }) => number));
  const rows = [...named, ...(result?.checks ?? []).filter((check) => !known.has(check.number))];
  return rows.map((row) => {
    const check = decided.get(row.number);
    const verdict = check?.verdict ?? row.verdict;
    const begun = row.begun_s ?? null;
    const isStep = "begun_s" in row;
    const waiting = !running ? (isStep ? "not reached" : "not judged") : !isStep ? "watched" : begun === null ? "to come" : "running";
    return { ...row, ...check, text: check?.text ?? row.text, isStep, begun, verdict, shown: verdict || waiting, t_s: check?.t_s ?? row.t_s };
  });
}

function Timeline({ run }) {
  const rows = rowsOf(run);
  const whole = Math.max(run.result?.simulated_s ?? 0, run.progress.t_s, ...rows.map((row) => row.t_s ?? 0), 0.001);
  if (!rows.length) return null;
  return html`<section class="scroll steps" aria-label="Timeline" tabindex="0">
    <table class="list timeline">
      <thead><tr><th>Step</th><th>Verdict</th><th class="number">Decided</th><th>Time</th><th>Step or check</th></tr></thead>
      <tbody>
        ${rows.map((row) => {
          const tone = TONE[row.verdict] ?? (row.verdict ? "warn" : row.shown === "running" ? "accent" : "");
          const from = row.isStep ? row.begun : 0;
          return html`<tr key=${row.number} class=${row.shown === "running" ? "marked" : ""} data-step=${row.number}>
            <td>${row.number}</td>
            <td><span class="chip ${tone}">${row.shown}</span></td>
            <td class="number">${row.t_s === null || row.t_s === undefined ? "" : `${row.t_s.toFixed(2)} s`}</td>
            <td>${from !== null && from !== undefined && html`<${Span} from=${from / whole} to=${(row.t_s ?? run.progress.t_s) / whole} tone=${tone || "idle"} />`}</td>
            <td class="what">
              ${row.text}
              ${row.verdict && row.verdict !== "passed" &&
              html`<div class="bad-text">${[row.expected && `expected: ${row.expected}`, row.got && `got: ${row.got}`, row.reason].filter(Boolean).join("; ")}</div>`}
              ${row.verdict && row.verdict !== "passed" && row.where && html`<div class="soft mono">${row.where}</div>`}
            </td>
          </tr>`;
        })}
      </tbody>
    </table>
  </section>`;
}

const WIDTH = 84;

const Span = ({ from, to, tone }) =>
  html`<svg class="span" width=${WIDTH} height="14" aria-hidden="true">
    <rect class="ground" width=${WIDTH} height="14" rx="3" />
    <rect class=${tone} x=${from * WIDTH} width=${Math.max(2, (to - from) * WIDTH)} height="14" rx="2" />
  </svg>`;

const MOST_CHARTED = 6;

/** The values that the scenario checks or sets, over the time of the run, with its faults and changes of states as marks. */
function Values({ store, run, values }) {
  const [view, setView] = useState({ zoom: null, a: null, b: null });
  const { data, tags, marks } = useMemo(() => {
    const found = {};
    const states = [];
    for (const [name, t, value, quality, why] of values) {
      const t_ns = t * 1e9;
      if (typeof value === "string") states.push({ t_ns, kind: "state", text: `${name.split(".")[0]}: ${value}` });
      else (found[name] ??= { points: [], now_ns: run.progress.t_s * 1e9 }).points.push([t_ns, value, quality, why]);
    }
    const steps = run.progress.steps.filter(({ begun_s, text }) => begun_s !== null && /^(fault|clear|set|send):/.test(text));
    const acts = steps.map(({ begun_s, text }) => ({ t_ns: begun_s * 1e9, kind: text.startsWith("clear") ? "cleared" : "fault", text }));
    const series = Object.entries(found).map(([name, one]) => {
      const tag = store.tagOf(name);
      return [name, seriesOf(one, { unit: tag?.unit, words: tag?.values })];
    });
    return { data: Object.fromEntries(series), tags: Object.keys(found).slice(0, MOST_CHARTED), marks: [...acts, ...states].sort((a, b) => a.t_ns - b.t_ns) };
  }, [values, run.progress.t_s]);
  if (!tags.length) return null;
  return html`<section aria-label="Values of the run">
    ${view.zoom && html`<div class="bar"><button class="primary" onClick=${() => setView({ ...view, zoom: null })}>Reset zoom</button></div>`}
    <${Charts} started=${0} tags=${tags} data=${data} range=${[0, run.progress.t_s]} marks=${marks} view=${view} setView=${setView} />
    <${Cursors} started=${0} tags=${tags} data=${data} view=${view} setView=${setView} from=${0} to=${run.progress.t_s} />
    <${Marks} started=${0} marks=${marks} view=${view} setView=${setView} />
  </section>`;
}

/** The present or latest run and all values of its progress: [run, values, error, fetch now]. */
function useRun(path) {
  const known = useRef({ number: 0, values: [] });
  const [run, setRun] = useState(null);
  const [error, setError] = useState("");
  const [round, setRound] = useState(0);
  useEffect(() => {
    let current = true;
    let timer = 0;
    const look = async () => {
      try {
        const found = (await get(`${path}/run?values_from=${known.current.values.length}`)).run;
        if (!current) return;
        setError("");
        if (!found) return;
        const { number, values } = known.current;
        const other = found.number !== number || found.progress.values_total < values.length;
        if (other) known.current = { number: found.number, values: [] };
        if (other && found.progress.values_from > 0) return look();
        if (found.progress.values.length) known.current.values = [...known.current.values, ...found.progress.values];
        setRun(found);
        if (found.running) timer = setTimeout(look, FOLLOW_EVERY_MS);
      } catch (e) {
        if (!current) return;
        setError(e.message);
        timer = setTimeout(look, LOOK_EVERY_MS);
      }
    };
    look();
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [path, round]);
  return [run, known.current.values, error, () => setRound((n) => n + 1)];
}
