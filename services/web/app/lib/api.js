// Requests to the service, with the key of this session.

import { pause } from "./dom.js";
import { t } from "./words.js";

const TEMPORARY = [0, 429, 502, 503, 504]; // the service is unreachable, busy or starting
export const RETRY = 5000; // ms until what failed like this is tried again
const KEY = "envmatte-key"; // the player page keeps it under the same name

export class Problem extends Error {
	constructor({ title, detail, status, field, entry, limit }) {
		super(detail);
		Object.assign(this, { title, detail, status, field, entry, limit });
	}

	// Whether the same request may succeed later, without a change.
	get isTemporary() {
		return TEMPORARY.includes(this.status);
	}
}

const unreachable = () => new Problem({ status: 0, title: t("away"), detail: t("away.check") });

export const key = () => sessionStorage.getItem(KEY);

// Characters that no header can hold are replaced: the key is unknown to the service either way.
export const authorization = () => (key() ? { Authorization: `Bearer ${key().replace(/[^\x20-\xff]/g, "?")}` } : {});

let asking;

// Asks the user for a key; all requests that are refused meanwhile wait for the same dialog.
export function unlock(problem) {
	asking ??= new Promise((resolve, reject) => {
		const dialog = document.getElementById("unlock");
		const field = document.getElementById("key");
		document.getElementById("unlock-why").textContent = key() ? t("unlock.unknown") : "";
		field.value = "";
		dialog.onsubmit = () => {
			sessionStorage.setItem(KEY, field.value.trim());
			resolve();
		};
		dialog.onclose = () => {
			asking = undefined;
			reject(new Problem({ ...problem, title: t("unlock.title"), detail: t("unlock.cancelled") })); // has no effect once a key was given
		};
		dialog.showModal();
	});
	return asking;
}

// Fetches once more where no answer came: when the network changes, browsers abort what is under way. What this app sends
// may come twice: it creates nothing, has an Idempotency-Key, or asks for a state that is reached already.
async function fetchTwice(path, options) {
	try {
		return await fetch(path, options);
	} catch (error) {
		if (options.signal?.aborted) throw error;
		await pause(500, options.signal);
		return fetch(path, options);
	}
}

// What a connection brings, an answer or its body; throws a Problem if it breaks.
export const received = (promise, signal) => promise.catch(() => {
	throw signal?.aborted ? signal.reason : unreachable();
});

// Requests a path: resolves with the response, or throws a Problem as the API words it.
export async function request(path, options = {}) {
	const answer = await received(fetchTwice(path, { ...options, headers: { ...options.headers, ...authorization() } }), options.signal);
	if (answer.ok) return answer;
	throw new Problem(await describe(answer));
}

// The same, asking for a key where needed.
export async function ask(path, options) {
	for (;;) {
		const used = key();
		try {
			return await request(path, options);
		} catch (error) {
			if (error.status !== 401) throw error;
			if (used === key()) await unlock(error);
		}
	}
}

async function describe(answer) {
	const about = answer.headers.get("content-type")?.includes("json") ? await answer.json().catch(() => ({})) : {};
	if (answer.status === 404) about.detail = t("gone"); // the service says it for those who call it
	return { title: answer.statusText || t("refused"), detail: t("answered", { status: answer.status }), ...about, status: answer.status };
}

export const getJson = async (path, signal) => received((await ask(path, { signal })).json(), signal);

export const getBlob = async (path, signal) => received((await ask(path, { signal })).blob(), signal);

export const getComposite = async (id, query, type, body, signal) =>
	received((await ask(`v1/mattes/${id}/composite?${new URLSearchParams(query)}`, { method: "POST", headers: { Accept: type }, body, signal })).blob(), signal);

export const newKey = () => crypto.randomUUID?.() ?? String(Math.random());

// Posts JSON with an Idempotency-Key: a double click or a retry creates one thing.
export async function post(path, body, once = newKey()) {
	const headers = { "Content-Type": "application/json", "Idempotency-Key": once };
	return received((await ask(path, { method: "POST", headers, body: JSON.stringify(body) })).json());
}

const send = (method, path, body) => ask(path, { method, headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

export const patchJson = async (path, body) => received((await send("PATCH", path, body)).json());

export const putJson = (path, body) => send("PUT", path, body);

// Deletes; something that another tab has deleted already counts as deleted.
export const remove = (path, options) => ask(path, { method: "DELETE", ...options }).catch((error) => {
	if (error.status !== 404) throw error;
});

// Saves a response as a file. Without a key the browser streams it to the disk itself.
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

// The `url` where other devices find this service, or the `problem` why they cannot, in words.
export async function elsewhere(signal) {
	const isHere = /^(localhost|127\.|\[::1\]$)/.test(location.hostname);
	return isHere ? getJson("v1/network", signal) : { url: new URL(".", location.href.split("#")[0]).href.replace(/\/$/, "") };
}
