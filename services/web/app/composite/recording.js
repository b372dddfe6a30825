// Records what the stage shows as a video.
import { saveBlob } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { videoType } from "../lib/recordings.js";
import { t } from "../lib/words.js";
import { fileName } from "../lib/view.js";

const RATE = 30; // frames per second, at most
const BITS = 12e6; // per second

// The button; null where the browser cannot record. The file is named after the matte.
export function recordButton(stage, matte, signal) {
	if (!window.MediaRecorder || !HTMLCanvasElement.prototype.captureStream) return null;
	// H.264 has even sizes only. The stage's own canvas is smaller while it moves.
	const canvas = Object.assign(document.createElement("canvas"), { width: matte.width & ~1, height: matte.height & ~1 });
	const context = canvas.getContext("2d", { alpha: false });
	let recorder;

	function draw() {
		if (!recorder) return;
		context.fillRect(0, 0, canvas.width, canvas.height); // black where the picture is transparent
		context.drawImage(stage.front, 0, 0, matte.width, matte.height);
		requestAnimationFrame(draw);
	}
	function start() {
		const parts = [];
		const mine = (recorder = new MediaRecorder(canvas.captureStream(RATE), { mimeType: videoType(), videoBitsPerSecond: BITS }));
		mine.ondataavailable = ({ data }) => parts.push(data);
		mine.onstop = () => {
			const [type] = mine.mimeType.split(";");
			if (!signal.aborted) saveBlob(new Blob(parts, { type }), fileName(matte, type.endsWith("mp4") ? "mp4" : "webm"));
		};
		draw();
		mine.start();
	}
	function stop() {
		recorder?.stop();
		recorder = undefined;
	}
	signal.addEventListener("abort", stop);
	const button = h("button", {
		type: "button", "aria-pressed": "false",
		onclick() {
			if (recorder) stop();
			else start();
			button.ariaPressed = String(Boolean(recorder));
			button.textContent = t(recorder ? "video.stop" : "video.record");
		},
	}, t("video.record"));
	return button;
}
