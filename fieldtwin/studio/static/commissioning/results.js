// The results of the steps as tables. A result that has no table of its own is shown as text.

import { html } from "../vendor/preact.js";
import { count, hex, number } from "../lib/format.js";
import { asClient, isCan } from "./steps.js";

const Facts = ({ facts }) =>
  html`<dl class="facts">${Object.entries(facts).filter(([, v]) => v !== "" && v !== null && v !== undefined).map(([name, v]) => html`<dt>${name}</dt><dd>${v}</dd>`)}</dl>`;

const Table = ({ head, rows, empty }) =>
  rows.length
    ? html`<div class="scroll result"><table class="list">
        <thead><tr>${head.map((h) => html`<th>${h}</th>`)}</tr></thead>
        <tbody>${rows.map((row, n) => html`<tr key=${n}>${row.map((cell) => html`<td>${cell}</td>`)}</tr>`)}</tbody>
      </table></div>`
    : html`<p class="soft">${empty}</p>`;

const Chip = ({ tone, children }) => html`<span class="chip ${tone}">${children}</span>`;
const ms = (v) => (v === null || v === undefined ? "" : `${v.toFixed(1)} ms`);
const percent = (v) => `${(100 * v).toFixed(1)} %`;
const SURENESS = { certain: "good", likely: "accent", possible: "warn" };
const LEVEL = { certain: "good", likely: "accent", guess: "warn" };
const VERDICT = { passed: "good", failed: "bad" };

const Line = ({ r }) => html`
  <${Facts} facts=${r.facts} />
  <h3>${r.healthy ? "Possible causes of what was seen" : "Possible causes, the most likely first"}</h3>
  <${Table} head=${["Cause", "Because", "Try"]} rows=${r.causes.map((c) => [html`<strong>${c.name}</strong>`, c.why, c.remedy])} empty="Nothing looks wrong." />`;

const Scan = ({ r, ctx, use }) => {
  const units = r.units ?? [];
  const nodes = r.nodes ?? [];
  return html`
    ${r.stopped && html`<p><${Chip} tone="warn">stopped<//> The list is not complete.</p>`}
    ${(r.notes ?? []).map((note) => html`<p class="soft">${note}</p>`)}
    ${units.length > 0 &&
    html`<${Table}
      head=${["Unit", "Settings", "Answer", "After", ""]}
      rows=${units.map((u) => [u.unit, u.settings ?? "", u.exception === null ? "answers" : `exception ${u.exception}`, ms(u.latency_ms), use && html`<${Use} chosen=${ctx.address === u.unit && (u.settings ?? "") === (ctx.settings ?? "")} onUse=${() => use(u.unit, u.settings)} />`])}
    />`}
    ${nodes.length > 0 &&
    html`<${Table} head=${["Node", "State", ""]} rows=${nodes.map((n) => [n.node, n.state ?? "", use && html`<${Use} chosen=${ctx.address === n.node} onUse=${() => use(n.node, null)} />`])} />`}
    ${!units.length && !nodes.length &&
    html`<p>No device was found. ${isCan(ctx.endpoint) ? "Check the supply of the nodes, the bit rate, and the termination at both ends of the bus." : "Check the supply, swap A and B, and scan without the limit to likely settings."}</p>`}`;
};

const Use = ({ chosen, onUse }) => (chosen ? html`<${Chip} tone="good">in use<//>` : html`<button type="button" onClick=${onUse}>Use</button>`);

const Identify = ({ r }) => {
  const fits = r.candidates.filter((c) => c.sureness !== "ruled out");
  const out = r.candidates.length - fits.length;
  return html`<p><strong>${r.summary}</strong></p>
    <${Facts} facts=${stated(r)} />
    ${fits.length > 0 && html`<${Table} head=${["Profile", "Certainty", "Because"]} rows=${fits.map((c) => [html`<strong>${c.profile}</strong>`, html`<${Chip} tone=${SURENESS[c.sureness] ?? ""}>${c.sureness}<//>`, c.reasons.join("; ")])} />`}
    ${out > 0 &&
    html`<details><summary>${out} profiles are ruled out</summary>
      <${Table} head=${["Profile", "Because"]} rows=${r.candidates.filter((c) => c.sureness === "ruled out").map((c) => [c.profile, c.against.join("; ")])} />
    </details>`}`;
};

/** What a device may not have answered, by the names in `silence`. Reads of registers (03) are questions about profiles. */
const SILENT = { "2B": "identification", 11: "server id", sunspec: "SunSpec" };

/** What the device says about itself, and why it does not. */
function stated(r) {
  const id = r.identification ?? {};
  const { vendor, product, revision, serial } = r.identity ?? {};
  return {
    vendor: id[0] ?? vendor,
    "product code": id[1] ?? product,
    revision: id[2] ?? revision,
    name: r.name,
    serial,
    "server id": r.server_id && html`<span class="mono">${hex(r.server_id)}</span>`,
    conflict: r.conflict,
    ...Object.fromEntries(Object.entries(r.silence ?? {}).filter(([request]) => request !== "03").map(([request, why]) => [SILENT[request] ?? request, why])),
  };
}

const answering = (r) => (r.functions ?? []).filter((f) => f.hex !== undefined); // the others were refused, or silent

/** The registers in a state; of a CANopen node the number of objects, and the indexes of the readable ones. */
const listed = (map, state) => {
  const count = map[state]?.join(", ") ?? map.counts?.[state] ?? "";
  return state === "readable" && map.indexes ? `${count}: ${map.indexes.join(", ")}` : count;
};

const Dump = ({ r }) => html`
  <p>${r.values} values in ${r.passes} ${r.passes === 1 ? "pass" : "passes"}.</p>
  <${Table}
    head=${["Table", "Readable", "Refused", "Silent", "Not asked", "Longest read"]}
    rows=${(r.maps ?? []).map((m) => [html`<strong>${m.map}</strong>`, ...["readable", "refused", "silent", "not_asked"].map((state) => listed(m, state)), m.max_read ?? ""])}
    empty="Nothing was read."
  />
  ${answering(r).length > 0 && html`<h3>Functions that answer</h3><p class="mono">${answering(r).map((f) => `${f.function.toString(16).toUpperCase().padStart(2, "0")}h`).join(", ")}</p>`}`;

const Infer = ({ r }) => html`<${Table}
  head=${["At", "Type", "Last value", "Certainty", "Remarks"]}
  rows=${r.readings.map((x) => [
    html`<span class="mono">${x.at}</span>`,
    html`<span class="mono">${x.type}${x.registers > 1 ? ` ${x.order}` : ""}</span>`,
    html`<span class="mono">${number(x.last)}</span>`,
    html`<${Chip} tone=${LEVEL[x.level] ?? ""}>${x.level}${x.level === "certain" ? "" : `, ${Math.round(100 * x.probability)} %`}<//>`,
    [x.capped, ...(x.marks ?? []), ...(x.notes ?? []).map((n) => (typeof n === "string" ? n : JSON.stringify(n)))].filter(Boolean).join("; "),
  ])}
  empty="No register has a value that is not 0."
/>`;

const Record = ({ r }) => html`${r.notes.map((note) => html`<p>${note.charAt(0).toUpperCase()}${note.slice(1)}.</p>`)}<${Facts}
  facts=${{ recorded: `${count(r.exchanges ?? r.frames ?? 0, r.exchanges === undefined ? "frame" : "exchange")} in ${r.rounds === undefined ? `${r.seconds.toFixed(1)} s` : count(r.rounds, "round")}`, unanswered: r.unanswered, refused: r.refused, "rounds missed": r.missed_rounds, "connections lost": r.connections_lost }}
/>`;

const Compare = ({ r, job, ctx }) => html`
  <p><${Chip} tone=${r.inconclusive ? "warn" : r.met ? "good" : "bad"}>${r.inconclusive ? "inconclusive" : r.met ? "met" : "not met"}<//> ${r.alike} of ${r.compared} exchanges are equal: values ${percent(r.values ?? 0)}${r.timing === null || r.timing === undefined ? "" : `, timing ${percent(r.timing)}`}.</p>
  ${!r.met && isCan(job.form.endpoint) && ctx.emulator && asClient(ctx.emulator.form.on) === job.form.endpoint &&
  html`<p class="soft">An emulator gives each recorded value once. If it was read before, stop it and start it again, and compare once more.</p>`}
  ${r.latency?.length > 0 &&
  html`<${Table} head=${["Latency in ms", "n", "Recorded p50", "p90", "p99", "There p50", "p90", "p99"]} rows=${r.latency.map((l) => [l.service, l.count, ...[...l.recorded_s, ...l.other_s].map((s) => (1000 * s).toFixed(1))])} />`}
  ${r.differences?.length > 0 &&
  html`<h3>Differences</h3><${Table} head=${Object.keys(r.differences[0])} rows=${r.differences.slice(0, 50).map((d) => Object.entries(d).map(([name, v]) => (name === "t_s" ? v.toFixed(3) : typeof v === "object" ? JSON.stringify(v) : String(v))))} />
  ${r.differences.length > 50 && html`<p class="soft">${r.differences.length - 50} more are in the file.</p>`}`}`;

const Check = ({ r }) => {
  const shown = r.cases.filter((c) => c.verdict !== "skipped" && c.verdict !== "passed");
  const rest = r.cases.filter((c) => c.verdict === "passed");
  const rows = (cases) => cases.map((c) => [html`<span class="mono">${c.id}</span>`, html`<${Chip} tone=${VERDICT[c.verdict] ?? "warn"}>${c.verdict}<//>`, c.title, c.reason, c.clause]);
  const head = ["Case", "Verdict", "Test", "Result", "Clause"];
  return html`
    <p>${Object.entries(r.counts).map(([verdict, count]) => `${count} ${verdict}`).join(", ")}.${r.counts.failed ? ` The standard requires what ${r.findings.standard} of the failed cases ask.` : ""}</p>
    <${Table} head=${head} rows=${rows(shown)} empty="No case failed." />
    <details><summary>${rest.length} passed</summary><${Table} head=${head} rows=${rows(rest)} empty="" /></details>`;
};

const Report = ({ r, job }) => html`
  <p>${r.devices.length} ${r.devices.length === 1 ? "device" : "devices"}, ${r.deviations.length} findings. Open the document, print it, and sign it: <${Download} name=${job.form.out} /></p>
  <${Table} head=${["Where", "What", "Expected", "Found", "Weight"]} rows=${r.deviations.map((d) => [html`<span class="mono">${d.where}</span>`, d.what, d.expected, d.found, d.weight])} empty="No deviation." />`;

export const Download = ({ name }) => html`<a href=${`/api/v1/commissioning/files/${encodeURIComponent(name)}`} download=${name}>${name}</a>`;

const VIEWS = { line: Line, scan: Scan, identify: Identify, dump: Dump, infer: Infer, record: Record, compare: Compare, check: Check, report: Report };

/** The result of a finished job. `use` takes over a device that the scan has found; null if the role may not. */
export function Result({ job, ctx, use }) {
  const View = VIEWS[job.step];
  if (!View || !job.result) return null;
  return html`<${View} r=${job.result} job=${job} ctx=${ctx} use=${use} />`;
}
