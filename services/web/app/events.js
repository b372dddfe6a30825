// A job by server-sent events, over `fetch`: an EventSource can't send a key.
import { ask } from "./api.js";
import { pause } from "./dom.js";

const SILENCE = 45_000; // ms; the service sends a comment each 15 s, so that a line cut without a word is noticed
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

// Calls `changed(job)` now and whenever the job has changed, until it has ended; returns it then. While the service is
// away `lost(true)` is called, and it is asked for again, ever less often.
export async function follow(id, signal, changed, lost = () => {}) {
  let seen;
  let wait = 1000;
  for (;;) {
    signal.throwIfAborted();
    const cut = new AbortController();
    const stop = () => cut.abort(signal.reason);
    signal.addEventListener("abort", stop, { once: true });
    let timer;
    const heard = () => {
      clearTimeout(timer);
      timer = setTimeout(() => cut.abort(), SILENCE);
    };
    try {
      heard();
      const headers = { Accept: "text/event-stream", ...(seen && { "Last-Event-ID": seen }) };
      const answer = await ask(`v1/jobs/${id}/events`, { headers, signal: cut.signal });
      for await (const event of parse(answer.body, heard)) {
        seen = event.id;
        wait = 1000;
        lost(false);
        const job = JSON.parse(event.data);
        changed(job);
        if (!ACTIVE.includes(job.state)) return job;
      }
    } catch (error) {
      signal.throwIfAborted();
      if (error.status >= 400 && error.status < 500) throw error;
      lost(true);
    } finally {
      clearTimeout(timer);
      signal.removeEventListener("abort", stop);
    }
    await pause(wait, signal);
    wait = Math.min(2 * wait, LONGEST);
  }
}
