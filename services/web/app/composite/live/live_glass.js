// The glass as this browser draws it, by WebGL2: after each change, with fewer pixels where the device cannot keep up, and
// with all of them once nothing changes.
import { Coarseness } from "./coarseness.js";
import { createPainter, webglContext } from "./webgl.js";

const REST = 300; // ms without a change after which it `rested`

export class LiveGlass {
	#painter;
	#coarseness;
	#choices = 0;
	#frame = 0;
	#timer;
	backdrop; // as `backdrops.js` describes

	// An `endless` backdrop goes on beyond its edges. What a mask left out shows it if it is `around` the glass.
	constructor(canvas, place, signal, { endless = false, around = true } = {}) {
		Object.assign(this, { canvas, place, signal, endless, around, gl: webglContext(canvas) });
		canvas.addEventListener("webglcontextlost", () => {
			this.#painter = this.gl = undefined;
			this.lost();
		}, { signal });
		signal.addEventListener("abort", () => this.#close());
	}

	// Whether this browser draws this matte before this backdrop.
	get isLive() {
		return Boolean(this.#painter && this.backdrop?.picture);
	}

	// Where the backdrop stands before the monitor.
	get placed() {
		return this.#painter?.placed(this.place) ?? this.place;
	}

	// The size on the page of a backdrop of scale 1.
	get spread() {
		const { width, height } = this.canvas.parentElement.getBoundingClientRect();
		const [right, down] = this.#painter?.pace ?? [1, 1];
		return { width: width / right, height: height / down };
	}

	get playing() {
		return Boolean(this.backdrop?.moving && !this.backdrop.moving.paused);
	}

	// Takes a matte that `decodeLive` has decoded. Returns whether the graphics card can hold it.
	load(found, monitor) {
		if (!this.gl || Math.max(found.width, found.height, ...found.texture) > this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE)) return false;
		this.#painter?.close();
		this.#painter = createPainter(this.gl, found, monitor);
		this.#coarseness = new Coarseness(Math.min(found.width, found.height));
		if (this.backdrop) this.refresh();
		return true;
	}

	// Takes the backdrop that a promise brings, unless another is chosen meanwhile. Resolves with it if it was taken.
	async use(promise) {
		const choice = (this.#choices += 1);
		const backdrop = await promise.catch((error) => {
			if (choice === this.#choices) throw error;
		});
		if (choice !== this.#choices || this.signal.aborted) return void backdrop?.close?.();
		this.backdrop?.close?.();
		this.backdrop = backdrop;
		this.refresh();
		this.moved();
		return backdrop;
	}

	// Reads the backdrop's picture, or the current frame of a video.
	refresh() {
		if (this.isLive) this.#painter.setBackdrop(this.backdrop.picture);
	}

	// Draws again after the placement, the backdrop or the window has changed.
	moved() {
		clearTimeout(this.#timer);
		if (!this.playing) this.#timer = setTimeout(() => (this.#coarseness?.rest(), this.rested()), REST);
		this.request();
	}

	request() {
		this.#frame ||= requestAnimationFrame((now) => {
			this.#frame = 0;
			if (!this.isLive) return;
			if (this.playing) this.refresh();
			this.draw(this.#coarseness.next(now));
			if (this.playing) this.request();
		});
	}

	// Draws one of 4 ** level pixels.
	draw(level) {
		this.#painter.draw(this.place, level, this);
	}

	rested() {
		if (this.isLive) this.draw(0);
	}

	// Is called after the browser has lost the graphics card.
	lost() {}

	#close() {
		clearTimeout(this.#timer);
		cancelAnimationFrame(this.#frame);
		this.#painter?.close();
		this.#painter = undefined;
		this.backdrop?.close?.();
		this.gl?.getExtension("WEBGL_lose_context")?.loseContext();
	}
}
