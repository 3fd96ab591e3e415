// The frame of the page: which instance and which view the address names, navigation, and warnings that are visible on every view.

import { html, render, useEffect, useRef, useState } from "./vendor/preact.js";
import { address } from "./lib/address.js";
import { remove, url } from "./lib/api.js";
import { Guard } from "./lib/guard.js";
import { Failure, useAction } from "./lib/parts.js";
import { Store, useStore } from "./lib/store.js";
import { PREFIX, TraceStore } from "./lib/trace_store.js";
import { Home } from "./views/home.js";
import { Overview } from "./views/overview.js";
import { Devices } from "./views/devices.js";
import { Bus } from "./views/bus.js";
import { Plc } from "./views/plc.js";
import { Trends } from "./views/trends.js";
import { Faults } from "./views/faults.js";
import { Alarms, standing } from "./views/alarms.js";
import { Scenario } from "./views/scenario.js";
import { FailedChecks, Timeline } from "./views/timeline.js";
import { Guide } from "./commissioning/guide.js";
import { Twin } from "./views/twin.js";

const VIEWS = {
  overview: { title: "Overview", view: Overview },
  devices: { title: "Devices", view: Devices },
  bus: { title: "Bus", view: Bus, fill: true },
  plc: { title: "PLC", view: Plc },
  trends: { title: "Trends", view: Trends },
  alarms: { title: "Alarms", view: Alarms, shown: (store) => store.about?.system.alarms.length > 0 },
  faults: { title: "Faults", view: Faults, prototype: true },
  scenario: { title: "Scenario", view: Scenario, live: true },
  twin: { title: "Twin", view: Twin, live: true },
};

const GUIDE = "commissioning"; // an instance of this name is opened at commissioning/overview

function readAddress() {
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  const [instance = "", view = "overview"] = path.split("/").map(decoded);
  if (path === GUIDE) return { guide: new URLSearchParams(query ?? "").get("step") ?? "" };
  return { instance, view: view in VIEWS ? view : "overview", query: new URLSearchParams(query ?? "") };
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // a cut-off address: no instance has this name, and the page says so
  }
}

function App() {
  const [place, setPlace] = useState(readAddress());
  useEffect(() => {
    const changed = () => setPlace(readAddress());
    // A click on the link of the shown view changes no address, so the browser reports nothing; it draws the view again.
    const clicked = (e) => e.target.closest?.("a[href]")?.href === location.href && changed();
    addEventListener("hashchange", changed);
    addEventListener("click", clicked);
    return () => {
      removeEventListener("hashchange", changed);
      removeEventListener("click", clicked);
    };
  }, []);
  useEffect(() => {
    document.title = place.guide !== undefined ? "Commissioning · Studio" : place.instance ? `${place.instance}: ${VIEWS[place.view].title} · Studio` : "fieldtwin Studio";
  }, [place]);
  if (place.guide !== undefined) return html`<${Guide} step=${place.guide} place=${place}><${Theme} /><//>`;
  if (!place.instance) return html`<${Home} />`;
  return html`<${Instance} key=${place.instance} place=${place} />`;
}

function Instance({ place }) {
  const [store] = useState(() => (place.instance.startsWith(PREFIX) ? new TraceStore(place.instance, place.query.has("t") ? Number(place.query.get("t")) : null) : new Store(place.instance)));
  useEffect(() => {
    store.open();
    return () => store.close();
  }, [store]);
  useStore(store);
  const { view: View, fill } = VIEWS[place.view];
  const main = useRef(null);
  const first = useRef(true);
  useEffect(() => {
    // The link of the earlier view is gone: without this, the tab key would begin at the top of the page again.
    if (!first.current) main.current.focus();
    first.current = false;
  }, [place]);
  return html`<div class="frame ${store.isTrace ? "trace" : ""}">
    <${Top} store=${store} />
    <${Banners} store=${store} />
    <nav class="nav" aria-label="Views">
      ${Object.entries(VIEWS).map(
        ([name, { title, prototype, live, shown }]) =>
          (!prototype || store.isPrototype) && !(live && store.isTrace) && (!shown || shown(store)) &&
          html`<a href=${address(place.instance, name)} aria-current=${name === place.view ? "page" : null}>
            ${title} <${Count} store=${store} view=${name} />
          </a>`,
      )}
    </nav>
    <main class=${fill ? "fill" : ""} id="view" ref=${main} tabindex="-1">
      ${store.error && html`<${Failure} text=${store.error} /><p><a href="#/">All instances</a></p>`}
      ${store.about &&
      html`<${Guard} title="This view cannot be shown" place=${place}>
        <${View} store=${store} query=${place.query} key=${`${place.view} ${store.about.started_ns}`} />
      <//>`}
      ${!store.about && !store.error && html`<p class="empty">Reading the instance …</p>`}
    </main>
  </div>`;
}

function Count({ store, view }) {
  const forces = Object.keys(store.status?.plc?.forces ?? {}).length;
  const faults = (store.status?.field?.faults?.length ?? 0) + Object.keys(store.status?.field?.set ?? {}).length;
  const [count, title] = { plc: [forces, "active forces"], faults: [faults, "active faults"], alarms: [standing(store), "alarms that are active or not acknowledged"] }[view] ?? [0, ""];
  return count ? html`<span class="count" title=${title}>${count}</span>` : null;
}

function Top({ store }) {
  const mode = store.about?.mode;
  const writes = mode === "plant" && (store.about.allow_writes ? "writes allowed" : "read-only");
  const states = Object.keys(store.programs).filter((name) => store.programs[name].machine);
  return html`<header class="top">
    <a class="brand" href="#/">fieldtwin Studio</a>
    <strong class="name">${store.isTrace ? store.about?.title || store.name.slice(PREFIX.length) : store.name}</strong>
    ${mode && html`<span class="chip ${mode === "plant" ? "warn" : "accent"}">${mode}${writes ? `, ${writes}` : ""}</span>`}
    ${store.status?.plc &&
    states.map((name) => html`<span class="chip">${name}: ${store.word(name, "state", store.variable(name, "state"))}</span>`)}
    ${store.isTrace && store.about?.report && html`<a href=${url(`${store.path}/report`)} target="_blank" rel="noopener">Report</a>`}
    <span class="grow"></span>
    ${!store.isTrace && store.about?.role === "view" && html`<span class="chip">view only</span>`}
    ${store.dropped > 0 && html`<span class="chip warn" title="This page was too slow to take them">${store.dropped} updates lost</span>`}
    <span class="chip ${!store.connected ? "bad" : store.isTrace ? "" : "good"}" role="status">${!store.connected ? "not connected" : store.isTrace ? "recorded, read-only" : "live"}</span>
    <${Theme} />
  </header>`;
}

function Theme() {
  const [theme, setTheme] = useState(document.documentElement.dataset.theme ?? "");
  const dark = theme ? theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  const change = () => {
    const next = dark ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    setTheme(next);
  };
  return html`<button class="quiet" onClick=${change}>${dark ? "Light" : "Dark"}</button>`;
}

function Banners({ store }) {
  const [run, error] = useAction();
  const { gateway, plc, field } = store.status ?? {};
  const forces = Object.entries(plc?.forces ?? {});
  const set = Object.entries(field?.set ?? {});
  const troubles = Object.entries(store.status?.troubles ?? {}).filter(([what]) => what !== "tags" || !store.status.troubles.gateway);
  return html`<div class="banners">
    ${store.isTrace && store.about && html`<${FailedChecks} store=${store} /><${Timeline} store=${store} />`}
    ${!store.connected && store.about && html`<div class="banner bad" role="alert">The connection to Studio's server is lost: values below are old.</div>`}
    ${troubles.map(([, text]) => html`<div class="banner bad" role="alert"><span class="grow">${text}</span></div>`)}
    ${plc?.error && html`<div class="banner bad" role="alert"><span class="grow">PLC: ${plc.error} ${plc.error_at}</span></div>`}
    ${plc?.state === "paused" && html`<div class="banner" role="alert">The PLC is paused: it executes no program, and its outputs keep their values.</div>`}
    ${forces.length > 0 &&
    html`<div class="banner" role="alert">
      <span class="grow">Forced: ${forces.map(([tag, f]) => `${tag} = ${store.wordOf(tag, f.value)}${f.by ? ` by ${f.by}` : ""}`).join(", ")}</span>
      ${store.mayOperate && html`<button onClick=${() => run(() => remove(`${store.path}/plc/forces`))}>Remove all forces</button>`}
    </div>`}
    ${!store.isTrace &&
    (field?.faults?.length > 0 || set.length > 0) &&
    html`<div class="banner" role="status">
      <span class="grow"
        >${"Faults: "}${[
          ...(field.faults ?? []).map((f) => `${f.name} on ${f.device || f.bus}`),
          ...set.map(([tag, v]) => `${tag} set to ${store.wordOf(tag, v)}`),
        ].join(", ")}</span
      >
      <a href=${address(store.name, "faults")}>Show</a>
    </div>`}
    ${gateway?.plc && !gateway.plc.alive && html`<div class="banner bad" role="alert">The gateway receives nothing from the PLC.</div>`}
    <${Failure} text=${error} />
  </div>`;
}

const root = document.getElementById("app");
root.replaceChildren(); // the note that the page is loading, which Preact would keep below the page
render(html`<${Guard} title="Studio's page cannot be shown"><${App} /><//>`, root);
