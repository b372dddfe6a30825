// Requests to the service, with the key of this session.

const KEY = "envmatte-key"; // the page that shows programs keeps it under this name too

export class Problem extends Error {
  constructor({ title, detail, status, field }) {
    super(detail);
    Object.assign(this, { title, detail, status, field });
  }
}

const AWAY = {
  status: 0,
  title: "The service does not answer",
  detail: "See that it runs and that this device is still connected to it, then try again. What was stored is safe.",
};

export const key = () => sessionStorage.getItem(KEY);

// What no header can hold makes another key of it, which is as unknown to the service.
export const authorization = () => (key() ? { Authorization: `Bearer ${key().replace(/[^\x20-\xff]/g, "?")}` } : {});

let asking;

// Asks for a key; all requests that are refused meanwhile wait for the same answer.
export function unlock(problem) {
  asking ??= new Promise((resolve, reject) => {
    const dialog = document.getElementById("unlock");
    const field = document.getElementById("key");
    document.getElementById("unlock-why").textContent = key() ? "This key is not known to the service." : "";
    field.value = "";
    dialog.onsubmit = () => {
      sessionStorage.setItem(KEY, field.value.trim());
      resolve();
    };
    dialog.onclose = () => {
      asking = undefined;
      reject(problem); // unless it was given
    };
    dialog.showModal();
  });
  return asking;
}

// An answer, or a Problem as the API words it; a key is asked for where one is needed.
export async function ask(path, options = {}) {
  for (;;) {
    const used = key();
    let answer;
    try {
      answer = await fetch(path, { ...options, headers: { ...options.headers, ...authorization() } });
    } catch (error) {
      throw options.signal?.aborted ? options.signal.reason : new Problem(AWAY);
    }
    if (answer.ok) return answer;
    const problem = new Problem(await described(answer));
    if (answer.status !== 401) throw problem;
    if (used === key()) await unlock(problem);
  }
}

async function described(answer) {
  const about = answer.headers.get("content-type")?.includes("json") ? await answer.json().catch(() => ({})) : {};
  return { title: answer.statusText || "Refused", detail: `The service answered with ${answer.status}.`, ...about, status: answer.status };
}

export const getJson = async (path, signal) => (await ask(path, { signal })).json();

export const getBlob = async (path, signal) => (await ask(path, { signal })).blob();

// Posts JSON; sent twice by a nervous hand or network, it makes one thing.
export async function post(path, body, once = crypto.randomUUID?.() ?? String(Math.random())) {
  const headers = { "Content-Type": "application/json", "Idempotency-Key": once };
  return (await ask(path, { method: "POST", headers, body: JSON.stringify(body) })).json();
}

export const call = (method, path) => ask(path, { method });

// What is gone already, by another tab, is deleted too.
export const remove = (path) => call("DELETE", path).catch((error) => {
  if (error.status !== 404) throw error;
});

// Saves what the service answers with. Without a key the browser streams it to the disk by itself.
export async function save(path, name) {
  if (!key()) return saveAs(path, name);
  saveBlob(await getBlob(path), name);
}

export function saveBlob(blob, name) {
  const url = URL.createObjectURL(blob);
  saveAs(url, name);
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

function saveAs(href, download) {
  const link = Object.assign(document.createElement("a"), { href, download });
  link.click();
}
