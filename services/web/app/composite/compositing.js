// The stage of a matte, and its controls.
import { h } from "../lib/dom.js";
import { backdropChoices } from "./backdrops/backdrop_choices.js";
import { builtIn } from "./backdrops/backdrops.js";
import { clipJob } from "./clip_job.js";
import { comparison } from "./compare.js";
import { downloads } from "./downloads.js";
import { explanation } from "./explain.js";
import { handleGestures, placementControls } from "./placement.js";
import { NAMES } from "./backdrops/scenery.js";
import { Stage } from "./stage.js";
import { t } from "../lib/words.js";
import { recordButton } from "./recording.js";

// The section, and its stage. `others` are mattes to compare with, by a name.
export function compositing(matte, others, signal) {
	const given = Object.fromEntries(new URLSearchParams(location.hash.split("?")[1]));
	const controls = placementControls(() => stage.moved(), given);
	const stage = new Stage(matte, controls.values, signal);
	const explained = explanation(stage, matte, signal); // before the keys that move the backdrop: it keeps some to itself
	handleGestures(stage.element, controls, stage);
	const [around, opaque] = aroundControl(stage, given.around !== "nothing");
	keepInUrl(stage, controls, matte, signal);

	const video = clipJob(matte, () => ({ ...controls.values, around: stage.around ? "backdrop" : "nothing", fit: "frame" }), signal);
	const taken = downloads(stage, matte, signal);
	const play = playButton(stage);
	let used; // the control of the backdrop that is shown
	async function use(promise, control) {
		const backdrop = await stage.use(promise);
		if (backdrop === false && used) used.checked = true;
		if (!backdrop) return;
		used = control;
		video.choose(backdrop.clip);
		play.choose(backdrop);
		return backdrop;
	}
	const first = NAMES.includes(given.backdrop) ? given.backdrop : NAMES[0];
	const choices = backdropChoices(matte, stage.element, { use, all: taken.all, first }, signal);
	use(builtIn(first, matte.monitor), choices[0].querySelector(":checked"));

	const keys = h("button", { type: "button", onclick: () => document.getElementById("keys").showModal() }, t("keys"));
	const full = h("button", { type: "button" }, t("full"));
	const folded = (title, ...about) => h("details", h("summary", title), about);
	const sheet = h("details.panel.sheet", { open: true }, h("summary", t("controls")),
		h("div.row", full, play.button, recordButton(stage, matte, signal), explained.button, controls.reset, keys, around),
		stage.status, explained.panel, choices,
		folded(t("placement"), h("p.hint", t("placement.how")), controls.sliders),
		folded(t("compare"), comparison(stage, matte, others)), folded(t("take"), opaque, taken.element), video.element, stage.renderer);
	return { section: fillable(stage.element, sheet, full), stage };
}

// The checkbox that leaves what is around the glass transparent, and what says why there is none.
function aroundControl(stage, around) {
	const transparent = h("input", { type: "checkbox", checked: !around });
	const control = h("label", transparent, " ", t("transparent"));
	const opaque = h("p.hint", { hidden: true }, t("transparent.none"));
	transparent.onchange = () => stage.putAround(!transparent.checked);
	stage.element.addEventListener("unmasked", () => {
		control.hidden = true;
		opaque.hidden = false;
	});
	stage.around = around;
	return [control, opaque];
}

// A reload and a link show the same, as far as the backdrop is a built-in one.
function keepInUrl(stage, controls, matte, signal) {
	const view = `#/mattes/${matte.id}`;
	stage.element.addEventListener("exact", () => {
		// Another view may be in the URL already, whose event is still to come: it must not be replaced.
		if (signal.aborted || location.hash.split("?")[0] !== view) return;
		const state = new URLSearchParams(controls.moved);
		const { name } = stage.backdrop;
		if (NAMES.includes(name) && name !== NAMES[0]) state.set("backdrop", name);
		if (!stage.around) state.set("around", "nothing");
		history.replaceState(history.state, "", `${view}${state.size ? `?${state}` : ""}`);
	});
}

// The button that pauses a backdrop that moves, and what shows it for one that was chosen.
function playButton(stage) {
	const button = h("button", {
		type: "button", hidden: true,
		onclick: async () => {
			await stage.pauseOrPlay();
			button.textContent = t(stage.playing ? "pause" : "play");
		},
	}, t("pause"));
	return {
		button,
		choose({ moving }) {
			button.hidden = !moving;
			button.textContent = t("pause");
		},
	};
}

// The section of a picture and its controls, which fill the screen at the button `full`.
function fillable(picture, sheet, full) {
	const leave = h("button.leave", { type: "button", hidden: true }, t("full.leave"));
	const section = h("section.composite", { "aria-label": t("compositing") }, picture, leave, sheet);
	const filled = (is) => {
		section.classList.toggle("full", Boolean(is));
		sheet.open = !is;
		full.hidden = Boolean(is);
		leave.hidden = !is;
		(is ? leave : full).focus({ preventScroll: true }); // the one that had the focus is hidden
	};
	// Browsers of phones let only videos fill the screen: there it is the window.
	full.onclick = () => (section.requestFullscreen ? section.requestFullscreen() : filled(true));
	leave.onclick = () => (document.fullscreenElement ? document.exitFullscreen() : filled(false));
	section.addEventListener("fullscreenchange", () => filled(document.fullscreenElement));
	return section;
}
