// The source of a program, with the present values of the variables in each line.

import { html, useMemo } from "../vendor/preact.js";

const MOST_LINES = 3000;

export function Source({ store, name }) {
  const about = store.programs[name];
  const source = about?.source;
  const lines = useMemo(() => (source?.text ? variablesByLine(source, about.variables) : []), [source]);
  if (!source) return null;
  return html`<section class="card source" aria-label="Source of ${name}">
    <header><h2>Source of ${name}</h2><span class="soft"><span class="mono">${source.file}</span> · ${source.language}</span></header>
    ${!source.text && html`<p class="soft">The text is not shown: ${source.reason}.</p>`}
    ${source.text &&
    html`<div class="scroll code" role="group" tabindex="0" aria-label="Text of ${source.file}">
      <table>
        <tbody>
          ${lines.map(
            ([text, names], n) => html`<tr key=${n}>
              <td class="n">${n + 1}</td><td class="text">${text}</td>
              <td class="values">${names.map((v) => html`<span key=${v}>${v} = <b>${store.word(name, v, store.variable(name, v))}</b></span>`)}</td>
            </tr>`,
          )}
        </tbody>
      </table>
    </div>`}
  </section>`;
}

/** Each line with the names of the program's variables that occur in it, without those in comments and in texts. */
function variablesByLine(source, variables) {
  const python = source.language === "Python";
  const known = new Map(
    Object.entries(variables)
      .filter(([, v]) => v.kind !== "message")
      .map(([name]) => [python ? name : name.toLowerCase(), name]),
  );
  return withoutComments(source.text, python).map(([text, code]) => {
    const names = new Set();
    for (const [word] of code.matchAll(/[A-Za-z_]\w*/g)) {
      const name = known.get(python ? word : word.toLowerCase());
      if (name) names.add(name);
    }
    return [text, [...names]];
  });
}

/** The lines of a text, each as [text, text without comments and strings]. */
function withoutComments(text, python) {
  const pattern = python ? /("""[^]*?"""|'''[^]*?'''|"[^"\n]*"|'[^'\n]*'|#[^\n]*)/g : /(\(\*[^]*?\*\)|\/\*[^]*?\*\/|\/\/[^\n]*|'[^'\n]*'|"[^"\n]*")/g;
  const code = text.replace(pattern, (found) => found.replace(/[^\n]/g, " ")).split("\n");
  return text.split("\n", MOST_LINES).map((line, n) => [line.replace(/\r$/, ""), code[n]]);
}
