// The form of a step: one control for each field, and the command line that the form means.

import { html, useEffect, useState } from "../vendor/preact.js";
import { post } from "../lib/api.js";
import { Copyable } from "../lib/parts.js";

const PAUSE_MS = 150;

/** The values of a form: what the user has entered, else the defaults. */
export const valuesOf = (fields, entered) => Object.fromEntries(fields.map((f) => [f.name, valid(f, entered?.[f.name]) ?? f.value]));

function valid(field, value) {
  if (field.kind === "select" && value !== undefined && !field.options.includes(value) && !(field.none && value === "")) return undefined;
  if (field.kind === "files" && value !== undefined) return value.filter((name) => field.options.includes(name));
  return value;
}

export function Fields({ fields, values, disabled, onChange }) {
  return html`<div class="fields">${fields.map((f) => html`<${Field} key=${f.name} field=${f} value=${values[f.name]} disabled=${disabled} onChange=${(v) => onChange(f.name, v)} />`)}</div>`;
}

function Field({ field: f, value, disabled, onChange }) {
  const id = `field-${f.name}`;
  const hint = f.hint && html`<small class="soft" id=${`${id}-hint`}>${f.hint}</small>`;
  if (f.kind === "check")
    return html`<div class="tick">
      <label><input type="checkbox" name=${f.name} checked=${value} disabled=${disabled} onChange=${(e) => onChange(e.target.checked)} /> ${f.label}</label>${hint}
    </div>`;
  if (f.kind === "files")
    return html`<fieldset class="files"><legend>${f.label}</legend>
      ${f.options.length === 0 && html`<p class="soft">${f.missing}</p>`}
      ${f.options.map(
        (name) => html`<label><input type="checkbox" checked=${value.includes(name)} disabled=${disabled} onChange=${(e) => onChange(e.target.checked ? [...value, name] : value.filter((n) => n !== name))} /> ${name}</label>`,
      )}
    </fieldset>`;
  return html`<div class="field-row">
    <label for=${id}>${f.label}</label>
    <span>
      ${f.kind === "select"
        ? f.options.length || f.none
          ? html`<select id=${id} name=${f.name} value=${value} disabled=${disabled} onChange=${(e) => onChange(e.target.value)}>
              ${(f.none || !value) && html`<option value="">${f.none}</option>`}${f.options.map((o) => html`<option value=${o}>${o}</option>`)}
            </select>`
          : html`<span class="soft">${f.missing}</span>`
        : html`<input id=${id} name=${f.name} type=${f.kind === "number" ? "number" : "text"} min=${f.min} max=${f.max} step=${f.step} placeholder=${f.placeholder}
            class=${f.kind === "number" ? "short" : ""} required=${f.kind === "out" || f.kind === "number"} spellcheck="false" autocapitalize="off" autocomplete="off"
            aria-describedby=${f.hint ? `${id}-hint` : null} disabled=${disabled} value=${value} onInput=${(e) => onChange(e.target.value)} />`}
      ${f.unit && html` <span class="soft">${f.unit}</span>`} ${hint}
    </span>
  </div>`;
}

/** The command line of a request, from the server; null for a form that is not filled in: [text, what is wrong with the form]. */
export function useCommand(request) {
  const key = JSON.stringify(request);
  const [shown, setShown] = useState({ text: "", problem: "" });
  useEffect(() => {
    if (!request) {
      setShown({ text: "", problem: "" });
      return undefined;
    }
    let current = true;
    const timer = setTimeout(() => {
      post("/commissioning/command", { step: request }).then(
        (got) => current && setShown({ text: got.command, problem: got.problem }),
        (e) => current && setShown({ text: "", problem: e.message }),
      );
    }, PAUSE_MS);
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [key]);
  return [shown.text, shown.problem];
}

export const CommandLine = ({ text }) => html`<div class="command"><h3>The same on the command line</h3><${Copyable} text=${text} id="command-line" /></div>`;
