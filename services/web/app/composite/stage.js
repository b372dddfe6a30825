// The picture of the glass before a backdrop. While something moves, WebGL2 draws it in this browser, or the service
// composites a small picture; after the last movement the service's composite at full size is shown.
import { ask } from "../lib/api.js";
import { h, newest, problemBox, show } from "../lib/dom.js";
import { Coarseness } from "./coarseness.js";
import { fetchLive } from "./live.js";
import { createPainter, webglContext } from "./webgl.js";

const STILL = 300; // ms without a change after which the exact composite is requested
const QUICK = 480; // pixels of the longer side of a preview

export class Stage {
	#matte;
	#place;
	#signal;
	#backdrop; // as `backdrops.js` describes
	#painter;
	#timer;
	#frame = 0;
	#changes = 0;
	#isExact = false; // whether the picture shows the last change at full size
	#preview = new AbortController();
	#choices = 0;
	#coarseness = new Coarseness();
	#image;
	#canvas;
	status = h("p", { class: "hint", role: "status" }, "Loading");
	renderer = h("p", { class: "hint" }, "The service draws the glass while you move, until all of it is loaded.");
	problem = h("div");

	constructor(matte, place, signal) {
		[this.#matte, this.#place, this.#signal] = [matte, place, signal];
		const { width, height } = matte;
		this.#image = h("img", { alt: "The glass before the backdrop", width, height, draggable: "false", hidden: true });
		this.#canvas = h("canvas", { role: "img", "aria-label": "The glass before the backdrop", width, height, hidden: true });
		this.element = h("div", {
			class: "picture stage", tabindex: 0, role: "group",
			"aria-label": "Composite. Drag to move the backdrop; arrow keys move, plus and minus scale, square brackets turn it.",
		}, this.#image, this.#canvas);
		this.element.style.aspectRatio = `${width} / ${height}`;
		signal.addEventListener("abort", () => this.#close());
		this.#loadPainter();
	}

	fail = (error) => this.#signal.aborted || this.problem.replaceChildren(problemBox(error));

	// Whether the backdrop is a video that plays.
	get playing() {
		return this.#backdrop.moving && !this.#backdrop.moving.paused;
	}

	// Takes the backdrop that a promise brings; of several, the one that was chosen last. Resolves with it, or with
	// nothing if another was chosen meanwhile or it failed.
	async use(promise) {
		const choice = (this.#choices += 1);
		try {
			const backdrop = await promise;
			if (choice !== this.#choices || this.#signal.aborted) return void backdrop.close?.();
			this.#backdrop?.close?.();
			this.#backdrop = backdrop;
			this.problem.replaceChildren();
			if (this.#isLive) this.#painter.setBackdrop(backdrop.picture);
			this.moved();
			return backdrop;
		} catch (error) {
			if (choice === this.#choices) this.fail(error);
		}
	}

	async pauseOrPlay() {
		const { moving, picture } = this.#backdrop;
		if (this.playing) moving.pause();
		else await moving.play().catch(this.fail);
		if (this.#isLive) this.#painter.setBackdrop(picture);
		this.moved();
	}

	// Draws again after the placement or the backdrop has changed.
	moved() {
		if (!this.#backdrop) return;
		clearTimeout(this.#timer);
		this.#changes += 1;
		this.#isExact = false;
		this.#describe(this.#isLive ? "live" : "preview");
		if (!this.playing) this.#timer = setTimeout(() => this.#stopped(), STILL);
		if (this.#isLive) this.#requestPaint();
		else this.#composite(false);
	}

	// The service's composite of the whole frame, as a file of a media type: of a backdrop, or of the one that is chosen.
	// If the service refuses its file, this browser sends a copy.
	async composite(type, backdrop = this.#backdrop) {
		const wanted = type === "image/jpeg" ? { quality: 95 } : {};
		try {
			return await this.#request(await backdrop.exact(), wanted, type);
		} catch (error) {
			if (![413, 422].includes(error.status) || !backdrop.copy) throw error;
			const copy = await backdrop.copy();
			const answer = await this.#request(copy, wanted, type);
			const why = error.status === 413 || error.limit != null ? "does not take pictures this large" : "cannot read this file";
			const { width, height } = backdrop.picture;
			backdrop.note = `. The service ${why}, so this browser sends a copy of ${width} × ${height} pixels.`;
			backdrop.exact = () => copy;
			return answer;
		}
	}

	async #request(body, wanted, type, signal = this.#signal) {
		const query = new URLSearchParams({ ...this.#place, ...wanted });
		const path = `v1/mattes/${this.#matte.id}/composite?${query}`;
		return (await ask(path, { method: "POST", headers: { Accept: type }, body, signal })).blob();
	}

	async #quick(backdrop) {
		this.#preview = new AbortController();
		const size = Math.min(QUICK, Math.max(this.#matte.width, this.#matte.height));
		const signal = AbortSignal.any([this.#signal, this.#preview.signal]);
		return this.#request(await backdrop.quick(), { quality: 80, size }, "image/jpeg", signal);
	}

	// Shows the service's composite, exact or as a preview.
	#composite = newest(async (exact) => {
		const [backdrop, changes] = [this.#backdrop, this.#changes];
		try {
			const picture = await (exact ? this.composite("image/jpeg", backdrop) : this.#quick(backdrop));
			if (backdrop !== this.#backdrop || (this.#isLive && changes !== this.#changes)) return; // the live picture is newer
			await show(this.#image, picture);
			this.#bringToFront(this.#image);
			if (exact && changes === this.#changes) {
				this.#isExact = true;
				this.#describe(`exact, ${this.#matte.width} × ${this.#matte.height} pixels${backdrop.note ?? ""}`);
			}
			this.problem.replaceChildren();
		} catch (error) {
			if (error.name !== "AbortError") this.fail(error);
		}
		if (!exact && this.playing && !this.#isLive && !this.#signal.aborted) this.#composite(false); // the next frame
	});

	// Whether this browser draws the glass before this backdrop.
	get #isLive() {
		return this.#painter && this.#backdrop.picture;
	}

	#requestPaint() {
		this.#frame ||= requestAnimationFrame((now) => this.#paint(now));
	}

	#paint(now) {
		this.#frame = 0;
		if (!this.#isLive) return;
		const level = this.#coarseness.next(now);
		if (this.playing) this.#painter.setBackdrop(this.#backdrop.picture);
		this.#painter.draw(this.#place, level);
		this.#bringToFront(this.#canvas);
		if (this.playing) this.#requestPaint();
	}

	#stopped() {
		this.#coarseness.rest();
		this.#preview.abort(); // a service that is busy may take long for it
		this.#composite(true);
	}

	#bringToFront(element) {
		this.#image.hidden = element !== this.#image;
		this.#canvas.hidden = element !== this.#canvas;
	}

	#describe(how) {
		const text = `${this.#backdrop.name}: ${how}`;
		if (this.status.textContent !== text) this.status.textContent = text;
	}

	// Loads what this browser needs to draw the glass itself, if it can.
	async #loadPainter() {
		const signal = this.#signal;
		const gl = webglContext(this.#canvas);
		if (!gl) return (this.renderer.textContent = "This browser has no WebGL2, so the service draws the glass while you move.");
		this.#canvas.addEventListener("webglcontextlost", () => this.#loseContext(), { signal });
		signal.addEventListener("abort", () => gl.getExtension("WEBGL_lose_context")?.loseContext());
		try {
			const found = await fetchLive(this.#matte.id, signal);
			if (Math.max(found.width, found.height, ...found.texture) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
				return (this.renderer.textContent = "This matte is too large for the graphics card, so the service draws it while you move.");
			}
			this.#painter = createPainter(gl, found, this.#matte.monitor);
			if (this.#backdrop?.picture) this.#painter.setBackdrop(this.#backdrop.picture);
			const some = found.step > 1 ? `, one pixel in ${found.step ** 2} of it` : "";
			this.renderer.textContent = `This browser draws the glass while you move${some}; when you stop, the service does.`;
			if (!this.#backdrop || this.#isExact) return;
			if (this.playing) return this.moved();
			// Something was moved meanwhile: the exact picture is on its way.
			this.#describe(this.#isLive ? "live" : "preview");
			this.#requestPaint();
		} catch (error) {
			this.fail(error);
		}
	}

	#loseContext() {
		this.#painter = undefined;
		this.renderer.textContent = "The browser lost the graphics card, so the service draws the glass while you move. Reload the page to draw it here again.";
		this.moved();
	}

	#close() {
		clearTimeout(this.#timer);
		cancelAnimationFrame(this.#frame);
		this.#frame = 0;
		this.#painter?.close();
		this.#backdrop?.close?.();
	}
}
