// The first step of the guide: the port of the device, or an emulated device to practise with.

import { html, useState } from "../vendor/preact.js";
import { post, remove } from "../lib/api.js";
import { Failure, useAction } from "../lib/parts.js";
import { asClient, PRACTICE } from "./steps.js";

const KNOWN = /^(rtu|ascii|tcp|rtu\+tcp|udp|tls|can):.+/;

export function PortStep({ ctx, guide, change, mayOperate, again }) {
  const [chosen, setChosen] = useState(guide.profiles.some((p) => p.name === "ctd-reference") ? "ctd-reference" : guide.profiles[0]?.name);
  const [run, error, busy] = useAction();
  const choose = (endpoint) => change({ endpoint: endpoint.trim(), settings: null });
  const practise = () =>
    run(async () => {
      const on = PRACTICE[guide.profiles.find((p) => p.name === chosen).protocol];
      await post("/commissioning/jobs", { step: { step: "emulate", what: chosen, on } });
      change({ endpoint: asClient(on), settings: null, name: "practice" });
      again();
    });
  const stop = () => run(() => remove(`/commissioning/jobs/${ctx.practice.number}`));
  const answers = ctx.practice?.lines.some((line) => /^(units|node) /.test(line));
  const odd = ctx.endpoint && !KNOWN.test(ctx.endpoint);
  return html`
    <div class="fields">
      ${guide.ports.length > 0 &&
      html`<div class="field-row">
        <span>Serial ports</span>
        <span class="bar ports">${guide.ports.map((p) => html`<button type="button" disabled=${!mayOperate} aria-pressed=${ctx.endpoint === `rtu:${p}`} onClick=${() => choose(`rtu:${p}`)}>${p}</button>`)}</span>
      </div>`}
      <div class="field-row">
        <label for="field-endpoint">Endpoint</label>
        <span>
          <input id="field-endpoint" name="endpoint" spellcheck="false" autocapitalize="off" autocomplete="off" disabled=${!mayOperate} value=${ctx.endpoint}
            placeholder="rtu:/dev/ttyUSB0" aria-invalid=${Boolean(odd)} aria-describedby="endpoint-hint" onInput=${(e) => choose(e.target.value)} />
          <small class="soft" id="endpoint-hint"><code>rtu:/dev/ttyUSB0</code>, <code>rtu:COM5</code>, <code>tcp://192.168.0.7:502</code>, <code>can:socketcan/can0</code>. Leave baud rate and frame open if you do not know them.</small>
        </span>
      </div>
      <div class="field-row">
        <label for="field-name">Device name</label>
        <span><input id="field-name" name="name" maxlength="40" pattern="[A-Za-z0-9_][A-Za-z0-9_.\\-]*" disabled=${!mayOperate} value=${ctx.name} onInput=${(e) => change({ name: e.target.value.trim() })} />
          <small class="soft">The files begin with it: <code>${ctx.name}-dump.jsonl</code></small></span>
      </div>
    </div>
    ${odd && html`<${Failure} text="An endpoint begins with rtu:, ascii:, tcp://, udp://, tls://, rtu+tcp:// or can:" />`}
    ${guide.profiles.length > 0 &&
    html`<section class="practice">
      <h2>No device at hand?</h2>
      <p class="soft">Practise with an emulated device: a shipped profile answers on a virtual serial port or a software CAN bus of this computer.</p>
      <${Failure} text=${error || ctx.practiceFailed} />
      ${ctx.practice
        ? html`<p class="bar" role="status"><span class="chip ${answers ? "good" : "accent"}">${answers ? "running" : "starting"}</span>
            <span><strong>${ctx.practice.form.what}</strong> ${answers ? html`answers on <code>${asClient(ctx.practice.form.on)}</code>.` : "will answer in a moment."}</span>
            ${mayOperate && html`<button type="button" disabled=${busy} onClick=${stop}>Stop it</button>`}</p>`
        : mayOperate &&
          html`<p class="bar">
            <label>Device <select value=${chosen} onChange=${(e) => setChosen(e.target.value)}>${guide.profiles.map((p) => html`<option value=${p.name}>${p.device}</option>`)}</select></label>
            <button type="button" disabled=${busy} onClick=${practise}>Practise with an emulated device</button>
          </p>`}
    </section>`}`;
}
