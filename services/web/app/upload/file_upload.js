// One file on its way to a capture, or to a matte if it is the archive of one.
import { Problem, ask, newKey, post, saveBlob } from "../lib/api.js";
import { confirmed, duration, when } from "../lib/dom.js";
import { askForManifest, filmArchive, isFilm, stillsArchive } from "./archive.js";
import { forgetFilm, keepFilm, noteCapture } from "./kept_films.js";
import { send } from "./tus.js";
import { UploadRow } from "./upload_row.js";
import { crc32 } from "./zip.js";
import { t } from "../lib/words.js";

const HEAD = 1 << 20; // bytes of an archive that contain its capture.json
const MATTE = "zarr.json"; // the first entry of the archive of a matte

// A capture archive, or a film or stills with their capture.json; without one, their program is asked for. A film was
// filmed in the view `again`. One that was recorded here has an `id`: it can be saved, is kept until its capture is ready,
// and is discarded only after a question. One with a `warning`, and stills with a `note`, wait for the user; one that is
// `stored` is kept already. `left` is called when the row is removed, with the view to show if the upload is done.
export class FileUpload {
	isBusy = false;
	#file;
	#manifest;
	#film; // as browsers keep it
	#isStored;
	#left;
	#isSaved;
	#archive;
	#remembered; // the name under which the browser keeps how to resume it
	#key = newKey(); // of the import of a matte: a retry makes no second one
	#stop = new AbortController();
	#row;

	constructor(file, manifest, { again = "#/film", id, at = Date.now(), warning = "", stored = false } = {}, left) {
		this.#file = file;
		this.#manifest = manifest;
		this.#film = { id, at, file, record: manifest, again, warning };
		this.#isStored = stored;
		this.#left = left;
		this.#isSaved = !id;
		this.#archive = isFilm(file) || file.stills ? null : file;
		this.#row = new UploadRow(file.name, Boolean(id), {
			start: () => this.start(),
			save: () => this.#save(),
			cancel: () => this.#cancel(),
		});
		this.element = this.#row.element;
		// Whether only this page has it.
		this.isUnsaved = Boolean(id) && !stored;
		if (this.isUnsaved) keepFilm(this.#film).then((isKept) => (this.isUnsaved &&= !isKept));
	}

	// Starts it, unless the user is to see something first.
	begin() {
		const { at, warning } = this.#film;
		const { note } = this.#file;
		if (!warning && !this.#isStored && !note) return this.start();
		this.#row.say(this.#isStored ? `${t("film.kept", { time: when(at).textContent })} ${warning}` : warning || note);
		this.#row.offer(t(note ? "continue" : warning ? "upload.anyway" : "upload"));
	}

	async start() {
		this.isBusy = true;
		this.#row.working();
		try {
			this.#leave(await this.#run());
		} catch (error) {
			if (!this.#stop.signal.aborted) this.#fail(error);
		} finally {
			this.isBusy = false;
		}
	}

	// Resolves with the view of what it has become.
	async #run() {
		const { signal } = this.#stop;
		if (!this.#archive) await this.#pack();
		else if (await isMatte(this.#archive)) {
			this.#row.sending(t("upload.matte"));
			return `#/mattes/${(await importMatte(this.#file, this.#key, signal)).id}`;
		}
		const upload = await this.#send();
		this.#row.say(t("upload.checking"));
		const capture = await post("v1/captures", { upload }, `capture-of-${upload}`);
		localStorage.removeItem(this.#remembered);
		signal.throwIfAborted();
		if (isFilm(this.#file)) await noteCapture(this.#film, capture.id);
		return `#/captures/${capture.id}`;
	}

	async #pack() {
		const { stills } = this.#file;
		const { signal } = this.#stop;
		this.#row.say(t(stills ? "stills" : "upload.film"));
		this.#manifest ??= await askForManifest(this.#row.asked, isFilm(this.#file), signal);
		this.#row.say(t("upload.zipping"));
		this.#archive = await (stills ? stillsArchive : filmArchive)(this.#file, this.#manifest, signal);
	}

	// Resolves with the id of the finished upload.
	async #send() {
		const [start, file, archive] = [performance.now(), this.#file, this.#archive];
		// A film or stills with another capture.json are another archive.
		this.#remembered ??= `envmatte-upload ${file.name} ${archive.size} ${file.lastModified} ${this.#manifest ? await crc32(archive.slice(0, HEAD)) : ""}`;
		let first; // bytes that were sent before
		return send(archive, this.#remembered, {
			filename: file.name,
			signal: this.#stop.signal,
			progress: (done) => {
				first ??= done;
				const rate = (done - first) / (performance.now() - start) || Infinity; // bytes per ms
				this.#row.sent(done, archive.size, (archive.size - done) / rate / 1000);
			},
			waiting: (away, ms) => away && this.#row.say(t("upload.away", { time: duration(ms / 1000) })),
		});
	}

	#fail(error) {
		const isRefused = error.status >= 400 && error.status < 500 && error.status !== 401; // another key may be typed
		const shown = /^Not(Found|Readable)Error$/.test(error.name) ? unreadable(this.#file) : error;
		if (!this.#film.id) this.#row.canBeDismissed(isRefused);
		if (isRefused) {
			localStorage.removeItem(this.#remembered);
			this.#row.refused(shown);
		} else this.#row.stopped(shown);
	}

	#save() {
		saveBlob(this.#file, this.#file.name);
		this.isUnsaved = false;
		this.#isSaved = true;
	}

	async #cancel() {
		if (!this.#isSaved && !(await confirmed(t("film.delete?"), t("film.lost"), t("film.delete")))) return;
		this.#stop.abort();
		if (this.#film.id) forgetFilm(this.#film.id);
		this.#leave();
	}

	#leave(view) {
		this.element.remove();
		this.#left(this, view);
	}
}

const unreadable = ({ name }) => ({
	title: t("upload.unreadable"),
	detail: t("upload.moved", { name }),
});

// Whether a ZIP is the archive of a matte, by its first bytes: its mark, and from byte 30 on the name of its first entry.
async function isMatte(file) {
	const head = new TextDecoder("latin1").decode(await file.slice(0, 30 + MATTE.length).arrayBuffer());
	if (!/^PK[\x03\x05]/.test(head)) throw new Problem({ status: 422, title: t("upload.none"), detail: t("upload.neither", { name: file.name }) });
	return head.startsWith(MATTE, 30);
}

async function importMatte(file, key, signal) {
	const name = new URLSearchParams({ name: file.name.replace(/\.zip$/i, "").slice(0, 200) });
	const headers = { "Content-Type": "application/zip", "Idempotency-Key": key };
	return (await ask(`v1/mattes?${name}`, { method: "POST", headers, body: file, signal })).json();
}
