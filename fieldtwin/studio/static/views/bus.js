// The frames of the buses. Only the rows in view are fetched and drawn, so a million frames scroll like a hundred.

import { html, useCallback, useEffect, useLayoutEffect, useRef, useState } from "../vendor/preact.js";
import { address } from "../lib/address.js";
import { get, getFile } from "../lib/api.js";
import { clock, hex, milliseconds, number } from "../lib/format.js";
import { Failure, Quality, useAction, useFetched } from "../lib/parts.js";
import { useStore } from "../lib/store.js";

const ROW = 24;
const PAGE = 100;
const TALLEST = 8_000_000; // browsers do not draw taller elements; beyond, the bar moves by several frames at a time
const MOST_PAGES = 30;

export function Bus({ store, query }) {
  useStore(store);
  const [filter, setFilter] = useState({ bus: query.get("bus") ?? "", device: query.get("device") ?? "", service: "", problems: query.get("problems") ?? "" });
  const [selected, setSelected] = useState(null);
  const [live, setLive] = useState(!query.get("at") && !store.isTrace);
  const [services] = useFetched(() => (store.about.frames ? get(`${store.path}/frames/services`) : Promise.resolve([])), [store.frames.total > 0]);
  if (!store.about.frames)
    return html`<div class="empty">
      <p>This run does not record the frames of its buses.</p>
      <p>Start it here, with <code>fieldtwin run SYSTEM --studio</code>, or with <code>--capture FILE</code>.</p>
    </div>`;
  const change = (key) => (e) => setFilter({ ...filter, [key]: e.target.type === "checkbox" ? (e.target.checked ? "true" : "") : e.target.value });
  const choice = (key, title, values) =>
    html`<label>${title}
      <select value=${filter[key]} onChange=${change(key)}>
        <option value="">all</option>
        ${values.map((v) => html`<option value=${v}>${v}</option>`)}
      </select>
    </label>`;
  const { system } = store.about;
  const selection = new URLSearchParams(Object.entries(filter).filter(([, v]) => v));
  return html`<h1 class="visually-hidden">Frames of the buses</h1>
    <div class="bar">
      ${!store.isTrace && html`<button onClick=${() => setLive(!live)} aria-pressed=${live}>${live ? "Pause" : "Follow"}</button>`}
      ${choice("bus", "Bus", Object.keys(system.buses))} ${choice("device", "Device", Object.keys(system.devices))}
      ${choice("service", "Function", services ?? [])}
      <label><input type="checkbox" checked=${!!filter.problems} onChange=${change("problems")} /> only problems</label>
      <span class="grow"></span>
      ${store.frames.behind_bytes > 100_000 && html`<span class="chip warn">reading earlier frames …</span>`}
      ${store.frames.full && html`<span class="chip warn" title="Studio indexes no further frames of this run">index full</span>`}
      ${store.frames.invalid_lines > 0 && html`<span class="chip warn" title="Lines of the capture that are no frames">${store.frames.invalid_lines} invalid lines</span>`}
      <span class="soft">${store.frames.total.toLocaleString("en")} frames</span>
      <${Exports} path=${store.path} selection=${selection} key=${String(selection)} />
    </div>
    <${Frames} store=${store} filter=${filter} live=${live} setLive=${setLive} selected=${selected} setSelected=${setSelected} at=${store.isTrace ? store.settled : query.get("at")} />
    ${selected !== null && html`<${Detail} store=${store} number=${selected} onClose=${() => setSelected(null)} onSelect=${setSelected} />`}`;
}

function Frames({ store, filter, live, setLive, selected, setSelected, at }) {
  const view = useRef(null);
  const reached = useRef(0); // the latest position of the view
  const [tail, setTail] = useState(null); // while the view follows: the newest rows, {total, start, rows}
  const pages = useRef(new Map());
  const [state, setState] = useState({ total: 0, top: 0, tall: 400 });
  const [error, setError] = useState("");
  const [, again] = useState(0);
  const key = JSON.stringify(filter);
  const search = new URLSearchParams(Object.entries(filter).filter(([, v]) => v)).toString();

  const fetchPage = useCallback(
    async (page) => {
      const into = pages.current; // another filter has another map
      const known = into.get(page);
      if (known === "coming") return;
      into.set(page, known ?? "coming");
      try {
        const answer = await get(`${store.path}/frames?start=${page * PAGE}&count=${PAGE}&${search}`);
        into.set(page, answer.rows);
        while (into.size > MOST_PAGES) into.delete(into.keys().next().value);
        setError("");
      } catch (e) {
        into.delete(page);
        setError(e.message);
      }
      again((n) => n + 1);
    },
    [store, search],
  );

  useEffect(() => {
    pages.current = new Map();
    setTail(null);
    setState((s) => ({ ...s, total: 0 }));
    get(`${store.path}/frames?count=1&${search}`).then((a) => setState((s) => ({ ...s, total: a.total })), (e) => setError(e.message));
  }, [key]);
  const count = Math.ceil(state.tall / ROW) + 1;
  // While the view follows, it asks for the newest rows only, one request at a time: after each message with a new number of frames.
  useEffect(() => {
    if (!live) {
      if (view.current) setState((s) => ({ ...s, top: view.current.scrollTop }));
      return undefined;
    }
    let current = true;
    let busy = false;
    let missed = false;
    const fetchTail = async () => {
      missed = busy;
      if (busy) return;
      busy = true;
      try {
        const answer = await get(`${store.path}/frames?count=${count}&${search}`);
        if (!current) return;
        setTail(answer);
        setState((s) => ({ ...s, total: answer.total }));
        setError("");
      } catch (e) {
        if (current) setError(e.message);
      }
      busy = false;
      if (missed && current) fetchTail();
    };
    fetchTail();
    store.frameListeners.add(fetchTail);
    return () => {
      current = false;
      store.frameListeners.delete(fetchTail);
    };
  }, [live, search, count, store]);

  const whole = Math.min(TALLEST, state.total * ROW);
  const factor = state.total * ROW > TALLEST ? (state.total * ROW - state.tall) / (TALLEST - state.tall) : 1;
  const following = live && tail !== null;
  const first = Math.max(0, Math.min(state.total - 1, Math.floor((state.top * factor) / ROW)));
  const last = Math.min(state.total, first + count);
  useEffect(() => {
    if (live) return;
    for (let page = Math.floor(first / PAGE); page * PAGE < last; page++) {
      const rows = pages.current.get(page);
      const complete = Array.isArray(rows) && (rows.length === PAGE || page * PAGE + rows.length >= last);
      const settled = Array.isArray(rows) && rows.every((r) => r.verdict !== "" || r.number < state.total - 500);
      if (!complete || !settled) fetchPage(page);
    }
  }, [live, first, last, search, state.total]);
  useLayoutEffect(() => {
    if (live && view.current) view.current.scrollTop = whole;
  }, [live, whole, state.tall]);
  useEffect(() => {
    const measure = () => view.current && setState((s) => ({ ...s, tall: view.current.clientHeight }));
    const observer = new ResizeObserver(measure);
    observer.observe(view.current);
    return () => observer.disconnect();
  }, []);
  useEffect(() => {
    if (at !== null && at !== undefined)
      get(`${store.path}/frames?at_ns=${at}&count=${PAGE}&${search}`).then((a) => {
        setState((s) => ({ ...s, total: a.total }));
        const after = a.rows.findIndex((row) => row.t_ns > at);
        const position = a.start + (after < 0 ? a.rows.length : after);
        const rows = store.isTrace ? view.current?.clientHeight * 0.6 : 0; // what led to the instant of a trace is above it
        requestAnimationFrame(() => view.current && (view.current.scrollTop = position * ROW - rows));
      });
  }, [at, key]);
  const scrolled = (e) => {
    const { scrollTop, clientHeight, scrollHeight } = e.target;
    // While it follows, the page itself only scrolls down. A fast bus adds rows between that and this event, so the distance to the end proves nothing.
    const leaves = live && scrollTop < reached.current && scrollTop + clientHeight < scrollHeight - 4 * ROW;
    if (leaves) setLive(false);
    reached.current = scrollTop;
    if (!live || leaves || clientHeight !== state.tall) setState((s) => ({ ...s, top: scrollTop, tall: clientHeight }));
  };
  const move = (e) => {
    const step = { ArrowDown: 1, ArrowUp: -1, PageDown: count - 2, PageUp: 2 - count }[e.key];
    if (!step) return;
    e.preventDefault();
    setLive(false);
    view.current.scrollTop += (step * ROW) / factor;
  };
  const started = store.about.started_ns;
  const rows = following ? tail.rows.map((row, n) => [tail.start + n, row]) : [];
  for (let position = first; position < last && !following; position++) {
    const page = pages.current.get(Math.floor(position / PAGE));
    const row = Array.isArray(page) ? page[position % PAGE] : tail?.rows[position - tail.start];
    rows.push([position, row]);
  }
  const later = (row) => store.isTrace && row.t_ns > store.now(); // than the instant of a trace
  const linked = rows.find(([, r]) => r?.number === selected)?.[1];
  return html`<${Failure} text=${error} />
    <div class="frames" role="region" aria-label="Frames" onKeyDown=${move}>
      <div class="row head">
        <span>Time</span><span>Bus</span><span></span><span>Device</span><span>Function</span><span>Meaning</span><span>Bytes</span><span>Latency</span><span>Verdict</span>
      </div>
      <div class="view" ref=${view} onScroll=${scrolled} role="group" tabindex="0" aria-label="Scroll with the arrow keys">
        <div style=${{ height: `${whole}px` }}></div>
        ${rows.map(([position, r], n) => {
          const top = following ? whole - (tail.total - position) * ROW : factor === 1 ? position * ROW : state.top + (position - first) * ROW;
          if (!r) return html`<div class="row soft" key=${position} style=${{ position: "absolute", left: 0, top: `${top}px` }}>…</div>`;
          const bad = r.verdict !== "good" && r.verdict !== "";
          const earlier = rows[n - 1]?.[1];
          const tied = linked && (r.number === linked.request || r.number === linked.reply);
          return html`<button
            class="row item ${bad ? "problem" : ""} ${tied ? "linked" : ""} ${later(r) ? (earlier && !later(earlier) ? "later next" : "later") : ""}"
            key=${position}
            style=${{ top: `${top}px` }}
            tabindex=${live ? -1 : 0 /* rows that move would hold the tab key; an arrow key or Pause stops them */}
            aria-current=${r.number === selected}
            onClick=${() => setSelected(r.number)}
          >
            <span class="mono">${clock(r.t_ns - started)}</span><span>${r.bus}</span>
            <span title=${r.sent ? "sent by the gateway" : "received by the gateway"}>${r.sent ? "→" : "←"}</span>
            <span>${r.device || (r.unit === null ? "" : r.unit)}</span><span>${r.service}</span><span title=${r.service ? `${r.service}: ${r.text}` : r.text}>${r.text}</span>
            <span class="mono soft">${hex(r.bytes)}</span><span class="mono">${milliseconds(r.latency_ns)}</span>
            <span>${r.verdict || (r.sent ? "pending" : "")}</span>
          </button>`;
        })}
      </div>
    </div>`;
}

function Detail({ store, number: n, onClose, onSelect }) {
  const [frame, error] = useFetched(() => get(`${store.path}/frames/${n}`), [n]);
  const started = store.about.started_ns;
  return html`<section class="card detail" aria-label="Details of a frame">
    <header><h2>Frame ${n}</h2><button class="quiet" onClick=${onClose}>Close</button></header>
    <${Failure} text=${error} />
    ${frame &&
    html`<div class="columns">
      <${Fields} frame=${frame} key=${n} />
      <div>
        <dl class="facts">
          <dt>Time</dt><dd>${clock(frame.t_ns - started)} after the start, ${frame.sent ? "sent" : "received"} by the gateway on ${frame.bus}</dd>
          <dt>Meaning</dt><dd>${frame.device && `${frame.device}: `}${frame.text}</dd>
          ${frame.linked.map(
            (other) => html`<dt>${other.number < n ? "Request" : "Reply"}</dt>
              <dd><button class="quiet" onClick=${() => onSelect(other.number)}>frame ${other.number}</button> ${other.text} ${milliseconds(other.latency_ns)}</dd>`,
          )}
          <dt>Verdict</dt><dd>${frame.verdict || "pending"}</dd>
        </dl>
        <${Effects} store=${store} frame=${frame} />
      </div>
    </div>`}
  </section>`;
}

/** The bytes, and a table with one row for each field. The field under the pointer or the focus is marked in both. */
function Fields({ frame }) {
  const [marked, setMarked] = useState(null);
  const [current, setCurrent] = useState(0);
  const table = useRef(null);
  const bytes = (frame.whole || frame.bytes).match(/../g) ?? [];
  const part = (field) => bytes.slice(field.offset, field.offset + field.length);
  const go = (to) => {
    if (to < 0 || to >= frame.fields.length) return;
    setCurrent(to);
    table.current.querySelectorAll("tbody tr")[to].focus();
  };
  const move = (e) => {
    const to = { ArrowDown: current + 1, ArrowUp: current - 1, Home: 0, End: frame.fields.length - 1 }[e.key];
    if (to === undefined) return;
    e.preventDefault();
    go(to);
  };
  const tint = (i) => `field f${i % 6} ${marked === i ? "marked" : ""}`;
  return html`<div class="fields" onMouseLeave=${() => setMarked(null)}>
    <p class="mono bytes" aria-label="Bytes of the frame, in hexadecimal">
      ${frame.fields.map(
        (field, i) => field.length > 0 && html`<span class=${tint(i)} title=${field.name} onMouseEnter=${() => setMarked(i)} onClick=${() => go(i)}>${part(field).join(" ")}</span> `,
      )}
    </p>
    ${frame.whole && html`<p class="soft">This frame is the last piece of a reply. Its bytes are shown with the pieces before it.</p>`}
    <table class="list" ref=${table} onKeyDown=${move}>
      <thead><tr><th>Bytes</th><th>Field</th><th>Value</th><th>Explanation</th></tr></thead>
      <tbody>
        ${frame.fields.map(
          (field, i) => html`<tr
            key=${i}
            class=${marked === i ? "marked" : ""}
            tabindex=${i === current ? 0 : -1}
            onFocus=${() => (setCurrent(i), setMarked(i))}
            onBlur=${() => setMarked(null)}
            onMouseEnter=${() => setMarked(i)}
          >
            <td class="mono">${field.length > 0 && html`<span class=${tint(i)}>${shortened(part(field))}</span>`}</td>
            <td>${field.name}</td><td class="value">${field.value}</td><td class="soft note">${field.note}</td>
          </tr>`,
        )}
      </tbody>
    </table>
  </div>`;
}

const shortened = (bytes) => (bytes.length > 8 ? `${bytes.slice(0, 7).join(" ")} …` : bytes.join(" "));

/** The changes of tags in the half second after a frame: of those that it carried, and of those that the PLC writes. */
function Effects({ store, frame }) {
  const groups = [
    ["Values that changed", frame.effects.filter((e) => !e.program), "trends"],
    ["Outputs that the PLC changed", frame.effects.filter((e) => e.program), "plc"],
  ];
  return html`<h3>In the half second after this frame</h3>
    ${frame.effects.length === 0 && html`<p class="soft">No tag of this frame and no output of the PLC changed.</p>`}
    ${groups.map(
      ([title, effects, view]) =>
        effects.length > 0 &&
        html`<h4>${title}</h4>
          <ul class="effects">
            ${effects.map(
              (e) => html`<li>
                <a href=${address(store.name, "trends", { tags: e.tag })}>${e.tag}</a>
                ${` ${number(e.before)} → ${number(e.value)}`}${e.quality !== "good" && html` <${Quality} quality=${e.quality} why=${e.reason} />`}
                <span class="soft">${` after ${milliseconds(Math.max(0, e.t_ns - frame.t_ns))}`}</span>
                ${view === "plc" && html` <a href=${address(store.name, "plc")}>program ${e.program}</a>`}
              </li>`,
            )}
          </ul>`,
    )}`;
}

/** Downloads of the selected frames. A selection that a format cannot hold is explained on the page. */
function Exports({ path, selection }) {
  const [run, error, busy] = useAction();
  const save = (kind) =>
    run(async () => {
      const [name, content] = await getFile(`${path}/frames/export?format=${kind}&${selection}`);
      const link = document.createElement("a");
      link.href = URL.createObjectURL(content);
      link.download = name;
      link.click();
      URL.revokeObjectURL(link.href);
    });
  return html`<span class="exports">
      <span class="soft">Export as</span>
      ${["pcapng", "pcap", "candump", "recording"].map((kind) => html`<button class="quiet" disabled=${busy} onClick=${() => save(kind)}>${kind}</button>`)}
    </span>
    ${error && html`<p class="error wide" role="alert">${error}</p>`}`;
}
