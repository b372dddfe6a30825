// The row of an upload: how much of it is sent, what is wrong with it, and what can be done about it.
import { bytes, duration, h, problemBox } from "../lib/dom.js";
import { t } from "../lib/words.js";

export class UploadRow {
	asked = h("div"); // for what the upload has to ask
	#status = h("span", { role: "status" }, t("upload.starting"));
	#problem = h("div");
	#bar;
	#start;
	#cancel;

	// `start`, `save` and `cancel` are what its buttons do; only what was recorded here has one to save.
	constructor(name, isRecording, { start, save, cancel }) {
		this.#bar = h("progress", { max: 1, value: 0, "aria-label": t("upload.of", { name }) });
		this.#start = h("button", { type: "button", hidden: true, onclick: start }, t("continue"));
		this.#cancel = h("button", { type: "button", onclick: cancel }, t(isRecording ? "film.discard" : "cancel"));
		const toSave = h("button", { type: "button", hidden: !isRecording, onclick: save }, t("film.save"));
		this.element = h("section.panel", { "aria-label": name },
			h("p.row.spread", h("strong.name", name), h("span.row", this.#start, toSave, this.#cancel)),
			this.#bar, this.#status, this.asked, this.#problem);
	}

	say(text) {
		this.#status.textContent = text;
	}

	// Offers to start, or to go on.
	offer(label) {
		this.#start.textContent = label;
		this.#start.hidden = false;
	}

	working() {
		this.#start.hidden = true;
		this.#problem.replaceChildren();
	}

	// Shows that something is sent whose progress is not known.
	sending(text) {
		this.say(text);
		this.#bar.removeAttribute("value");
	}

	// Shows how much is sent, and how long the rest takes.
	sent(done, size, seconds) {
		this.#bar.value = size ? done / size : 1;
		this.say(t("of", { n: bytes(done), all: bytes(size) }) + (seconds > 2 ? t("upload.left", { time: duration(seconds) }) : ""));
	}

	refused(error) {
		this.say(t("refused"));
		this.#problem.replaceChildren(problemBox(error));
	}

	// Shows why it stopped, and offers to go on.
	stopped(error) {
		this.say(t("upload.stopped"));
		this.offer(t("continue"));
		this.#problem.replaceChildren(problemBox(error));
	}

	// There is nothing to cancel any more, or there is again.
	canBeDismissed(is) {
		this.#cancel.textContent = t(is ? "dismiss" : "cancel");
	}
}
