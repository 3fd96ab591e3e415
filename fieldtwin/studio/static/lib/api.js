// Requests to the interface, and the stream of updates. An error of the server is thrown as an Error with its message.

const BASE = "/api/v1";

export async function call(method, path, body) {
  let response;
  try {
    response = await fetch(BASE + path, {
      method,
      headers: body === undefined ? {} : { "Content-Type": "application/json" },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch {
    throw new Error("Studio's server does not answer. Is `fieldtwin studio` still running?");
  }
  const content = await response.json().catch(() => null);
  if (!response.ok) throw new Error(content?.error?.message ?? `the server answered ${response.status}`);
  if (content === null) throw new Error("The answer of Studio's server is cut off. Try again.");
  return content;
}

/** Fetch a file: [its name, its content]. */
export async function getFile(path) {
  const response = await fetch(BASE + path).catch(() => {
    throw new Error("Studio's server does not answer. Is `fieldtwin studio` still running?");
  });
  if (!response.ok) {
    const content = await response.json().catch(() => ({}));
    throw new Error(content.error?.message ?? `the server answered ${response.status}`);
  }
  const name = /filename="([^"]+)"/.exec(response.headers.get("Content-Disposition"))?.[1] ?? "frames";
  return [name, await response.blob()];
}

export const get = (path) => call("GET", path);
export const post = (path, body) => call("POST", path, body ?? {});
export const put = (path, body) => call("PUT", path, body);
export const remove = (path) => call("DELETE", path);
export const url = (path) => BASE + path;
export const of = (instance) => `/instances/${encodeURIComponent(instance)}`;

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 10_000;

/** Receive the updates of an instance until the returned function is called. */
export const follow = (instance, onUpdate, onConnected) => followPath(`${of(instance)}/stream`, onUpdate, onConnected);

/** Receive messages until the returned function is called. A lost connection is opened again after a growing pause. */
export function followPath(path, onUpdate, onConnected) {
  let socket = null;
  let closed = false;
  let pause = FIRST_PAUSE_MS;
  let timer = 0;
  const open = () => {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}${BASE}${path}`);
    socket.onopen = () => {
      pause = FIRST_PAUSE_MS;
      onConnected(true);
    };
    socket.onmessage = (message) => onUpdate(JSON.parse(message.data));
    socket.onclose = () => {
      if (closed) return;
      onConnected(false);
      timer = setTimeout(open, pause);
      pause = Math.min(LONGEST_PAUSE_MS, pause * 2);
    };
  };
  open();
  return () => {
    closed = true;
    clearTimeout(timer);
    socket?.close();
  };
}
