// Shadows and twins of the instance: the digital model beside the plant, the digital thread, decisions, and what-if questions.

import { html, useEffect, useState } from "../vendor/preact.js";
import { get } from "../lib/api.js";
import { age, number, reason } from "../lib/format.js";
import { Copyable, Failure, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";
import { WhatIf } from "./twin_what_if.js";

const LOOK_EVERY_MS = 1000;

export function Twin({ store }) {
  useStore(store);
  const [found, error, again] = useFetched(() => get(`${store.path}/twins`), [store.path]);
  const [chosen, setChosen] = useState("");
  useEffect(() => {
    const timer = setInterval(again, LOOK_EVERY_MS);
    return () => clearInterval(timer);
  }, []);
  const followers = found?.followers ?? [];
  const key = (f) => `${f.kind} ${f.instance}`;
  const follower = followers.find((f) => key(f) === chosen) ?? followers[0];
  return html`<h1 class="visually-hidden">Twin</h1>
    <${Failure} text=${error} />
    ${!found && !error && html`<p class="empty">Looking for shadows and twins …</p>`}
    ${followers.length > 1 &&
    html`<div class="bar">
      <label>Shadow or twin
        <select value=${key(follower)} onChange=${(e) => setChosen(e.target.value)}>
          ${followers.map((f) => html`<option key=${key(f)} value=${key(f)}>${f.kind} ${f.instance}</option>`)}
        </select>
      </label>
    </div>`}
    ${follower && html`<${Follower} store=${store} follower=${follower} thread=${found.plant_thread} key=${key(follower)} />`}
    ${found && !follower && html`<${Start} commands=${found.start} thread=${found.plant_thread} />`}
    <${WhatIf} store=${store} />`;
}

/** How to start a shadow or a twin, with command lines that can be copied. */
function Start({ commands, thread }) {
  return html`<section class="card">
    <header><h2>No shadow or twin of this instance runs on this computer</h2></header>
    <p class="soft">
      ${thread
        ? `The plant offers its digital thread at ${thread.place}. Start one of these in another terminal; this view then shows it.`
        : "This run has no digital thread. Stop it, and start it again with one; then start a shadow or a twin in another terminal."}
    </p>
    ${commands.map(({ text, command }) => html`<h3 key=${text}>${text}</h3><${Copyable} text=${command} />`)}
  </section>`;
}

function Follower({ store, follower, thread }) {
  const { status } = follower;
  if (!status)
    return html`<${Failure} text=${`The ${follower.kind} ${follower.instance} does not answer: ${follower.trouble}`} />`;
  return html`${follower.is_of_instance === false &&
    html`<p class="error" role="alert">This ${follower.kind} follows another plant of the same system: ${status.origins.join(", ")}. Its model is not that of this instance.</p>`}
    <div class="cards twin">
      <${Model} store=${store} follower=${follower} />
      <${Thread} status=${status} thread=${thread} />
      <${Commands} status=${status} />
    </div>
    <div class="columns twin">
      <${Variables} follower=${follower} />
      <${Decisions} status=${status} />
    </div>`;
}

function Model({ store, follower }) {
  const { status } = follower;
  const machines = Object.keys(store.programs).filter((name) => store.programs[name].machine);
  const states = machines.map((name) => [name, store.variable(name, "state") === undefined ? "no answer" : store.word(name, "state", store.variable(name, "state"))]);
  const different = states.filter(([, state]) => state !== status.state);
  return html`<section class="card" aria-label="Model">
    <header>
      <h2>${follower.kind === "twin" ? "Digital twin" : "Digital shadow"}</h2>
      <span class="chip ${different.length ? "warn" : "good"}">${different.length ? "states differ" : "states agree"}</span>
    </header>
    <dl class="facts">
      <dt>Model</dt><dd><strong>${status.state}</strong>, period ${status.period_s} s</dd>
      ${states.map(([name, state]) => html`<dt>Plant, ${name}</dt><dd><strong>${state}</strong></dd>`)}
      <dt>Statuses</dt><dd>${status.agreed} of ${status.statuses} agree</dd>
      <dt>Twinning</dt>
      <dd>
        ${status.twinning_rate_hz ? `${status.twinning_rate_hz.toFixed(1)} reports/s` : "too few reports"}
      </dd>
      <dt>Lag</dt><dd>${status.lag_ms ? `${lag(status.lag_ms.median)} median, ${lag(status.lag_ms.p95)} p95` : "unknown"}</dd>
      <dt>Instance</dt><dd class="mono">${follower.instance}</dd>
    </dl>
  </section>`;
}

const lag = (ms) => (ms < 1000 ? `${ms} ms` : `${(ms / 1000).toFixed(1)} s`);

function Thread({ status, thread }) {
  const end = status.thread;
  const connected = end?.connected ?? false;
  const received = Object.entries(end?.received ?? {});
  const ours = thread ? received.filter(([origin]) => origin === thread.origin) : received;
  const lost = received.reduce((sum, [, log]) => sum + log.lost, 0);
  return html`<section class="card" aria-label="Digital thread">
    <header>
      <h2>Digital thread</h2>
      <span class="chip ${connected ? "good" : "bad"}">${connected ? "connected" : "not connected"}</span>
    </header>
    ${(end?.trouble || end?.silent || status.store_trouble) && html`<${Failure} text=${[end.trouble, end.silent, status.store_trouble].filter(Boolean).join("; ")} />`}
    <dl class="facts">
      <dt>${connected ? "Connected" : "Not connected"}</dt><dd>${end?.since_ms ? `since ${time(end.since_ms)}, ${age((status.now_ms - end.since_ms) / 1000)}` : "no attempt yet"}</dd>
      <dt>Backlog</dt><dd>${backlog(status, thread)}</dd>
      <dt>Last number</dt>
      <dd>${ours.map(([, log]) => log.through).join(", ") || "none"} received${thread ? ` of ${thread.written} written by the plant` : ""}</dd>
      <dt>Lost</dt><dd>${lost + (thread?.dropped ?? 0)} events${end?.duplicates ? `; ${end.duplicates} came twice` : ""}</dd>
      <dt>Place</dt><dd class="mono">${status.place}</dd>
    </dl>
  </section>`;
}

function backlog(status, thread) {
  const there = thread ? `${thread.waiting} events of the plant` : "unknown at the plant";
  return status.commands ? `${there}, ${status.commands.unconfirmed} commands of the twin` : there;
}

function Commands({ status }) {
  const { commands } = status;
  if (!commands)
    return html`<section class="card" aria-label="Commands">
      <header><h2>Commands</h2></header>
      <p class="soft">A shadow sends no commands. It has no object that could.</p>
      <${Wrong} status=${status} />
    </section>`;
  return html`<section class="card" aria-label="Commands">
    <header><h2>Commands</h2></header>
    <dl class="facts">
      <dt>Planned</dt><dd>${commands.planned}, ${commands.simulated} simulated first</dd>
      <dt>Sent</dt><dd>${commands.sent}</dd>
      <dt>Refused</dt><dd>${commands.refused}${commands.refused_by_plant ? `, and ${commands.refused_by_plant} by the plant` : ""}</dd>
      <dt>Unconfirmed</dt><dd>${commands.unconfirmed}</dd>
    </dl>
    <${Wrong} status=${status} />
  </section>`;
}

const Wrong = ({ status }) => {
  const wrong = Object.entries(status.wrong);
  return html`<p class="wrong">
    ${wrong.length ? html`<strong>Wrong now:</strong> ${wrong.map(([name, what]) => `${name} (${what.join(", ")})`).join(", ")}` : html`<span class="soft">Analyze finds nothing wrong now.</span>`}
  </p>`;
};

const LONGEST_TEXT = 8; // of a message's bytes in hexadecimal
// Reasons of a verdict that may last have a line of their own. Those of changes that are on the way would move the rows all the time.
const STAYS = ["deviates", "unknown"];
const VERDICTS = { agrees: "good", deviates: "bad", "on the way": "accent", unknown: "" };

function Variables({ follower }) {
  const [only, setOnly] = useState(false);
  const { variables } = follower;
  const shown = variables.filter((v) => !only || v.verdict === "deviates");
  const count = variables.filter((v) => v.verdict === "deviates").length;
  return html`<section aria-label="Variables">
    <div class="bar">
      <h2>Model and plant</h2>
      <span class="grow"></span>
      <span class="soft">${count ? `${count} of ${variables.length} deviate` : `none of ${variables.length} deviates`}</span>
      <label><input type="checkbox" checked=${only} onChange=${(e) => setOnly(e.target.checked)} /> only deviations</label>
    </div>
    <div class="scroll short" role="group" tabindex="0" aria-label="Variables of the model and the plant">
      <table class="list variables">
        <thead>
          <tr><th>Variable</th><th class="number">Model</th><th class="number">Plant</th><th class="number">Difference</th><th class="number">Age</th><th>Verdict</th></tr>
        </thead>
        <tbody>
          ${shown.map(
            (v) => html`<tr key=${v.name} data-variable=${v.name}>
              <td>${v.name} <span class="soft">${v.unit}</span>${STAYS.includes(v.verdict) && v.reason && html`<div class="soft">${v.reason}</div>`}</td>
              <td class="number">${held(v.model, v.model_quality, v.model_reason)}</td>
              <td class="number">${v.plant_quality === null ? "–" : held(v.plant, v.plant_quality, v.plant_reason)}</td>
              <td class="number">${v.difference === null ? "" : number(v.difference)}</td>
              <td class="number">${age(v.model_age_s)}</td>
              <td class="verdict"><span class="chip ${VERDICTS[v.verdict]}" title=${v.reason}>${v.verdict}</span></td>
            </tr>`,
          )}
        </tbody>
      </table>
      ${!shown.length && html`<p class="empty">${only ? "Nothing deviates." : "The model declares no variable."}</p>`}
    </div>
  </section>`;
}

/** A value; for one that is not good its quality, with the reason as a title. */
function held(value, quality, why) {
  if (typeof value === "string" && value.length > LONGEST_TEXT) return html`<span title=${value}>${value.slice(0, LONGEST_TEXT)}…</span>`;
  if (quality === "good") return number(value);
  return html`<span class="bad-text" title=${reason(why)}>${value === null ? quality : `${number(value)} (${quality})`}</span>`;
}

const OUTCOMES = { sent: "good", refused: "bad", waiting: "accent", simulating: "accent" };

function Decisions({ status }) {
  const [only, setOnly] = useState(false);
  const shown = status.decisions.filter((d) => !only || d.plan || d.outcome === "refused").reverse();
  return html`<section aria-label="Decisions">
    <div class="bar">
      <h2>Decisions</h2>
      <span class="grow"></span>
      <label><input type="checkbox" checked=${only} onChange=${(e) => setOnly(e.target.checked)} /> only commands</label>
    </div>
    <div class="scroll short" role="group" tabindex="0" aria-label="Decisions, newest first">
      <table class="list decisions">
        <thead><tr><th>Time</th><th>Observed</th><th>Plan and outcome</th></tr></thead>
        <tbody>
          ${shown.map(
            (d) => html`<tr key=${d.number}>
              <td class="mono">${time(d.t_ms)}</td>
              <td>${d.finding}: ${d.subject && !d.observed.startsWith(d.subject) ? `${d.subject} ` : ""}${d.observed}</td>
              <td>
                ${d.outcome === "observed"
                  ? html`<span class="soft">${d.reason || "nothing planned"}</span>`
                  : html`${d.plan && html`<strong>${d.plan}</strong> `}<span class="chip ${OUTCOMES[d.outcome]}">${d.outcome}</span>
                      <div class="soft">${d.reason}</div>`}
              </td>
            </tr>`,
          )}
        </tbody>
      </table>
      ${!shown.length && html`<p class="empty">${only ? "No command was planned." : "Nothing was found yet."}</p>`}
    </div>
    ${status.decided > status.decisions.length && html`<p class="soft">The newest ${status.decisions.length} of ${status.decided} are shown.</p>`}
  </section>`;
}

/** A UTC time in ms as the time of day of this computer. */
const time = (ms) => new Date(ms).toLocaleTimeString("en-GB");
