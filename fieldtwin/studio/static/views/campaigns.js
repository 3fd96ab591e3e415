// The campaigns of many seeds whose ledgers are in the working directory, as they grow.

import { html } from "../vendor/preact.js";
import { url } from "../lib/api.js";
import { Failure } from "../lib/parts.js";

const small = new Intl.NumberFormat("en", { maximumFractionDigits: 1 });
const large = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const number = { format: (value) => (value < 100 ? small : large).format(value) };

export function Campaigns({ ledgers }) {
  return html`<h2>Campaigns</h2>
    <p class="soft">Runs with many seeds, from ledgers that <code>fieldtwin simulate --seeds … --ledger FILE</code> writes.</p>
    <div class="cards campaigns">${ledgers.map((ledger) => html`<${Ledger} ledger=${ledger} key=${ledger.name} />`)}</div>`;
}

function Ledger({ ledger }) {
  return html`<div class="card">
    ${ledger.trouble && html`<${Failure} text=${ledger.trouble} />`}
    ${ledger.campaigns.map((campaign) => html`<${Campaign} campaign=${campaign} key=${campaign.what + campaign.version} />`)}
    <p class="soft mono path">${ledger.path}</p>
    ${!ledger.trouble && html`<a href=${url(`/campaigns/${encodeURIComponent(ledger.name)}/report`)} target="_blank" rel="noopener">Report</a>`}
  </div>`;
}

function Campaign({ campaign: c }) {
  const facts = [`${number.format(c.runs)} ${c.runs === 1 ? "run" : "runs"}`, `${number.format(c.hours)} virtual hours`];
  if (c.hours_per_hour !== null) facts.push(`${number.format(c.hours_per_hour)} per hour`);
  if (c.workers) facts.push(`${c.workers} ${c.workers === 1 ? "worker" : "workers"}`);
  return html`<header>
      <strong>${c.title}</strong>
      <span>
        ${c.running && html`<span class="chip accent">running</span> `}
        <span class="chip ${c.failed ? "bad" : c.verdict === "passed" ? "good" : "warn"}">${c.failed ? `${number.format(c.failed)} failed` : c.verdict}</span>
      </span>
    </header>
    <p>${facts.join(", ")}</p>
    <${Bars} passed=${c.passed_over_time} failed=${c.failed_over_time} />
    ${c.causes.map(
      (g) => html`<p class="cause">${g.cause} <span class="soft">${g.runs === 1 ? `seed ${g.seed}` : `${g.runs} runs, such as seed ${g.seed}`}</span></p>`,
    )}
    ${c.more_causes > 0 && html`<p class="soft">and ${c.more_causes} more causes</p>`}`;
}

// The runs that ended in equal parts of the wall time; failed ones at the bottom.
function Bars({ passed, failed }) {
  if (!passed.length) return null;
  const most = Math.max(...passed.map((n, i) => n + failed[i]), 1);
  const bar = (count, below, i, kind) => {
    const height = count && Math.max((count / most) * 40, kind === "bad" ? 3 : 1);
    return count > 0 && html`<rect class=${kind} x=${i} y=${40 - below - height} width="0.8" height=${height} />`;
  };
  return html`<svg class="bars" viewBox=${`0 0 ${passed.length} 40`} preserveAspectRatio="none" role="img" aria-label="Runs that ended over wall time">
    ${passed.map((n, i) => {
      const below = failed[i] && Math.max((failed[i] / most) * 40, 3);
      return html`${bar(failed[i], 0, i, "bad")}${bar(n, below, i, "good")}`;
    })}
  </svg>`;
}
