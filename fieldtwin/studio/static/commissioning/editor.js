// The editor of a device profile: text with line numbers, checked by the server as it is typed, with errors at their lines.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import { get, post, put } from "../lib/api.js";
import { count } from "../lib/format.js";
import { Failure, useAction } from "../lib/parts.js";
import { isCan, newest } from "./steps.js";

const PAUSE_MS = 350;
const path = (name) => `/commissioning/drafts/${encodeURIComponent(name)}`;

/** The beginning of a CANopen profile: valid, with the one object that every node has. */
const firstProfile = (ctx, sheet) => `device: mysite/${ctx.name.toLowerCase()}
source: "the data sheet ${sheet}"
protocol: canopen
factory: {node: ${ctx.address}}
eds: ${sheet}
tags:
  error_register: {object: "1001:00", type: uint8}
  # Add the objects of your site, for example:
  # slope: {object: "6010:00", type: int16, scale: 0.01, unit: deg}
`;
const EMPTY = { name: "", text: "", saved: "", version: "", checked: null };

export const emptyDraft = EMPTY;

/** `draft` and `setDraft` belong to the page, so that another step does not discard unsaved text. */
export function Editor({ ctx, folder, draft, setDraft, mayOperate, onSaved }) {
  const [run, error, busy] = useAction();
  const [said, setSaid] = useState("");
  const area = useRef(null);
  const gutter = useRef(null);
  const names = ctx.files.filter((f) => f.kind === "profile").map((f) => f.name);
  const wanted = ctx.latest.infer?.form.out;
  const first = names.includes(wanted) ? wanted : names[0];
  const dirty = draft.text !== draft.saved;
  const open = (name) =>
    run(async () => {
      const got = await get(path(name));
      setDraft({ name, text: got.text, saved: got.text, version: got.version, checked: got.checked });
      setSaid("");
    });
  useEffect(() => {
    if (first && !dirty && (draft.name === "" || !names.includes(draft.name))) open(first);
  }, [first]);
  useEffect(() => {
    if (!draft.name || draft.text === draft.saved) return undefined;
    let current = true;
    const timer = setTimeout(() => {
      post(path(draft.name), { text: draft.text }).then(
        ({ checked }) => current && setDraft((d) => (d.text === draft.text ? { ...d, checked } : d)),
        () => {}, // saving reports what is wrong
      );
    }, PAUSE_MS);
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [draft.text]);
  const save = () =>
    run(async () => {
      const got = await put(path(draft.name), { text: draft.text, version: draft.version });
      setDraft((d) => ({ ...d, saved: draft.text, version: got.version, checked: d.text === draft.text ? got.checked : d.checked }));
      setSaid(got.checked.errors.length ? `Saved ${draft.name}, with errors.` : `Saved ${draft.name}.`);
      onSaved(draft.name, got.checked.errors.length === 0);
    });
  const keys = (e) => {
    if ((e.ctrlKey || e.metaKey) && e.key === "s") {
      e.preventDefault();
      if (mayOperate && dirty) save();
    }
  };
  const goTo = (line) => {
    const lines = draft.text.split("\n");
    const start = lines.slice(0, Math.max(0, line - 1)).join("\n").length + (line > 1 ? 1 : 0);
    area.current.focus();
    area.current.setSelectionRange(start, start + (lines[line - 1]?.length ?? 0));
    const height = parseFloat(getComputedStyle(area.current).lineHeight);
    area.current.scrollTop = Math.max(0, (line - 6) * height);
  };
  const sheet = isCan(ctx.endpoint) && newest(ctx, "data sheet");
  const begin = () =>
    run(async () => {
      await put(path(`${ctx.name}.yaml`), { text: firstProfile(ctx, sheet) });
      onSaved(`${ctx.name}.yaml`, true);
    });
  if (!names.length)
    return html`<${Failure} text=${error} />
      ${isCan(ctx.endpoint)
        ? html`${ctx.profile && html`<p>The known profile <strong>${ctx.profile}</strong> fits, so you need not make your own. Go on with the step Record.</p>`}
            <p class="soft">${sheet ? html`A profile of your own names the objects of <code>${sheet}</code> that your site uses.` : html`A profile of your own needs the EDS of the device: copy it into <code>${folder}</code>, and it is listed here.`}</p>
            ${sheet && mayOperate && html`<p class="bar"><button type="button" class="primary" disabled=${busy} onClick=${begin}>Begin a profile</button></p>`}`
        : html`<p class="empty">No profile yet: the step Infer writes one.</p>`}`;
  const errors = draft.checked?.errors ?? [];
  const bad = new Set(errors.map((e) => e.line));
  const lineCount = draft.text.split("\n").length;
  return html`
    <div class="bar">
      <label>Profile
        <select value=${draft.name} disabled=${dirty} title=${dirty ? "Save the changes first, or undo them." : ""} onChange=${(e) => open(e.target.value)}>
          ${names.map((n) => html`<option value=${n}>${n}</option>`)}
        </select>
      </label>
      <span class="grow"></span>
      <span role="status" class="soft">${dirty ? "not saved" : said}</span>
      ${dirty && html`<button type="button" disabled=${busy} onClick=${() => open(draft.name)}>Discard changes</button>`}
      ${mayOperate && html`<button type="button" class="primary" disabled=${busy || !dirty} onClick=${save}>Save</button>`}
    </div>
    <${Failure} text=${error} />
    <div class="editor">
      <div class="gutter" ref=${gutter} aria-hidden="true">
        ${Array.from({ length: lineCount }, (_, n) => html`<div class=${bad.has(n + 1) ? "bad" : ""}>${n + 1}</div>`)}
      </div>
      <textarea
        ref=${area}
        aria-label="Device profile"
        aria-invalid=${errors.length > 0}
        aria-describedby="draft-errors"
        wrap="off"
        spellcheck="false"
        autocapitalize="off"
        readonly=${!mayOperate}
        value=${draft.text}
        onInput=${(e) => setDraft((d) => ({ ...d, text: e.target.value }))}
        onScroll=${(e) => (gutter.current.scrollTop = e.target.scrollTop)}
        onKeyDown=${keys}
      ></textarea>
    </div>
    <div id="draft-errors" role="status">
      ${errors.length > 0 &&
      html`<ul class="problems">
        ${errors.map((e) => html`<li><button type="button" class="quiet" onClick=${() => goTo(e.line)}>line ${e.line}</button> ${e.message}</li>`)}
      </ul>`}
      ${draft.checked && !errors.length &&
      html`<p><span class="chip good">valid</span> ${draft.checked.device}, ${count(draft.checked.tags.length + draft.checked.tags_left_out, "tag")}</p>
        <details><summary>Tags</summary>
          <table class="list"><thead><tr><th>Tag</th><th>At</th><th>Type</th><th>Unit</th></tr></thead>
            <tbody>${draft.checked.tags.map((t) => html`<tr><td><strong>${t.name}</strong></td><td class="mono">${t.at}</td><td class="mono">${t.type}</td><td>${t.unit}</td></tr>`)}</tbody>
          </table>
        </details>`}
    </div>`;
}
