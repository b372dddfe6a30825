// Uploads: rows with the progress of each, and the zone where files are dropped or chosen.
import { Problem, ask, newKey, post, saveBlob } from "../lib/api.js";
import { recordings } from "../lib/recordings.js";
import { bytes, confirmed, duration, fileField, h, problemBox, when } from "../lib/dom.js";
import { STILLS, askForManifest, filmArchive, isFilm, isStill, stillsArchive, together } from "./archive.js";
import { forgetFilm, keepFilm, noteCapture, waitingFilms } from "./kept_films.js";
import { send } from "./tus.js";
import { crc32 } from "./zip.js";
import { parts, t } from "../lib/words.js";

const HEAD = 1 << 20; // bytes of an archive that contain its capture.json
const MATTE = "zarr.json"; // the first entry of the archive of a matte

// Uploads outlive their view; the element moves to the next view that shows uploads.
export const running = h("div.uploads");
const rows = new Set(); // of each upload, whether it is `busy`, and whether its film is `unsaved`: only in this page
addEventListener("beforeunload", (event) => [...rows].some(({ busy, unsaved }) => busy || unsaved) && event.preventDefault());

// Uploads a capture archive, or a film or stills with their capture.json; without one, asks for their program. A film was
// filmed in the view `again`. One that was recorded here has an `id`: it can be saved, is kept until its capture is ready,
// and is discarded only after a question. One with a `warning`, and stills with a `note`, wait for the user; one that is
// `stored` is kept already.
export function begin(file, manifest, { again: view = "#/film", id, at = Date.now(), warning = "", stored = false } = {}) {
	const film = { id, at, file, record: manifest, again: view, warning }; // as browsers keep it
	const state = { busy: false, unsaved: Boolean(id) && !stored };
	let saved = !id;
	if (state.unsaved) keepFilm(film).then((isKept) => (state.unsaved &&= !isKept));
	const stop = new AbortController();
	const bar = h("progress", { max: 1, value: 0, "aria-label": t("upload.of", { name: file.name }) });
	const status = h("span", { role: "status" }, t("upload.starting"));
	const problem = h("div");
	const asked = h("div");
	const again = h("button", { type: "button", hidden: true, onclick: () => work() }, t("continue"));
	const save = h("button", { type: "button", hidden: !id, onclick: () => (saveBlob(file, file.name), (state.unsaved = false), (saved = true)) }, t("film.save"));
	const end = () => (rows.delete(state), row.remove());
	const arrived = (view) => {
		end();
		if (running.isConnected && !recordings.size) location.hash = view;
	};
	const drop = async () => {
		if (!saved && !(await confirmed(t("film.delete?"), t("film.lost"), t("film.delete")))) return;
		stop.abort();
		if (id) forgetFilm(id);
		end();
	};
	const cancel = h("button", { type: "button", onclick: drop }, t(id ? "film.discard" : "cancel"));
	const row = h("section.panel", { "aria-label": file.name },
		h("p.row.spread", h("strong.name", file.name), h("span.row", again, save, cancel)), bar, status, asked, problem);
	running.append(row);
	rows.add(state);
	let archive = isFilm(file) || file.stills ? null : file;
	const once = newKey();
	let remembered;

	async function work() {
		const start = performance.now();
		let first;
		again.hidden = true;
		problem.replaceChildren();
		state.busy = true;
		try {
			if (!archive) {
				status.textContent = t(file.stills ? "stills" : "upload.film");
				manifest ??= await askForManifest(asked, isFilm(file), stop.signal);
				status.textContent = t("upload.zipping");
				archive = await (file.stills ? stillsArchive : filmArchive)(file, manifest, stop.signal);
			} else {
				const head = await headOf(archive);
				if (!/^PK[\x03\x05]/.test(head)) throw new Problem({ status: 422, title: t("upload.none"), detail: t("upload.neither", { name: file.name }) });
				if (head.startsWith(MATTE, 30)) {
					status.textContent = t("upload.matte");
					bar.removeAttribute("value");
					return arrived(`#/mattes/${(await importMatte(file, once, stop.signal)).id}`);
				}
			}
			// A film or stills with another capture.json are another archive.
			remembered ??= `envmatte-upload ${file.name} ${archive.size} ${file.lastModified} ${manifest ? await crc32(archive.slice(0, HEAD)) : ""}`;
			const upload = await send(archive, remembered, {
				filename: file.name,
				signal: stop.signal,
				progress(done) {
					first ??= done;
					const left = (archive.size - done) / ((done - first) / (performance.now() - start) || Infinity) / 1000;
					bar.value = archive.size ? done / archive.size : 1;
					status.textContent = t("of", { n: bytes(done), all: bytes(archive.size) }) + (left > 2 ? t("upload.left", { time: duration(left) }) : "");
				},
				waiting: (away, ms) => away && (status.textContent = t("upload.away", { time: duration(ms / 1000) })),
			});
			status.textContent = t("upload.checking");
			const made = await post("v1/captures", { upload }, `capture-of-${upload}`);
			localStorage.removeItem(remembered);
			stop.signal.throwIfAborted();
			if (isFilm(file)) await noteCapture(film, made.id);
			arrived(`#/captures/${made.id}`);
		} catch (error) {
			if (stop.signal.aborted) return;
			const refused = error.status >= 400 && error.status < 500 && error.status !== 401; // another key may be typed
			if (refused) localStorage.removeItem(remembered);
			status.textContent = t(refused ? "refused" : "upload.stopped");
			if (!id) cancel.textContent = t(refused ? "dismiss" : "cancel");
			again.textContent = t("continue");
			again.hidden = refused;
			problem.replaceChildren(problemBox(/^Not(Found|Readable)Error$/.test(error.name) ? unreadable(file) : error));
		} finally {
			state.busy = false;
		}
	}
	if (!warning && !stored && !file.note) return work();
	status.textContent = stored ? `${t("film.kept", { time: when(at).textContent })} ${warning}` : warning || file.note;
	again.textContent = t(file.note ? "continue" : warning ? "upload.anyway" : "upload");
	again.hidden = false;
}

// Offers the films that were recorded here before the page was loaded.
export async function offerFilms() {
	for (const film of await waitingFilms()) begin(film.file, film.record, { ...film, stored: true });
}

const unreadable = ({ name }) => ({
	title: t("upload.unreadable"),
	detail: t("upload.moved", { name }),
});

// The first bytes of a ZIP: its mark, and from byte 30 on the name of its first entry.
const headOf = async (file) => new TextDecoder("latin1").decode(await file.slice(0, 30 + MATTE.length).arrayBuffer());

async function importMatte(file, once, signal) {
	const name = new URLSearchParams({ name: file.name.replace(/\.zip$/i, "").slice(0, 200) });
	const headers = { "Content-Type": "application/zip", "Idempotency-Key": once };
	return (await ask(`v1/mattes?${name}`, { method: "POST", headers, body: file, signal })).json();
}

export function upload(files) {
	const stills = [...files].filter(isStill);
	for (const file of files) if (!isStill(file)) begin(file);
	if (stills.length) begin(together(stills));
	location.hash = "#/captures";
}

export const fileInput = (id) => fileField({ accept: `.zip,application/zip,video/*,.mkv,.mts,.m2ts,${STILLS}`, id, multiple: true }, upload);

export function dropZone() {
	const zone = h("div.drop",
		h("label", { for: "zip" }, parts("upload.drop", { choose: h("strong", t("upload.choose")) }),
			h("span.hint", t("upload.what"))),
		fileInput("zip"));
	onDrop(zone, upload);
	return h("div", zone, running);
}

export function onDrop(zone, take) {
	let depth = 0;
	const over = (by) => zone.classList.toggle("over", (depth = Math.max(0, depth + by)) > 0);
	zone.addEventListener("dragenter", (event) => (event.preventDefault(), over(1)));
	zone.addEventListener("dragleave", () => over(-1));
	zone.addEventListener("dragover", (event) => event.preventDefault());
	zone.addEventListener("drop", (event) => {
		event.preventDefault();
		depth = 0;
		over(0);
		if (event.dataTransfer.files.length) take(event.dataTransfer.files);
	});
}
