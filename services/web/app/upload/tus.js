// Resumable uploads by tus 1.0 (https://tus.io/protocols/resumable-upload).
import { Problem, ask, authorization } from "../lib/api.js";
import { readArchiveInfo } from "./archive_info.js";
import { pause } from "../lib/dom.js";
import { t } from "../lib/words.js";

const PART = 8 << 20; // bytes of a request; the service takes 10,000 of them
const LONGEST = 30_000; // ms between two attempts
const TUS = { "Tus-Resumable": "1.0.0" };
const OTHER_OFFSET = 409; // the service has more bytes than assumed

// A PATCH request that reports its progress, which `fetch` cannot.
function patch(path, offset, part, progress, signal) {
	return new Promise((resolve, reject) => {
		const request = new XMLHttpRequest();
		const stop = () => request.abort();
		request.open("PATCH", path);
		const type = { "Content-Type": "application/offset+octet-stream", "Upload-Offset": offset };
		for (const [name, value] of Object.entries({ ...TUS, ...type, ...authorization() })) request.setRequestHeader(name, value);
		request.upload.onprogress = (event) => progress(offset + event.loaded);
		request.onload = () => {
			if (request.status === 204) return resolve(Number(request.getResponseHeader("Upload-Offset")));
			const about = { title: t("refused"), detail: t("answered", { status: request.status }), status: request.status };
			try {
				Object.assign(about, JSON.parse(request.responseText));
			} catch {} // from a proxy, which does not answer with JSON
			reject(new Problem(about));
		};
		request.onerror = () => reject(new Problem({ status: 0, title: t("broke") }));
		request.onabort = () => reject(signal.reason);
		request.onloadend = () => signal.removeEventListener("abort", stop);
		signal.addEventListener("abort", stop);
		request.send(part);
	});
}

async function offsetOf(id, signal) {
	const answer = await ask(`v1/uploads/${id}`, { method: "HEAD", headers: TUS, signal });
	return Number(answer.headers.get("Upload-Offset"));
}

const isCapture = (id, signal) => ask(`v1/captures/${id}`, { signal }).then(() => true, () => false);

// Values of tus are bytes in Base64.
const encoded = (value) => btoa(String.fromCharCode(...new TextEncoder().encode(value)));

// Sends a file, from where an upload of it was interrupted; returns the upload's id. `filename` may be that of a film.
export async function send(file, remembered, { filename, signal, progress, waiting }) {
	let id = localStorage.getItem(remembered);
	let offset = 0;
	let wait = 1000;
	let lost = Boolean(id);
	for (;;) {
		try {
			if (lost) offset = await offsetOf(id, signal);
			if (!id) {
				const metadata = Object.entries({ ...(await readArchiveInfo(file)), filename }).map(([name, value]) => `${name} ${encoded(value)}`);
				const headers = { ...TUS, "Upload-Length": file.size, "Upload-Metadata": metadata.join(",") };
				const answer = await ask("v1/uploads", { method: "POST", headers, signal });
				id = answer.headers.get("Location").split("/").at(-1);
				localStorage.setItem(remembered, id);
			}
			lost = false;
			waiting(false);
			while (offset < file.size) {
				const part = await file.slice(offset, offset + PART).arrayBuffer(); // throws if the file is gone, which is not a lost connection
				signal.throwIfAborted();
				offset = await patch(`v1/uploads/${id}`, offset, part, progress, signal);
				progress(offset);
				wait = 1000;
			}
			return id;
		} catch (error) {
			signal.throwIfAborted();
			const isPart = id && !lost;
			lost = Boolean(id);
			if (id && [404, 410].includes(error.status)) {
				if (await isCapture(id, signal)) return id; // another tab has finished it
				id = null; // expired: start again
				offset = 0;
				lost = false;
				continue;
			}
			if (error.status === 401 && isPart) continue; // `ask` asks for a key when it requests the offset
			if (!error.isTemporary && error.status !== OTHER_OFFSET) throw error;
			const end = performance.now() + wait;
			for (let left = wait; left > 0; left = end - performance.now()) {
				waiting(true, left);
				await pause(Math.min(left, 1000), signal);
			}
			wait = Math.min(2 * wait, LONGEST);
		}
	}
}
