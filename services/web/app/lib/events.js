// Server-sent events over `fetch`, because an EventSource cannot send a key.
import { ask } from "./api.js";
import { pause } from "./dom.js";

const SILENCE = 45_000; // ms; the service sends a comment every 15 s, so a longer silence is a broken connection
const ASLEEP = 20_000; // ms: more than between two of those comments
const LONGEST = 15_000; // ms between two attempts
export const ACTIVE = ["queued", "running"];

// Splits a stream of bytes into events, each `{id, data}`. `onbytes` is called whenever something arrives.
export async function* parse(stream, onbytes = () => {}) {
	const reader = stream.pipeThrough(new TextDecoderStream()).getReader();
	let rest = "";
	let event = { data: [] };
	try {
		for (;;) {
			const { done, value } = await reader.read();
			if (done) return;
			onbytes();
			const lines = (rest + value).split(/\r\n|\n|\r/);
			rest = lines.pop();
			yield* eventsOf(lines);
		}
	} finally {
		reader.cancel().catch(() => {});
	}
	function* eventsOf(lines) {
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

// Calls `changed` with every state that `path` streams, up to that for which `over` is true, which it returns. When the
// connection is lost it calls `lost(true)` and connects again, ever less often.
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
		// After sleep, a laptop has a dead connection and timers that stood still.
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
