// The picture of the glass. While something moves, this browser draws it, or the service composites a small picture; then
// the service's composite at full size is shown.
import { RETRY, ask, getComposite, received } from "../lib/api.js";
import { h, newest, pause, problemBox, show } from "../lib/dom.js";
import { decodeLive } from "./live/live_form.js";
import { LiveGlass } from "./live/live_glass.js";
import { t } from "../lib/words.js";

const QUICK = 480; // pixels of the longer side of a preview

// Its element sends `moved` before a change, `exact` when the picture shows it at full size, and `unmasked` if there is
// nothing that a mask left out.
export class Stage extends LiveGlass {
	#matte;
	#changes = 0;
	isExact = false; // whether the picture shows the last change at full size
	#preview = new AbortController();
	#image;
	status = h("p.hint", { role: "status" }, t("stage.loading"));
	renderer = h("p.hint", t("stage.until"));
	problem = h("div");

	constructor(matte, place, signal) {
		const { width, height } = matte;
		super(h("canvas", { role: "img", "aria-label": t("stage.alt"), width, height, hidden: true }), place, signal);
		this.#matte = matte;
		this.#image = h("img", { alt: t("stage.alt"), width, height, draggable: "false", hidden: true });
		this.element = h("div", {
			class: "picture stage", tabindex: 0, role: "group",
			"aria-label": t("stage.how"),
		}, this.#image, this.canvas, this.problem);
		this.element.style.setProperty("--aspect", width / height);
		this.fetch();
	}

	fail = (error) => {
		if (this.signal.aborted) return;
		const box = problemBox(error);
		if (box.textContent === this.problem.textContent) return; // it was tried again
		this.problem.replaceChildren(box);
		this.problem.scrollIntoView({ block: "nearest" });
	};

	// Tries again later what failed, if that may help.
	#later(error, work) {
		if (error.isTemporary) pause(RETRY, this.signal).then(work, () => {}); // the user left the view
	}

	// False if the backdrop cannot be used.
	async use(promise) {
		const backdrop = await super.use(promise).catch((error) => (this.fail(error), false));
		if (backdrop) this.problem.replaceChildren();
		return backdrop;
	}

	async pauseOrPlay() {
		const { moving } = this.backdrop;
		if (this.playing) moving.pause();
		else await moving.play().catch(this.fail);
		this.refresh();
		this.moved();
	}

	moved() {
		if (!this.backdrop) return;
		this.#changes += 1;
		this.isExact = false;
		this.element.dispatchEvent(new Event("moved"));
		this.#describe(t(this.isLive ? "stage.live" : "stage.preview"));
		super.moved();
		if (!this.isLive) this.#composite(false);
	}

	putAround(around) {
		this.around = around;
		this.moved();
	}

	// The live picture with all of its pixels, behind what is shown; `bare` is it without the glass.
	drawn(bare = false) {
		this.bare = bare;
		super.draw(0);
		this.bare = false;
		return this.canvas;
	}

	// The service's composite of the whole frame. If it refuses the backdrop's file, this browser sends a copy.
	async composite(type, more = {}, backdrop = this.backdrop, matte = this.#matte.id) {
		const wanted = type === "image/jpeg" ? { quality: 95, ...more } : more;
		try {
			return await this.#request(await backdrop.exact(), wanted, type, this.signal, matte);
		} catch (error) {
			if (![413, 422].includes(error.status) || !backdrop.copy) throw error;
			const copy = await backdrop.copy();
			const answer = await this.#request(copy, wanted, type, this.signal, matte);
			const why = error.status === 413 || error.limit != null ? "stage.large" : "stage.unread";
			const { width, height } = backdrop.picture;
			backdrop.note = `. ${t(why, { width, height })}`;
			backdrop.exact = () => copy;
			return answer;
		}
	}

	#request(body, wanted, type, signal = this.signal, matte = this.#matte.id) {
		const around = this.around ? "backdrop" : "nothing";
		return getComposite(matte, { ...this.place, around, fit: "frame", ...wanted }, type, body, signal);
	}

	async #quick(backdrop) {
		this.#preview = new AbortController();
		const size = Math.min(QUICK, Math.max(this.#matte.width, this.#matte.height));
		const signal = AbortSignal.any([this.signal, this.#preview.signal]);
		return this.#request(await backdrop.quick(), { quality: 80, size }, this.#shown, signal);
	}

	get #shown() {
		return this.around ? "image/jpeg" : "image/png"; // which can be transparent
	}

	// Shows the service's composite, exact or as a preview.
	#composite = newest(async (exact) => {
		const [backdrop, changes] = [this.backdrop, this.#changes];
		try {
			const picture = await (exact ? this.composite(this.#shown, {}, backdrop) : this.#quick(backdrop));
			if (backdrop !== this.backdrop || (this.isLive && changes !== this.#changes)) return; // the live picture is newer
			await show(this.#image, picture);
			this.#bringToFront(this.#image);
			if (exact && changes === this.#changes) {
				this.isExact = true;
				this.element.dispatchEvent(new Event("exact"));
				this.#describe(t("stage.exact", this.#matte) + (backdrop.note ?? ""));
			}
			this.problem.replaceChildren();
		} catch (error) {
			if (error.name !== "AbortError") {
				this.#describe(t(this.isLive ? "stage.live" : "stage.failed"));
				this.fail(error);
				if (exact) this.#later(error, () => changes === this.#changes && this.#composite(true));
			}
		}
		if (!exact && this.playing && !this.isLive && !this.signal.aborted) this.#composite(false); // the next frame
	});

	draw(level) {
		super.draw(level);
		this.#bringToFront(this.canvas);
	}

	rested() {
		this.#preview.abort(); // a service that is busy may take long for it
		this.#composite(true);
	}

	// The picture or the canvas that is in front.
	get front() {
		return this.canvas.hidden ? this.#image : this.canvas;
	}

	#bringToFront(element) {
		this.#image.hidden = element !== this.#image;
		this.canvas.hidden = element !== this.canvas;
	}

	#describe(how) {
		const text = `${this.backdrop.label ?? this.backdrop.name}: ${how}`;
		if (this.status.textContent !== text) this.status.textContent = text;
	}

	// Shows what was recovered since the last picture, unless something moves.
	renew() {
		if (this.isExact) this.#composite(true);
	}

	// Loads what this browser needs to draw the glass itself, if it can; again once all of it is recovered.
	async fetch() {
		const say = (text) => (this.renderer.textContent = text);
		if (!this.gl) return say(t("stage.nogl"));
		try {
			const found = decodeLive(await received((await ask(`v1/mattes/${this.#matte.id}/live`, { signal: this.signal })).arrayBuffer(), this.signal));
			if (!this.load(found, this.#matte.monitor)) {
				if (this.gl) say(t("stage.toolarge"));
				return;
			}
			if (!found.isMasked) this.element.dispatchEvent(new Event("unmasked"));
			const step = found.step * (this.#matte.preview ?? 1);
			say(t(step > 1 ? "stage.some" : "stage.all", { n: step ** 2 }));
			if (this.isExact) this.problem.replaceChildren();
			if (!this.backdrop || this.isExact) return;
			if (this.playing) return this.moved();
			// Something was moved meanwhile: the exact picture is on its way.
			this.#describe(t(this.isLive ? "stage.live" : "stage.preview"));
			this.request();
		} catch (error) {
			this.fail(error);
			this.#later(error, () => this.fetch());
		}
	}

	lost() {
		this.renderer.textContent = t("stage.lost");
		this.moved();
	}
}
