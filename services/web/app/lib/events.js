// What changes, by server-sent events over `fetch`: an EventSource can't send a key.
import { ask } from "./api.js";
import { pause } from "./dom.js";

const SILENCE = 45_000; // ms; the service sends a comment each 15 s, so that a line cut without a word is noticed
const ASLEEP = 20_000; // ms: more than between two of those comments
const LONGEST = 15_000; // ms between two attempts
export const ACTIVE = ["queued", "running"];

// Splits a stream of bytes into events, each `{id, data}`.
export async function* parse(stream, heard = () => {}) {
  const reader = stream.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  let event = { data: [] };
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      heard();
      const lines = (rest + value).split(/\r\n|\n|\r/);
      rest = lines.pop();
      yield* taken(lines);
    }
  } finally {
    reader.cancel().catch(() => {});
  }
  function* taken(lines) {
    for (const line of lines) {
      if (line === "") {
        if (event.data.length) yield { id: event.id, data: event.data.join("\n") };
        event = { data: [] };
      } else if (!line.startsWith(":")) {
        const [, name, value] = /^([^:]*):? ?(.*)$/.exec(line);
        if (name === "data") event.data.push(value);
        else if (name === "id") event.id = value;
      }
    }
  }
}

// Calls `changed(found)` now and whenever what is at `path` has changed, until it is `over`; returns it then. While the
// service is away `lost(true)` is called, and it is asked for again, ever less often.
export async function follow(path, signal, changed, { lost = () => {}, over = () => false } = {}) {
  let seen;
  let wait = 1000;
  for (;;) {
    signal.throwIfAborted();
    const cut = new AbortController();
    const stop = () => cut.abort(signal.reason);
    signal.addEventListener("abort", stop, { once: true });
    let timer;
    let heardAt;
    const heard = () => {
      clearTimeout(timer);
      heardAt = Date.now();
      timer = setTimeout(() => cut.abort(), SILENCE);
    };
    // A laptop that wakes up has a line that is dead, and timers that stood still.
    const woken = () => !document.hidden && Date.now() - heardAt > ASLEEP && cut.abort();
    document.addEventListener("visibilitychange", woken);
    addEventListener("online", woken);
    try {
      heard();
      const headers = { Accept: "text/event-stream", ...(seen && { "Last-Event-ID": seen }) };
      const answer = await ask(path, { headers, signal: cut.signal });
      lost(false);
      for await (const event of parse(answer.body, heard)) {
        seen = event.id;
        wait = 1000;
        const found = JSON.parse(event.data);
        changed(found);
        if (over(found)) return found;
      }
    } catch (error) {
      signal.throwIfAborted();
      if (error.status >= 400 && error.status < 500) throw error;
      lost(true);
    } finally {
      clearTimeout(timer);
      signal.removeEventListener("abort", stop);
      document.removeEventListener("visibilitychange", woken);
      removeEventListener("online", woken);
    }
    await Promise.race([pause(wait, signal), online(signal)]);
    wait = Math.min(2 * wait, LONGEST);
  }
}

const online = (signal) => new Promise((resolve) => addEventListener("online", resolve, { once: true, signal }));
