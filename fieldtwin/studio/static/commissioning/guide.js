// Commissioning: the first hour with a device, step by step. Each step runs a command of the command line in Studio's working folder.

import { html, useEffect, useMemo, useRef, useState } from "../vendor/preact.js";
import { followPath, get, post, remove } from "../lib/api.js";
import { Guard } from "../lib/guard.js";
import { Dialog, Failure, useAction } from "../lib/parts.js";
import { Editor, emptyDraft } from "./editor.js";
import { CommandLine, Fields, useCommand, valuesOf } from "./fields.js";
import { PortStep } from "./port.js";
import { Download, Result } from "./results.js";
import { Finish } from "./finish.js";
import { isCan, isPractice, STEPS } from "./steps.js";

const WORDS = { running: "running", done: "done", findings: "findings", stopped: "stopped", failed: "failed" };
const TONES = { running: "accent", done: "good", findings: "warn", stopped: "warn", failed: "bad" };
const NEW = { endpoint: "", name: "device", settings: null, address: 1, profile: "", draft: "", forms: {}, taken: 0, identified: 0, draftValid: null };
const keyOf = (folder) => `fieldtwin-commissioning ${folder}`;

/** What the user has chosen, kept in the browser for this folder. */
function useChoices(folder) {
  const [choices, setChoices] = useState(NEW);
  useEffect(() => {
    if (!folder) return;
    try {
      setChoices({ ...NEW, ...JSON.parse(localStorage.getItem(keyOf(folder)) ?? "{}") });
    } catch {
      // a browser without storage begins anew
    }
  }, [folder]);
  const change = (more) =>
    setChoices((old) => {
      const next = { ...old, ...(typeof more === "function" ? more(old) : more) };
      try {
        localStorage.setItem(keyOf(folder), JSON.stringify(next));
      } catch {
        // as above
      }
      return next;
    });
  return [choices, change];
}

/** The guide's state on the server: its jobs arrive over the stream, the files are read again when a job ends. */
function useGuide() {
  const [guide, setGuide] = useState(null);
  const [error, setError] = useState("");
  const [connected, setConnected] = useState(true);
  const seen = useRef({ asked: 0, shown: 0, streamed: 0 });
  const read = () => {
    const number = (seen.current.asked += 1);
    const { streamed } = seen.current;
    return get("/commissioning").then(
      (got) => {
        if (number < seen.current.shown) return; // a later answer has arrived first
        seen.current.shown = number;
        setGuide((old) => (old && streamed !== seen.current.streamed ? { ...got, jobs: old.jobs } : got)); // the stream's jobs are newer
        setError("");
      },
      (e) => setError(e.message),
    );
  };
  const ended = useRef("");
  useEffect(() => {
    read();
    return followPath(
      "/commissioning/stream",
      ({ jobs }) => {
        seen.current.streamed += 1;
        setGuide((old) => old && { ...old, jobs });
        const now = jobs.map((j) => `${j.number}${j.state === "running" ? "" : "e"}`).join();
        if (now !== ended.current) read();
        ended.current = now;
      },
      setConnected,
    );
  }, []);
  return [guide, error, connected, read];
}

export function Guide({ step: wanted, place, children }) {
  const [guide, error, connected, again] = useGuide();
  const [choices, change] = useChoices(guide?.folder);
  const [draft, setDraft] = useState(emptyDraft);
  const [run, failed, busy] = useAction();
  const latest = useMemo(() => {
    const found = {};
    for (const job of guide?.jobs ?? []) if (!isPractice(job)) found[job.step] = job;
    return found;
  }, [guide]);
  const practice = guide?.jobs.findLast(isPractice);
  const ctx = guide && {
    ...choices,
    files: guide.files,
    profiles: guide.profiles,
    latest,
    practice: practice?.state === "running" ? practice : null,
    practiceFailed: practice?.state === "failed" ? practice.lines.slice(-3).join(" ") : "",
    emulator: latest.emulate?.state === "running" ? latest.emulate : null,
  };
  useEffect(() => {
    const scan = latest.scan;
    if (!scan || scan.state === "running" || scan.number === choices.taken || scan.form.endpoint !== choices.endpoint) return;
    get(`/commissioning/jobs/${scan.number}`).then(({ result }) => {
      const [unit] = result?.units ?? [];
      const [node] = result?.nodes ?? [];
      change({ taken: scan.number, ...(unit ? { address: unit.unit, settings: unit.settings } : node ? { address: node.node } : {}) });
    }, () => {});
  }, [latest.scan?.number, latest.scan?.state]);
  useEffect(() => {
    const job = latest.identify;
    if (!job || job.state === "running" || job.number === choices.identified) return;
    get(`/commissioning/jobs/${job.number}`).then(({ result }) => {
      const fits = result?.candidates?.find((c) => c.sureness === "certain" || c.sureness === "likely");
      change({ identified: job.number, profile: guide.profiles.find((p) => p.device === fits?.profile)?.name ?? "" });
    }, () => {});
  }, [latest.identify?.number, latest.identify?.state]);
  const at = STEPS.find((s) => s.id === wanted) ?? STEPS[0];
  const mayOperate = guide?.role === "operate";
  const main = useRef(null);
  const first = useRef(true);
  useEffect(() => {
    if (!first.current) main.current.focus(); // so that the tab key goes on in the step
    first.current = false;
  }, [at]);
  const stateOf = (s) => {
    if (s.id === "port") return choices.endpoint ? "done" : "";
    if (s.id === "edit") return choices.draft ? (choices.draftValid ? "done" : "failed") : "";
    return latest[s.id]?.state ?? "";
  };
  const anew = () =>
    run(async () => {
      await remove("/commissioning/jobs");
      change({ ...NEW });
      setDraft(emptyDraft);
      location.hash = "#/commissioning";
    });
  return html`<div class="frame guided">
    <header class="top">
      <a class="brand" href="#/">fieldtwin Studio</a>
      <strong>Commissioning</strong>
      ${choices.endpoint && html`<span class="chip accent endpoint" title=${choices.endpoint}>${choices.endpoint}</span>`}
      ${ctx?.practice && html`<span class="chip warn">practice: ${ctx.practice.form.what}</span>`}
      <span class="grow"></span>
      ${guide?.role === "view" && html`<span class="chip">view only</span>`}
      <span class="chip ${connected ? "good" : "bad"}" role="status">${connected ? "live" : "not connected"}</span>
      ${children}
    </header>
    <div class="banners"></div>
    <nav class="nav steps" aria-label="Steps">
      ${STEPS.map((s, n) => {
        const state = stateOf(s);
        return html`<a href=${`#/commissioning?step=${s.id}`} aria-current=${s === at ? "step" : null} data-step=${s.id}>
          <span><span class="soft number">${n + 1}</span> ${s.title}</span>
          ${state && html`<span class="chip ${TONES[state]}">${WORDS[state]}</span>`}
        </a>`;
      })}
      ${mayOperate && html`<button type="button" class="quiet" disabled=${busy} onClick=${anew}>Begin with another device</button>`}
    </nav>
    <main id="view" ref=${main} tabindex="-1">
      <${Failure} text=${error || failed} />
      ${!guide && !error && html`<p class="empty">Reading the working folder …</p>`}
      ${guide &&
      html`<div class="guide">
        <section class="card" key=${at.id}>
          <header><h1>${at.title}</h1></header>
          <p class="explanation">${typeof at.text === "function" ? at.text(ctx) : at.text}</p>
          <${Guard} title="This step cannot be shown" place=${place}>
            ${at.id === "port" && html`<${PortStep} ctx=${ctx} guide=${guide} change=${change} mayOperate=${mayOperate} again=${again} />`}
            ${at.id === "edit" &&
            html`<${Editor} ctx=${ctx} folder=${guide.folder} draft=${draft} setDraft=${setDraft} mayOperate=${mayOperate}
              onSaved=${(name, valid) => (change({ draft: name, draftValid: valid }), again())} />`}
            ${at.fields && html`<${CommandStep} step=${at} ctx=${ctx} choices=${choices} change=${change} mayOperate=${mayOperate} again=${again} />`}
          <//>
        </section>
        ${at === STEPS.at(-1) && html`<${Finish} ctx=${ctx} folder=${guide.folder} />`}
        <${Files} guide=${guide} />
        <${Next} at=${at} />
      </div>`}
    </main>
  </div>`;
}

function Next({ at }) {
  const n = STEPS.indexOf(at);
  const [before, after] = [STEPS[n - 1], STEPS[n + 1]];
  return html`<p class="bar ways">
    ${before && html`<a href=${`#/commissioning?step=${before.id}`}>← ${before.title}</a>`}
    <span class="grow"></span>
    ${after && html`<a href=${`#/commissioning?step=${after.id}`}>Next: ${after.title} →</a>`}
  </p>`;
}

function CommandStep({ step, ctx, choices, change, mayOperate, again }) {
  const fields = step.fields(ctx);
  const values = valuesOf(fields, choices.forms[step.id]);
  const request = { step: step.id, ...step.request(ctx, values) };
  const unfilled = fields.some((f) => (f.kind === "number" || f.kind === "out") && String(values[f.name]) === "");
  const [text, problem] = useCommand(unfilled ? null : request);
  const [run, error, busy] = useAction();
  const [asking, setAsking] = useState(false);
  const job = ctx.latest[step.id];
  const running = job?.state === "running";
  const enter = (name, value) => change((old) => ({ forms: { ...old.forms, [step.id]: { ...old.forms[step.id], [name]: value } } }));
  const start = (confirmed) =>
    run(async () => {
      setAsking(false);
      await post("/commissioning/jobs", { step: confirmed ? { ...request, confirmed: true } : request });
      const outs = fields.filter((f) => f.kind === "out" || f.name === "resume").map((f) => f.name);
      const address = Number(values.address || NaN); // a typed unit ID or node ID is also that of the next steps
      change((old) => ({
        ...(step.needsPort && Number.isInteger(address) ? { address } : {}),
        forms: { ...old.forms, [step.id]: Object.fromEntries(Object.entries(old.forms[step.id] ?? {}).filter(([name]) => !outs.includes(name))) },
      }));
      again();
    });
  const submit = (e) => {
    e.preventDefault();
    if (step.confirms?.(request)) setAsking(true);
    else start(false);
  };
  if (step.needsPort && !ctx.endpoint) return html`<p class="empty">First <a href="#/commissioning?step=port">choose a port</a>.</p>`;
  if (step.modbusOnly && isCan(ctx.endpoint)) return html`<p class="empty">${step.modbusOnly}</p>`;
  const missing = fields.some((f) => (f.kind === "select" && f.options.length === 0 && !f.none) || (f.kind === "files" && !values[f.name].length));
  return html`
    <form onSubmit=${submit}>
      <${Fields} fields=${fields} values=${values} disabled=${!mayOperate || running} onChange=${enter} />
      ${!missing && html`<${CommandLine} text=${text} />`}
      ${!missing && html`<${Failure} text=${problem || error} />`}
      ${mayOperate &&
      html`<p class="bar">
        ${running
          ? html`<button type="button" class="danger" disabled=${busy} onClick=${() => run(() => remove(`/commissioning/jobs/${job.number}`))}>Stop</button>`
          : html`<button class="primary" disabled=${busy || missing}>${step.title}${job ? " again" : ""}</button>`}
      </p>`}
    </form>
    ${asking &&
    html`<${Dialog} title="Write to the device?" onClose=${() => setAsking(false)}>
      <p>The check writes to ${request.writes.join(", ")} of unit ${request.address} at <code>${request.endpoint}</code>, and puts back what was there.</p>
      <p class="soft">If the connection breaks meanwhile, a changed value may remain.</p>
      <footer>
        <button type="button" onClick=${() => setAsking(false)}>Cancel</button>
        <button type="button" class="danger" onClick=${() => start(true)}>Write and check</button>
      </footer>
    <//>`}
    ${job && html`<${Outcome} job=${job} step=${step} ctx=${ctx} use=${mayOperate && ((address, settings) => change({ address, settings }))} />`}`;
}

/** The state of the latest job of a step, and its result once it has ended. */
function Outcome({ job, step, ctx, use }) {
  const [whole, setWhole] = useState(null);
  const ended = job.state !== "running";
  useEffect(() => {
    let current = true;
    if (ended) get(`/commissioning/jobs/${job.number}`).then((got) => current && setWhole(got), () => {});
    return () => (current = false);
  }, [job.number, ended]);
  const shown = ended && whole?.number === job.number ? whole : null;
  const seconds = step.seconds?.(job.form);
  const lines = shown?.lines ?? job.lines;
  return html`<section class="outcome" aria-label="Result">
    <p class="bar">
      <span class="chip ${TONES[job.state]}" role="status">${WORDS[job.state]}</span>
      <span class="soft">${job.elapsed_s.toFixed(1)} s${job.exit_code === null ? "" : `, exit code ${job.exit_code}`}</span>
      ${!ended && !job.lasts && html`<progress aria-label="Progress" max=${seconds ?? null} value=${seconds ? Math.min(seconds, job.elapsed_s) : null}></progress>`}
      ${Object.entries(job.writes).map(([name, bytes]) => html`<span class="soft"><${Download} name=${name} /> ${size(bytes)}</span>`)}
    </p>
    ${job.trouble && html`<${Failure} text=${job.trouble} />`}
    ${job.state === "failed" && !job.trouble && html`<${Failure} text=${lines.slice(-3).join(" ") || "The command failed without a message."} />`}
    ${shown && job.state === "stopped" && !job.lasts && !shown.result && html`<p class="soft">It was stopped before it had a result.</p>`}
    ${shown && html`<${Result} job=${shown} ctx=${ctx} use=${use} />`}
    ${lines.length > 0 &&
    html`<details open=${!ended || (job.state !== "failed" && !shown?.result)}>
      <summary>Messages${shown?.dropped_lines ? `, the last ${lines.length} of ${shown.line_count}` : ""}</summary>
      <pre class="yaml messages" tabindex="0" aria-label="Messages">${lines.join("\n")}</pre>
    </details>`}
  </section>`;
}

const size = (bytes) => (bytes < 1000 ? `${bytes} B` : bytes < 1e6 ? `${(bytes / 1e3).toFixed(1)} kB` : `${(bytes / 1e6).toFixed(1)} MB`);

function Files({ guide }) {
  return html`<details class="card folder">
    <summary>Files in <code>${guide.folder}</code> (${guide.files.length})</summary>
    ${guide.files.length === 0 && html`<p class="soft">The steps write their files here.</p>`}
    ${guide.files.length > 0 &&
    html`<table class="list">
      <thead><tr><th>File</th><th>Kind</th><th class="number">Size</th><th>Changed</th></tr></thead>
      <tbody>${guide.files.map((f) => html`<tr key=${f.name}><td><${Download} name=${f.name} /></td><td>${f.kind}</td><td class="number">${size(f.bytes)}</td><td class="soft">${new Date(f.modified_s * 1000).toLocaleString()}</td></tr>`)}</tbody>
    </table>`}
    ${guide.files_left_out > 0 && html`<p class="soft">${guide.files_left_out} more files are not listed.</p>`}
  </details>`;
}
