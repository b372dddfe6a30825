// Uploads: rows with the progress of each, and the zone where files are dropped or chosen.
import { recordings } from "../lib/recordings.js";
import { fileField, h } from "../lib/dom.js";
import { STILLS, isStill, together } from "./archive.js";
import { FileUpload } from "./file_upload.js";
import { waitingFilms } from "./kept_films.js";
import { parts, t } from "../lib/words.js";

// Uploads outlive their view; the element moves to the next view that shows uploads.
export const running = h("div.uploads");
const uploads = new Set();
addEventListener("beforeunload", (event) => [...uploads].some(({ isBusy, isUnsaved }) => isBusy || isUnsaved) && event.preventDefault());

// Uploads a file; see `FileUpload`.
export function begin(file, manifest, about) {
	const upload = new FileUpload(file, manifest, about, left);
	running.append(upload.element);
	uploads.add(upload);
	return upload.begin();
}

function left(upload, view) {
	uploads.delete(upload);
	if (view && running.isConnected && !recordings.size) location.hash = view;
}

// Offers the films that were recorded here before the page was loaded.
export async function offerFilms() {
	for (const film of await waitingFilms()) begin(film.file, film.record, { ...film, stored: true });
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
