// All instances on this computer, and the systems whose prototype can be started.

import { html, useEffect } from "../vendor/preact.js";
import { get, post, remove } from "../lib/api.js";
import { Failure, useAction, useFetched } from "../lib/parts.js";

const AGAIN_MS = 2000;

export function Home() {
  const [instances, error, again] = useFetched(() => get("/instances"), []);
  const [systems] = useFetched(() => get("/systems"), []);
  const [run, failed, busy] = useAction();
  useEffect(() => {
    const timer = setInterval(again, AGAIN_MS);
    return () => clearInterval(timer);
  }, []);
  const start = (system) =>
    run(async () => {
      const { instance } = await post("/instances", { system });
      location.hash = `#/${encodeURIComponent(instance)}`;
    });
  const running = (instances ?? []).filter((i) => i.running);
  const finished = (instances ?? []).filter((i) => !i.running);
  return html`<main style=${{ maxWidth: "1100px", margin: "0 auto" }}>
    <h1 style=${{ margin: "14px 0 18px" }}>fieldtwin Studio</h1>
    <${Failure} text=${error || failed} />
    <h2>Running</h2>
    <div class="cards" style=${{ margin: "10px 0 26px" }}>
      ${running.map((i) => html`<${Card} instance=${i} run=${run} again=${again} />`)}
      ${instances && !running.length && html`<p class="soft">Nothing runs on this computer. Start a prototype below, or with <code>fieldtwin run</code>.</p>`}
    </div>
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
    ${finished.length > 0 &&
    html`<h2>Finished</h2>
      <p class="soft">${finished.map((i) => i.name).join(", ")}</p>`}
  </main>`;
}

function Card({ instance: i, run, again }) {
  return html`<div class="card">
    <header>
      <a href=${`#/${encodeURIComponent(i.name)}`}><strong>${i.name}</strong></a>
      <span class="chip ${i.mode === "plant" ? "warn" : "accent"}">${i.mode}${i.mode === "plant" ? (i.allow_writes ? ", writes allowed" : ", read-only") : ""}</span>
    </header>
    ${i.trouble ? html`<${Failure} text=${i.trouble} />` : html`<p class="soft mono">${i.path}</p>`}
    ${i.started_here && html`<button onClick=${() => run(() => remove(`/instances/${encodeURIComponent(i.name)}`)).then(again)}>Stop</button>`}
  </div>`;
}
