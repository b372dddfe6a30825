// A live glass that fills the window: a canvas under it shows what is around it.
import { LiveGlass } from "../composite/live/live_glass.js";
import { sizeOf } from "../composite/live/webgl.js";
import { h } from "../lib/dom.js";
import { fetchSample, pictureOf, titleOf } from "./samples.js";
import { t } from "../lib/words.js";

const FREE = 0.9; // share of the frame's shorter side that has to fit into the window
const SHARPEST = 2; // device pixels per pixel of the page that are drawn around the glass
const LATE = 400; // ms after which a picture stands in for what is still coming
const TILE = 640; // pixels of the width of a video's frames around the glass

export class GlassWindow extends LiveGlass {
	#surround = h("canvas.surround", { "aria-hidden": "true" });
	#tile = h("canvas"); // the backdrop and its mirror images
	#still = h("img.glass", { alt: "", hidden: true });
	#sample;
	#pattern;
	#free = 0; // pixels of the height that nothing covers
	#choices = 0;
	monitor = h("div.monitor", { "aria-hidden": "true" }); // as large as the monitor is seen behind the glass
	status = h("p.hint", { role: "status" });

	constructor(place, signal) {
		super(h("canvas.glass", { role: "img", hidden: true }), place, signal, { endless: true, around: false });
		this.element = h("div", {
			class: "glass-window", tabindex: 0, role: "group",
			"aria-label": t("home.glass"),
		}, this.#surround, this.monitor, this.canvas, this.#still);
		if (!this.gl) this.#stand(t("home.still"));
	}

	// Shows a sample; of several, the one that was chosen last.
	async show(sample) {
		const choice = (this.#choices += 1);
		this.#still.src = pictureOf(sample);
		this.#still.alt = t("home.board", { glass: titleOf(sample) });
		this.canvas.ariaLabel = t("home.before", { glass: titleOf(sample) });
		const found = this.gl ? await this.#fetch(sample, () => choice === this.#choices) : null;
		if (choice !== this.#choices || this.signal.aborted) return;
		this.#sample = sample;
		if (this.gl && this.load(found, sample.monitor)) this.#still.hidden = true;
		this.fit(this.#free);
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
		for (const [element, times] of [[this.canvas, [1, 1]], [this.#still, [1, 1]], [this.monitor, [across, down]]]) {
			Object.assign(element.style, {
				width: `${size.width * times[0]}px`, height: `${size.height * times[1]}px`, left: `${width / 2}px`, top: `${free / 2}px`,
			});
		}
		this.canvas.hidden = !this.gl;
		this.moved();
	}

	refresh() {
		super.refresh();
		const { picture, moving } = this.backdrop;
		const [wide, high] = sizeOf(picture);
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

	draw(level) {
		super.draw(level);
		const { right, down, scale, angle } = this.place;
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

	get spread() {
		return this.monitor.getBoundingClientRect();
	}

	lost() {
		this.#stand(t("home.lost"));
	}

	// The live form of a sample. Where it takes long, and nothing is shown yet, its picture is.
	async #fetch(sample, isWanted) {
		const late = setTimeout(() => isWanted() && !this.isLive && this.#stand(t("stage.loading"), sample), LATE);
		try {
			return await fetchSample(sample, this.signal);
		} finally {
			clearTimeout(late);
			if (isWanted() && this.gl) this.status.textContent = "";
		}
	}

	// Shows the picture of a sample, and why.
	#stand(text, sample = this.#sample) {
		this.#sample = sample;
		this.fit(this.#free);
		this.canvas.hidden = true;
		this.#still.hidden = false;
		this.status.textContent = text;
	}
}
