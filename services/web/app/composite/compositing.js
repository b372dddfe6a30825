// The panel that puts the glass before a backdrop: the stage, the choice of backdrops, placement and downloads.
import { h } from "../lib/dom.js";
import { onDrop } from "../upload/upload.js";
import { NAMES, builtIn, fromFile } from "./backdrops.js";
import { clipJob } from "./clip_job.js";
import { downloads } from "./downloads.js";
import { handleGestures, placement } from "./placement.js";
import { Stage } from "./stage.js";
import { camera, clip } from "./video_backdrops.js";

const RAW = ".dng,.nef,.cr2,.cr3,.arw,.raf,.orf,.rw2"; // the usual names of camera RAW
// Browsers know no type of MKV, and give MTS that of something else.
const isVideo = (file) => file.type.startsWith("video/") || /\.(mp4|mov|mkv|webm|avi|mts|m2ts)$/i.test(file.name);

export function compositing(matte, signal) {
	const placed = placement(() => stage.moved());
	const stage = new Stage(matte, placed.values, signal);
	const video = clipJob(matte, () => placed.values, signal);
	handleGestures(stage.element, placed);

	const play = h("button", {
		type: "button", hidden: true,
		onclick: async () => {
			await stage.pauseOrPlay();
			play.textContent = stage.playing ? "Pause" : "Play";
		},
	}, "Pause");
	async function use(promise) {
		const backdrop = await stage.use(promise);
		if (!backdrop) return;
		video.choose(backdrop.clip);
		play.hidden = !backdrop.moving;
		play.textContent = "Pause";
	}
	const taken = downloads(stage, signal);
	const choices = backdropChoices(matte, stage.element, use, taken.all, signal);
	use(builtIn(NAMES[0], matte.monitor));

	return h("section", { class: "panel composite", "aria-label": "Compositing" },
		h("div", {}, stage.element, h("p", { class: "hint" }, "Drag the picture to move the backdrop; then scroll, or pinch, to scale it."),
			stage.status, stage.renderer, stage.problem),
		h("div", { class: "stack" }, choices, placed.sliders, h("p", { class: "row" }, placed.reset, play),
			taken.element, video.element));
}

// What can be a backdrop: the built-in ones, the camera, and a file that is dropped on the stage, pasted or chosen. Of
// several files `all` makes composites.
function backdropChoices(matte, stage, use, all, signal) {
	const choice = (name, make, checked = false) =>
		h("label", { class: "choice" }, h("input", { type: "radio", name: "backdrop", checked, onchange: () => use(make()) }), name);
	const builtIns = NAMES.map((name, i) => choice(name, () => builtIn(name, matte.monitor), i === 0));
	const choices = h("fieldset", { class: "row" }, h("legend", {}, "Backdrop"), builtIns, choice("Camera", camera));
	const take = (files) => {
		if (files.length > 1) return all([...files]);
		const [file] = files;
		for (const input of choices.querySelectorAll("input")) input.checked = false;
		use(isVideo(file) ? clip(file) : fromFile(file));
	};
	const input = h("input", { type: "file", id: "backdrop", multiple: true, accept: `image/*,.heic,.heif,.hif,.exr,.tif,.tiff,${RAW},video/*,.mts,.m2ts` });
	input.onchange = () => {
		if (input.files.length) take(input.files);
		input.value = "";
	};
	onDrop(stage, take);
	addEventListener("paste", ({ clipboardData }) => clipboardData?.files.length && take(clipboardData.files), { signal });
	return [choices, h("div", { class: "drop small" }, h("label", { for: "backdrop" }, h("strong", {}, "Your own picture or clip"), " drop, paste or choose it",
		h("span", { class: "hint" }, "PNG, JPEG, WebP, AVIF, GIF, HEIC, TIFF, EXR, camera RAW or a video; several pictures come back as a ZIP")), input)];
}
