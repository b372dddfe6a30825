// A live glass before a backdrop that fills the window: WebGL2 draws the glass, and a canvas under it what is around it.
import { Coarseness } from "../composite/coarseness.js";
import { createPainter, webglContext } from "../composite/webgl.js";
import { h } from "../lib/dom.js";
import { fetchSample, still } from "./samples.js";

const STILL = 200; // ms without a change after which all pixels are drawn
const SHORTEST = 240; // pixels of the shorter side that are drawn at least
const FREE = 0.9; // share of the frame's shorter side that has to fit into the window
const SHARPEST = 2; // device pixels per pixel of the page that are drawn around the glass
const TILE = 640; // pixels of the width of a video's frames around the glass

export class GlassWindow {
	#place;
	#signal;
	#surround = h("canvas", { class: "surround", "aria-hidden": "true" });
	#canvas = h("canvas", { class: "glass", role: "img", hidden: true });
	#tile = h("canvas"); // the backdrop and its mirror images
	#still = h("img", { class: "glass", alt: "", hidden: true });
	#gl;
	#painter;
	#sample;
	#backdrop; // as `backdrops.js` describes, without what the service would get
	#pattern;
	#coarseness;
	#free = 0; // pixels of the height that nothing covers
	#choices = { sample: 0, backdrop: 0 };
	#frame = 0;
	#timer;
	monitor = h("div", { class: "monitor", "aria-hidden": "true" }); // as large as the monitor is seen behind the glass
	status = h("p", { class: "hint", role: "status" });

	constructor(place, signal) {
		[this.#place, this.#signal] = [place, signal];
		this.element = h("div", {
			class: "glass-window", tabindex: 0, role: "group",
			"aria-label": "Glass. Drag to move the backdrop; arrow keys move, plus and minus scale, square brackets turn it.",
		}, this.#surround, this.monitor, this.#canvas, this.#still);
		this.#gl = webglContext(this.#canvas, true);
		if (!this.#gl) this.#stand("This browser has no WebGL2, so this picture stands still. The service draws your own glass all the same.");
		this.#canvas.addEventListener("webglcontextlost", () => this.#stand("The browser lost the graphics card, so this picture stands still. Reload the page to play."), { signal });
		signal.addEventListener("abort", () => this.#close());
	}

	// Whether this browser draws the glass.
	get isLive() {
		return Boolean(this.#gl);
	}

	// Shows a sample; of several, the one that was chosen last.
	async show(sample) {
		const choice = (this.#choices.sample += 1);
		this.#still.src = still(sample);
		this.#still.alt = `${sample.title} before a checkerboard`;
		this.#canvas.ariaLabel = `${sample.title} before the backdrop`;
		const found = this.isLive ? await fetchSample(sample, this.#signal) : null;
		if (choice !== this.#choices.sample || this.#signal.aborted) return;
		this.#sample = sample;
		if (this.isLive) {
			this.#painter?.close();
			this.#painter = createPainter(this.#gl, found, sample.monitor);
			this.#coarseness = new Coarseness(Math.max(0, Math.floor(Math.log2(Math.min(found.width, found.height) / SHORTEST))));
			if (this.#backdrop) this.#painter.setBackdrop(this.#backdrop.picture);
		}
		this.fit(this.#free);
	}

	// Takes the backdrop that a promise brings; of several, the one that was chosen last. Resolves with whether it did.
	async use(promise) {
		const choice = (this.#choices.backdrop += 1);
		const backdrop = await promise.catch((error) => {
			if (choice === this.#choices.backdrop) throw error;
		});
		if (choice !== this.#choices.backdrop || this.#signal.aborted) return void backdrop?.close?.();
		this.#backdrop?.close?.();
		this.#backdrop = backdrop;
		this.#take();
		this.moved();
	}

	// Lays the glass out in the part of the window above a height.
	fit(free) {
		this.#free = free;
		const { clientWidth: width, clientHeight: height } = this.element;
		const ratio = Math.min(devicePixelRatio, SHARPEST);
		Object.assign(this.#surround, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
		if (!this.#sample) return;
		const [wide, high] = this.#sample.monitor;
		const shorter = Math.min(width, free) / FREE;
		const [across, down] = this.#sample.seen;
		const size = { height: shorter, width: (shorter * wide * down) / (high * across) };
		for (const [element, times] of [[this.#canvas, [1, 1]], [this.#still, [1, 1]], [this.monitor, [across, down]]]) {
			Object.assign(element.style, {
				width: `${size.width * times[0]}px`, height: `${size.height * times[1]}px`, left: `${width / 2}px`, top: `${free / 2}px`,
			});
		}
		this.#canvas.hidden = !this.isLive;
		this.moved();
	}

	// Draws again after the placement, the backdrop or the window has changed.
	moved() {
		clearTimeout(this.#timer);
		if (!this.#isPlaying) {
			this.#timer = setTimeout(() => {
				this.#coarseness?.rest();
				this.#draw(0);
			}, STILL);
		}
		this.#frame ||= requestAnimationFrame((now) => this.#paint(now));
	}

	get #isPlaying() {
		return this.#backdrop?.moving && !this.#backdrop.moving.paused;
	}

	#paint(now) {
		this.#frame = 0;
		if (!this.#painter || !this.#backdrop) return;
		if (this.#isPlaying) this.#take();
		this.#draw(this.#coarseness.next(now));
		if (this.#isPlaying) this.moved();
	}

	// Takes the backdrop's picture, or the current frame of a video.
	#take() {
		const { picture, moving } = this.#backdrop;
		this.#painter?.setBackdrop(picture);
		const [wide, high] = [picture.videoWidth ?? picture.width, picture.videoHeight ?? picture.height];
		const less = moving ? Math.min(1, TILE / wide) : 1;
		const [width, height] = [Math.round(wide * less), Math.round(high * less)];
		Object.assign(this.#tile, { width: 2 * width, height: 2 * height });
		const context = this.#tile.getContext("2d");
		for (const [x, y] of [[1, 1], [-1, 1], [-1, -1], [1, -1]]) {
			context.setTransform(x, 0, 0, y, width * (1 - x), height * (1 - y));
			context.drawImage(picture, 0, 0, width, height);
		}
		this.#pattern = { width, height, fill: context.createPattern(this.#tile, "repeat") };
	}

	#draw(level) {
		if (!this.#painter || !this.#backdrop) return;
		this.#painter.draw(this.#place, level, true);
		const { right, down, scale, angle } = this.#place;
		const { width, height, fill } = this.#pattern;
		const ratio = this.#surround.width / this.element.clientWidth;
		const [wide, high] = [this.monitor.clientWidth, this.monitor.clientHeight];
		fill.setTransform(new DOMMatrix().scale(ratio)
			.translate(this.element.clientWidth / 2 + right * wide, this.#free / 2 + down * high).rotate(angle)
			.scale((scale * wide) / width, (scale * high) / height).translate(-width / 2, -height / 2));
		const context = this.#surround.getContext("2d", { alpha: false });
		context.imageSmoothingQuality = "medium";
		context.fillStyle = fill;
		context.fillRect(0, 0, this.#surround.width, this.#surround.height);
	}

	// Shows a still in place of what can't be drawn.
	#stand(text) {
		this.#painter = this.#gl = undefined;
		this.#canvas.hidden = true;
		this.#still.hidden = false;
		this.status.textContent = text;
	}

	#close() {
		clearTimeout(this.#timer);
		cancelAnimationFrame(this.#frame);
		this.#painter?.close();
		this.#painter = undefined;
		this.#backdrop?.close?.();
		this.#gl?.getExtension("WEBGL_lose_context")?.loseContext();
	}
}
