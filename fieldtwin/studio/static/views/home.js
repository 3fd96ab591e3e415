// All instances on this computer, and the systems whose prototype can be started.

import { html, useEffect } from "../vendor/preact.js";
import { address } from "../lib/address.js";
import { get, post, remove } from "../lib/api.js";
import { Failure, useAction, useFetched } from "../lib/parts.js";
import { PREFIX } from "../lib/trace_store.js";
import { Campaigns } from "./campaigns.js";

const AGAIN_MS = 2000;

export function Home() {
  const [instances, error, again] = useFetched(() => get("/instances"), []);
  const [systems] = useFetched(() => get("/systems"), []);
  const [traces, unread, look] = useFetched(() => get("/traces"), []);
  const [campaigns, unreadable, lookAgain] = useFetched(() => get("/campaigns"), []);
  const [run, failed, busy] = useAction();
  useEffect(() => {
    const timer = setInterval(() => (again(), look(), lookAgain()), AGAIN_MS);
    return () => clearInterval(timer);
  }, []);
  const start = (system) =>
    run(async () => {
      const { instance } = await post("/instances", { system });
      location.hash = address(instance);
    });
  const running = (instances ?? []).filter((i) => i.running);
  const finished = (instances ?? []).filter((i) => !i.running);
  return html`<main style=${{ maxWidth: "1100px", margin: "0 auto" }}>
    <h1 style=${{ margin: "14px 0 18px" }}>fieldtwin Studio</h1>
    <${Failure} text=${error || failed || unread || unreadable} />
    <h2>Running</h2>
    <div class="cards" style=${{ margin: "10px 0 26px" }}>
      ${running.map((i) => html`<${Card} instance=${i} run=${run} again=${again} />`)}
      ${instances && !running.length && html`<p class="soft">Nothing runs on this computer. Start a prototype below, or with <code>fieldtwin run</code>.</p>`}
    </div>
    ${traces?.length > 0 &&
    html`<h2>Traces of virtual runs</h2>
      <p class="soft">Runs that were recorded with <code>--trace</code>. Each is shown as of any instant.</p>
      <div class="cards traces">${traces.map((t) => html`<${TraceCard} trace=${t} key=${t.name} />`)}</div>`}
    ${campaigns?.length > 0 && html`<${Campaigns} ledgers=${campaigns} />`}
    <h2>Start a prototype</h2>
    <p class="soft">The devices of the system are simulated; no real device is touched. ${busy && "Starting …"}</p>
    <div class="cards" style=${{ margin: "10px 0 26px" }}>
      ${(systems ?? []).map(
        (s) =>
          html`<div class="card">
            <header><strong>${s.name}</strong><span class="chip">${s.shipped ? "shipped" : "in this folder"}</span></header>
            <button class="primary" disabled=${busy || running.some((i) => i.name === s.name)} onClick=${() => start(s.path)}>Start</button>
          </div>`,
      )}
    </div>
    <h2>Commission a device</h2>
    <p class="soft" style=${{ marginBottom: "26px" }}>
      The first hour with a real device, step by step: find it, read it, describe it, record it, emulate it. <a href="#/commissioning">Open the guide</a>
    </p>
    ${finished.length > 0 &&
    html`<h2>Finished</h2>
      <p class="soft">${finished.map((i) => i.name).join(", ")}</p>`}
  </main>`;
}

function Card({ instance: i, run, again }) {
  return html`<div class="card">
    <header>
      <a href=${address(i.name)}><strong>${i.name}</strong></a>
      <span class="chip ${i.mode === "plant" ? "warn" : "accent"}">${i.mode}${i.mode === "plant" ? (i.allow_writes ? ", writes allowed" : ", read-only") : ""}</span>
    </header>
    ${i.trouble ? html`<${Failure} text=${i.trouble} />` : html`<p class="soft mono">${i.path}</p>`}
    ${i.started_here && html`<button onClick=${() => run(() => remove(`/instances/${encodeURIComponent(i.name)}`)).then(again)}>Stop</button>`}
  </div>`;
}

const TONES = { passed: "good", failed: "bad", error: "bad" };

function TraceCard({ trace: t }) {
  return html`<div class="card">
    <header>
      <a href=${`#/${encodeURIComponent(PREFIX + t.name)}`}><strong>${t.title || t.name}</strong></a>
      <span class="chip ${TONES[t.verdict] ?? ""}">${t.growing ? "running or cut off" : t.verdict || "no description"}</span>
    </header>
    ${t.trouble ? html`<${Failure} text=${t.trouble} />` : html`<p class="soft">${t.system}${t.seed !== null && `, seed ${t.seed}`}</p>`}
    <p class="soft mono path">${t.path}</p>
  </div>`;
}
