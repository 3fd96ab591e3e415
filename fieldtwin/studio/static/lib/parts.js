// Parts that several views share.

import { html, useEffect, useRef, useState } from "../vendor/preact.js";
import { reason } from "./format.js";

export const Quality = ({ quality, why }) =>
  html`<span class="chip ${quality}" title=${reason(why)}>${quality}${why && why !== "none" ? `: ${reason(why)}` : ""}</span>`;

export const Failure = ({ text }) => (text ? html`<p class="error" role="alert">${text}</p>` : null);

/** The number of changes that Studio could not record, because the gateway had already dropped them. */
export const ChangesLost = ({ store }) => {
  const lost = store.status?.changes_lost ?? 0;
  return lost > 0 ? html`<span class="chip warn" title="The gateway dropped them before Studio read them">${lost} changes lost</span>` : null;
};

/** Run an action and keep its error for display: [run, error, busy]. */
export function useAction() {
  const [error, setError] = useState("");
  const [busy, setBusy] = useState(false);
  const run = async (action) => {
    setBusy(true);
    setError("");
    try {
      return await action();
    } catch (e) {
      setError(e.message);
      return undefined;
    } finally {
      setBusy(false);
    }
  };
  return [run, error, busy];
}

/** Fetch something when `keys` change: [result, error, fetch again]. */
export function useFetched(fetcher, keys) {
  const [state, setState] = useState({ result: null, error: "" });
  const [round, setRound] = useState(0);
  useEffect(() => {
    let current = true;
    fetcher().then(
      (result) => current && setState({ result, error: "" }),
      (e) => current && setState({ result: null, error: e.message }),
    );
    return () => (current = false);
  }, [...keys, round]);
  return [state.result, state.error, () => setRound((n) => n + 1)];
}

/** A modal dialog; Escape and Cancel close it. Afterwards the element that opened it has the focus again. */
export function Dialog({ title, onClose, children }) {
  const ref = useRef(null);
  const removed = useRef(false);
  useEffect(() => {
    const dialog = ref.current;
    dialog.showModal();
    return () => {
      removed.current = true;
      dialog.close(); // the browser returns the focus only from a dialog that is closed, not from one that is removed
    };
  }, []);
  return html`<dialog ref=${ref} onClose=${() => removed.current || onClose()} aria-label=${title}>
    <h2>${title}</h2>
    ${children}
  </dialog>`;
}

/** Ask for a number and send it. `above` and `below` are drawn around the field; `below` gets null while the text is no number. */
export function NumberDialog({ title, label, first = "", unit, action, danger, send, above, below, onClose }) {
  const [text, setText] = useState(first);
  const [run, error, busy] = useAction();
  const entered = Number(text.replace(",", "."));
  const wanted = text.trim() !== "" && Number.isFinite(entered) ? entered : null;
  const submit = async (e) => {
    e.preventDefault();
    if (await run(() => send(wanted))) onClose();
  };
  return html`<${Dialog} title=${title} onClose=${onClose}>
    <form onSubmit=${submit}>
      ${above}
      <${Failure} text=${error} />
      <label>${label} <input autofocus value=${text} onInput=${(e) => setText(e.target.value)} inputmode="decimal" /> ${unit}</label>
      ${below(wanted)}
      <footer>
        <button type="button" onClick=${onClose}>Cancel</button>
        <button class=${danger ? "danger" : "primary"} disabled=${wanted === null || busy}>${action}</button>
      </footer>
    </form>
  <//>`;
}

/** The values of the last minute as a small line; times without a good value are shaded. */
export function Sparkline({ points, now, width = 110, height = 22 }) {
  if (!points?.length) return html`<svg class="spark" width=${width} height=${height} aria-hidden="true"></svg>`;
  const span = 60e9;
  const x = (t) => Math.max(0, width * (1 - (now - t) / span));
  const numbers = points.filter((p) => p[1] !== null).map((p) => p[1]);
  const low = Math.min(...numbers);
  const high = Math.max(...numbers);
  const y = (v) => (high === low ? height / 2 : height - 2 - ((v - low) / (high - low)) * (height - 4));
  let path = "";
  const gaps = [];
  points.forEach(([t, v], n) => {
    const end = x(n + 1 < points.length ? points[n + 1][0] : now);
    if (v === null) gaps.push(html`<rect class="gap" x=${x(t)} y="0" width=${Math.max(1, end - x(t))} height=${height} />`);
    else path += `${path && points[n - 1]?.[1] !== null ? "L" : "M"}${x(t).toFixed(1)},${y(v).toFixed(1)}L${end.toFixed(1)},${y(v).toFixed(1)}`;
  });
  return html`<svg class="spark" width=${width} height=${height} aria-hidden="true">${gaps}<path d=${path} /></svg>`;
}

/** A command line with a button that copies it. */
export function Copyable({ text, id }) {
  const shown = useRef(null);
  const [copied, setCopied] = useState(false);
  useEffect(() => setCopied(false), [text]);
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      // without HTTPS or the permission, the selected text is copied in the old way
      getSelection().selectAllChildren(shown.current);
      document.execCommand("copy");
    }
    setCopied(true);
  };
  return html`<div class="copyable"><pre id=${id} ref=${shown} role="group" tabindex="0" aria-label="Command line">${text || " "}</pre>
    <button type="button" disabled=${!text} onClick=${copy}>${copied ? "Copied" : "Copy"}</button></div>`;
}
