// Help before a film: what is wrong with what the camera sees, and the start once all is well.
import { badge, h, pause } from "../lib/dom.js";
import { t } from "../lib/words.js";
import { look, readFrame } from "./look.js";

const EVERY = 300; // ms between two looks
const CALM = 2000; // ms that all is well before the program starts
const WIDEST = 800; // pixels
const MOVED = 0.01; // share of the picture
const CLIPPED = 0.02; // share of the screen
const DARKEST = 90; // of white, of 255
const BLURRED = 0.15; // change from pixel to pixel, as a share of the contrast

// What is wrong by name: nothing is null, and what cannot be known yet is undefined.
export function judge({ isSeen, isWhole, brightness, clipped, sharpness, moved }) {
	return {
		screen: !isSeen ? "unseen" : isWhole ? null : "cut",
		exposure: isSeen ? (clipped > CLIPPED ? "bright" : brightness < DARKEST ? "dark" : null) : undefined,
		sharpness: isSeen ? (sharpness < BLURRED ? "blurred" : null) : undefined,
		movement: moved > MOVED ? "moves" : null,
	};
}

// The element for a `video` of the camera. While it is `on`, looks at it, and calls `start` once when all is well.
export function aiming(video, signal, start) {
	const meter = h("meter", { min: 0, max: 255, low: DARKEST, high: 245, optimum: 180, value: 0, "aria-label": t("aim.exposure") });
	const rows = Object.fromEntries(["screen", "exposure", "sharpness", "movement"].map((name) => [name, h("li")]));
	const itself = h("input", { type: "checkbox", checked: true });
	const element = h("div.stack", { hidden: true }, h("ul.findings.aim", { "aria-label": t("aim") }, Object.values(rows)),
		h("label.row", t("aim.exposure"), meter), h("label", itself, " ", t("aim.itself")));
	const context = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
	let isOn = false;

	function show(found, wrong) {
		meter.value = found.brightness ?? 0;
		for (const [name, row] of Object.entries(rows)) {
			const level = wrong[name] === undefined ? "waiting" : wrong[name] ? "warning" : "good";
			const text = t(`aim.${name}.${wrong[name] ?? (wrong[name] === null ? "good" : "unknown")}`);
			if (row.dataset.text === text) continue; // a screen reader would read it again
			row.dataset.text = text;
			row.replaceChildren(badge(level), h("p", text));
		}
	}
	async function watch() {
		let before;
		let wellSince;
		while (isOn) {
			if (video.videoWidth && !document.hidden) {
				const frame = readFrame(video, context, WIDEST);
				const found = look(frame, before);
				const wrong = judge(found);
				before = frame;
				show(found, wrong);
				const isWell = Object.values(wrong).every((one) => one === null);
				wellSince = isWell ? (wellSince ?? performance.now()) : undefined;
				if (isWell && itself.checked && performance.now() - wellSince > CALM) {
					wellSince = Infinity;
					start();
				}
			}
			await pause(EVERY, signal);
		}
	}
	return {
		element,
		set on(is) {
			element.hidden = !is;
			if (is && !isOn) {
				isOn = true;
				watch().catch((error) => signal.aborted || reportError(error));
			}
			isOn = is;
		},
	};
}
