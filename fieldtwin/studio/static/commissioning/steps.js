// The steps of the guide: their texts, the fields of their forms with defaults from earlier results, and the request that starts them.

/** Where the emulated device answers that the guide starts for practice, by its protocol. */
export const PRACTICE = { modbus: "pty:practice", canopen: "can:fieldtwin/127.0.0.1:29535" };
export const isPractice = (job) => job.step === "emulate" && Object.values(PRACTICE).includes(job.form.on);
/** An emulator's port as a client names it. */
export const asClient = (on) => on.replace(/^pty:/, "rtu:");

/** An endpoint with parameters, each set once. */
export function withParams(endpoint, params) {
  const [base, query = ""] = endpoint.split("?");
  const all = new URLSearchParams(query);
  for (const [name, value] of Object.entries(params)) if (!all.has(name)) all.set(name, value);
  const text = all.toString();
  return text ? `${base}?${text}` : base;
}

const isSerial = (endpoint) => /^(rtu|ascii):/.test(endpoint);
export const isCan = (endpoint) => endpoint.startsWith("can:");
const isModbus = (ctx) => !isCan(ctx.endpoint);

/** The endpoint with the baud rate and the frame that the scan has found. */
export function settled({ endpoint, settings }) {
  const [baudrate, frame] = (settings ?? "").split(" ");
  return isSerial(endpoint) && frame ? withParams(endpoint, { baudrate, frame }) : endpoint;
}

/** A file name that is not in use: meter-dump.jsonl, then meter-dump-2.jsonl. */
export function free(ctx, stem, suffix) {
  const taken = new Set(ctx.files.map((f) => f.name));
  for (let n = 1; ; n += 1) {
    const name = `${stem}${n > 1 ? `-${n}` : ""}${suffix}`;
    if (!taken.has(name)) return name;
  }
}

const ofKinds = (ctx, kinds) => ctx.files.filter((f) => kinds.includes(f.kind) && (f.kind !== "recording" || f.name.endsWith(isCan(ctx.endpoint) ? ".log" : ".jsonl")));
export const of = (ctx, ...kinds) => ofKinds(ctx, kinds).map((f) => f.name);
export const newest = (ctx, ...kinds) =>
  ofKinds(ctx, kinds).filter((f) => !f.name.endsWith(".sent.jsonl")).sort((a, b) => b.modified_s - a.modified_s)[0]?.name ?? "";
export const made = (ctx, step, field = "out") => {
  const job = ctx.latest[step];
  return job && job.state !== "failed" && ctx.files.some((f) => f.name === job.form[field]) ? job.form[field] : "";
};
const whole = (text) => (text === "" || text === null ? null : Number(text));
const list = (text) => text.split(/[\s,]+/).filter(Boolean);
const addressLabel = (ctx) => (isCan(ctx.endpoint) ? "Node ID" : "Unit ID");
const profiles = (ctx) => [...of(ctx, "profile"), ...ctx.profiles.filter((p) => p.protocol === (isCan(ctx.endpoint) ? "canopen" : "modbus")).map((p) => p.name)];
const addressField = (ctx) => ({ name: "address", label: addressLabel(ctx), kind: "number", min: 0, max: 255, value: ctx.address });

const rounds = [
  { name: "rounds", label: "Rounds", kind: "number", min: 1, value: 10 },
  { name: "every_s", label: "Time between rounds", kind: "number", unit: "s", min: 0.1, step: "any", value: 1 },
];
const EDS_HINT = "Copy the EDS of the device into the working folder, and it is listed here.";

/** What tells the objects of a CANopen node: an EDS in the folder, or a profile with one; "" for neither. */
const sheetOptions = (ctx) => [...of(ctx, "data sheet"), ...profiles(ctx)];
const isEds = (name) => /\.(eds|dcf)$/.test(name);
const sheetField = (ctx, none, hint) => ({ name: "sheet", label: "EDS or profile", kind: "select", options: sheetOptions(ctx), none, hint, value: defaultSheet(ctx) });
const defaultSheet = (ctx) => newest(ctx, "data sheet") || ctx.draft || newest(ctx, "profile") || (sheetOptions(ctx).includes(ctx.profile) ? ctx.profile : "");
const chosenSheet = (ctx, step) => ctx.forms[step]?.sheet ?? defaultSheet(ctx);
const sheet = (name) => (isEds(name) ? { eds: name } : { profile: name || null });

export const STEPS = [
  {
    id: "port",
    title: "Port",
    text: "Choose where the device is connected. The files of this device begin with the name that you give it.",
  },
  {
    id: "line",
    title: "Listen",
    needsPort: true,
    text: (ctx) =>
      isCan(ctx.endpoint)
        ? "Listen to the bus before you send anything. The result names load, errors and nodes, and possible causes if something looks wrong. A node without a heartbeat is silent until a master asks it."
        : "Listen to the line before you send anything. The result names what is on the line, and possible causes if something looks wrong. Without a client a Modbus line is silent.",
    fields: () => [
      { name: "listen_s", label: "Listen for", kind: "number", unit: "s", min: 0.5, step: "any", value: 5 },
    ],
    request: (ctx, v) => ({ endpoint: ctx.endpoint, listen_s: Number(v.listen_s) }),
    seconds: (form) => form.listen_s,
  },
  {
    id: "scan",
    title: "Scan",
    needsPort: true,
    text: (ctx) =>
      `${isCan(ctx.endpoint) ? "Find the nodes on the bus." : "Find the devices and, on a serial line, the baud rate and the frame."} The scan listens first, and then only reads. You can stop it at any time and keep what it has found.`,
    fields: (ctx) => [
      ...(isModbus(ctx)
        ? [{ name: "quick", label: "Try only the likely settings and unit IDs", kind: "check", value: true, hint: "Takes at most 30 s. Without it, every unit ID is asked at every setting." }]
        : []),
      { name: "units", label: isCan(ctx.endpoint) ? "Node IDs" : "Unit IDs", kind: "text", value: "", placeholder: "all, or such as 1-20,30" },
      { name: "listen_s", label: "Listen first for", kind: "number", unit: "s", min: 0.5, step: "any", value: isCan(ctx.endpoint) ? 5 : 3 },
      { name: "share_bus", label: "Send although the line carries traffic of another client", kind: "check", value: false },
    ],
    request: (ctx, v) => ({ endpoint: ctx.endpoint, quick: Boolean(v.quick), units: v.units.replace(/\s/g, ""), listen_s: Number(v.listen_s), share_bus: v.share_bus }),
  },
  {
    id: "identify",
    title: "Identify",
    needsPort: true,
    text: "Ask the device who it is, and compare it with all known profiles. If a profile fits with certainty, you need not make your own.",
    fields: (ctx) => [addressField(ctx)],
    request: (ctx, v) => ({ endpoint: settled(ctx), address: Number(v.address) }),
  },
  {
    id: "dump",
    title: "Dump",
    needsPort: true,
    text: (ctx) =>
      isCan(ctx.endpoint)
        ? "Read the objects of the node. With its EDS or profile, the dump reads the objects that the data sheet states; without, it asks for every object of the ranges. It only reads."
        : "Read the registers several times, and let the device work meanwhile: values that change show their types. The dump finds gaps and the longest read by itself. It only reads.",
    fields: (ctx) => [
      addressField(ctx),
      ...(isCan(ctx.endpoint) ? [sheetField(ctx, "none", EDS_HINT)] : []),
      {
        name: "ranges",
        label: "Ranges",
        kind: "text",
        value: isCan(ctx.endpoint) ? (chosenSheet(ctx, "dump") ? "" : "1000..1FFF") : "input:0..127 holding:0..127",
        placeholder: isCan(ctx.endpoint) && chosenSheet(ctx, "dump") ? "all objects of the data sheet" : "everything, which can take long",
        hint: isCan(ctx.endpoint) ? "Objects such as 6000..6FFF" : "Such as holding:0..999 or 40001..40100; empty for all tables",
      },
      { name: "passes", label: "Passes", kind: "number", min: 1, value: isCan(ctx.endpoint) ? 1 : 12 },
      { name: "every_s", label: "Time between passes", kind: "number", unit: "s", min: 0.1, step: "any", value: 3 },
      ...(ctx.latest.dump?.state === "stopped" && made(ctx, "dump")
        ? [{ name: "resume", label: `Continue ${made(ctx, "dump")}`, kind: "check", value: true }]
        : []),
      { name: "out", label: "File", kind: "out", value: free(ctx, `${ctx.name}-dump`, ".jsonl") },
    ],
    request: (ctx, v) => {
      const form = v.resume && ctx.latest.dump ? { ...ctx.latest.dump.form, resume: true } : null;
      return form ?? { endpoint: settled(ctx), address: Number(v.address), ...(isCan(ctx.endpoint) ? sheet(v.sheet) : {}), ranges: list(v.ranges), passes: Number(v.passes), every_s: Number(v.every_s), out: v.out };
    },
  },
  {
    id: "infer",
    title: "Infer",
    text: "Find the types, word orders and counters from the passes of the dump, and write a draft of a profile. Each line says how certain it is.",
    modbusOnly: "A CANopen device states its objects in its EDS file, so there is nothing to infer. Go on with the step Edit, or with Record if the node needs no profile of its own.",
    fields: (ctx) => [
      { name: "dump", label: "Dump or recording", kind: "select", options: of(ctx, "dump", "recording"), value: made(ctx, "dump") || newest(ctx, "dump"), missing: "No dump yet: the step Dump writes one." },
      { name: "out", label: "File", kind: "out", value: free(ctx, ctx.name, ".yaml") },
    ],
    request: (ctx, v) => ({ dump: v.dump, out: v.out }),
  },
  {
    id: "edit",
    title: "Edit",
    text: (ctx) =>
      isCan(ctx.endpoint)
        ? "Name the objects that your site uses as tags, with types and units. The profile is checked as you type. Skip this step if the step Identify has found a profile that fits."
        : "Compare the values with the device's display or its manual. Give the tags names and units, and correct what is wrong. The profile is checked as you type.",
  },
  {
    id: "record",
    title: "Record",
    needsPort: true,
    text: "Record the answers of the device. The recording is the device on file: tests and emulators use it after the device is gone.",
    fields: (ctx) =>
      isCan(ctx.endpoint)
        ? [
            sheetField(ctx, "none: only listen", "Most nodes send nothing until a master asks them. With an EDS or a profile, the recording reads its objects."),
            ...(chosenSheet(ctx, "record")
              ? [addressField(ctx), ...rounds]
              : [{ name: "for_s", label: "Listen for", kind: "number", unit: "s", min: 1, step: "any", value: 10 }]),
            { name: "out", label: "File", kind: "out", value: free(ctx, ctx.name, ".log") },
          ]
        : [
            { name: "profile", label: "Profile", kind: "select", options: profiles(ctx), value: ctx.draft || made(ctx, "infer") || newest(ctx, "profile") || ctx.profile || "", missing: "No profile yet: the step Infer writes one." },
            addressField(ctx),
            ...rounds,
            { name: "out", label: "File", kind: "out", value: free(ctx, ctx.name, ".jsonl") },
          ],
    request: (ctx, v) =>
      isCan(ctx.endpoint)
        ? { endpoint: ctx.endpoint, ...sheet(v.sheet), ...(v.sheet ? { address: Number(v.address), rounds: Number(v.rounds), every_s: Number(v.every_s) } : { for_s: Number(v.for_s) }), out: v.out }
        : { endpoint: settled(ctx), profile: v.profile || null, address: whole(v.address), rounds: Number(v.rounds), every_s: Number(v.every_s), out: v.out },
    seconds: (form) => form.for_s ?? form.rounds * form.every_s,
  },
  {
    id: "emulate",
    title: "Emulate",
    text: "Let the recording answer in the device's place, on a port of this computer. The emulator runs until you stop it, or Studio ends.",
    fields: (ctx) => [
      { name: "what", label: "Recording or profile", kind: "select", options: of(ctx, "recording", "profile"), value: made(ctx, "record") || newest(ctx, "recording"), missing: "No recording yet: the step Record writes one." },
      { name: "on", label: "Listen on", kind: "text", value: copyPort(ctx), hint: isCan(ctx.endpoint) ? "A software CAN bus of this computer, which is not the bus of the device: two nodes of one ID disturb each other." : "pty:NAME is a virtual serial port; or tcp://127.0.0.1:1502" },
      ...(isCan(ctx.endpoint) ? [{ name: "address", label: "Node ID", kind: "number", min: 1, max: 127, value: ctx.address }] : []),
    ],
    request: (ctx, v) => ({ what: v.what, on: v.on, address: isCan(ctx.endpoint) ? whole(v.address) : null }),
  },
  {
    id: "compare",
    title: "Compare",
    text: "Repeat the recorded requests, and compare the answers: with the emulator to see how good it is, or later with the device to see what has changed. Compare before another program reads the emulator, because each read takes the next recorded value.",
    fields: (ctx) => [
      { name: "recording", label: "Recording", kind: "select", options: of(ctx, "recording"), value: made(ctx, "record") || newest(ctx, "recording"), missing: "No recording yet: the step Record writes one." },
      { name: "endpoint", label: "Compare with", kind: "text", value: asClient(ctx.emulator?.form.on ?? copyPort(ctx)) },
      { name: "tolerances", label: "Tolerances", kind: "text", value: "", placeholder: "none, or such as 2% flow=0.5" },
      ...(isCan(ctx.endpoint) ? [{ name: "listen_s", label: "Listen afterwards for", kind: "number", unit: "s", min: 0.1, step: "any", value: 10, hint: "Compares heartbeats and PDOs too." }] : []),
      { name: "judge_latency", label: "Judge the latencies as well", kind: "check", value: false },
      { name: "out", label: "File", kind: "out", value: free(ctx, `${ctx.name}-comparison`, ".json") },
    ],
    request: (ctx, v) => ({ recording: v.recording, endpoint: v.endpoint, tolerances: list(v.tolerances), judge_latency: v.judge_latency, out: v.out, ...(isCan(v.endpoint) ? { address: ctx.address, listen_s: Number(v.listen_s) } : {}) }),
  },
  {
    id: "check",
    title: "Check",
    needsPort: true,
    text: "Test how the device handles unusual requests, against the standard. The check only reads, unless you name cells that it may write.",
    fields: (ctx) => [
      addressField(ctx),
      ...(isCan(ctx.endpoint) ? [{ name: "eds", label: "EDS", kind: "select", options: of(ctx, "data sheet"), none: "none", hint: EDS_HINT, value: newest(ctx, "data sheet") }] : []),
      { name: "writes", label: "May write to", kind: "text", value: "", placeholder: "nothing", hint: isCan(ctx.endpoint) ? "Objects such as 2000:00. Their values are put back." : "Cells such as holding:100. Their values are put back." },
      { name: "out", label: "File", kind: "out", value: free(ctx, `${ctx.name}-check`, ".json") },
    ],
    request: (ctx, v) => ({ endpoint: settled(ctx), address: Number(v.address), ...(v.eds ? { eds: v.eds } : {}), writes: list(v.writes), out: v.out, html: v.out.replace(/\.json$/, ".html") }),
    confirms: (request) => request.writes.length > 0,
  },
  {
    id: "report",
    title: "Report",
    text: "Make the acceptance document from the results: one HTML file for printing and signing.",
    fields: (ctx) => [
      { name: "files", label: "Results", kind: "files", options: of(ctx, "dump", "check", "comparison"), value: [made(ctx, "dump") || newest(ctx, "dump"), made(ctx, "check")].filter(Boolean), missing: "No results yet: the steps Dump, Check and Compare write some." },
      { name: "site", label: "Site", kind: "text", value: "" },
      { name: "label", label: "Device name", kind: "text", value: "", placeholder: "as on the drawing" },
      { name: "serial", label: "Serial number", kind: "text", value: "", placeholder: "as on the name plate" },
      { name: "customer", label: "Operator", kind: "text", value: "", placeholder: "printed at the signature" },
      { name: "out", label: "File", kind: "out", value: free(ctx, `${ctx.name}-acceptance`, ".html") },
    ],
    request: (ctx, v) => ({ files: v.files, site: v.site, customer: v.customer, label: v.label, serial: v.serial, device: v.label || v.serial ? `${isCan(ctx.endpoint) ? "node" : "unit"} ${ctx.address}` : "", out: v.out }),
  },
];

/** The port of the emulator: never the bus of the device. */
function copyPort(ctx) {
  if (!isCan(ctx.endpoint)) return "pty:copy";
  return `can:fieldtwin/127.0.0.1:${ctx.endpoint.endsWith(":29536") ? 29546 : 29536}`;
}
