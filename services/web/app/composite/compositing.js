// The stage of a matte, and its controls.
import { fileField, h } from "../lib/dom.js";
import { STILLS, isFilm } from "../upload/archive.js";
import { onDrop } from "../upload/upload.js";
import { builtIn, fromFile } from "./backdrops/backdrops.js";
import { clipJob } from "./clip_job.js";
import { comparison } from "./compare.js";
import { downloads } from "./downloads.js";
import { explanation } from "./explain.js";
import { handleGestures, placementControls } from "./placement.js";
import { NAMES, scenery } from "./backdrops/scenery.js";
import { Stage } from "./stage.js";
import { cameraSymbol, choice, thumbOf, thumbs } from "./backdrops/thumb_choices.js";
import { cameraBackdrop, clipBackdrop } from "./backdrops/video_backdrops.js";
import { parts, t } from "../lib/words.js";
import { recordButton } from "./recording.js";

// The section, and its stage. `others` are mattes to compare with, by a name.
export function compositing(matte, others, signal) {
	const given = Object.fromEntries(new URLSearchParams(location.hash.split("?")[1]));
	const controls = placementControls(() => stage.moved(), given);
	const stage = new Stage(matte, controls.values, signal);
	const explained = explanation(stage, matte, signal);
	const video = clipJob(matte, () => ({ ...controls.values, around: stage.around ? "backdrop" : "nothing", fit: "frame" }), signal);
	handleGestures(stage.element, controls, stage);

	const play = h("button", {
		type: "button", hidden: true,
		onclick: async () => {
			await stage.pauseOrPlay();
			play.textContent = t(stage.playing ? "pause" : "play");
		},
	}, t("pause"));
	let used; // the control of the backdrop that is shown
	async function use(promise, control) {
		const backdrop = await stage.use(promise);
		if (backdrop === false && used) used.checked = true;
		if (!backdrop) return;
		used = control;
		video.choose(backdrop.clip);
		play.hidden = !backdrop.moving;
		play.textContent = t("pause");
		return backdrop;
	}
	const transparent = h("input", { type: "checkbox", checked: given.around === "nothing" });
	transparent.onchange = () => stage.putAround(!transparent.checked);
	const unmasked = h("span.hint", { hidden: true }, t("transparent.none"));
	stage.element.addEventListener("unmasked", () => {
		transparent.disabled = true;
		unmasked.hidden = false;
	});
	stage.around = !transparent.checked;
	const first = NAMES.includes(given.backdrop) ? given.backdrop : NAMES[0];

	// A reload and a link show the same, as far as the backdrop is a built-in one.
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
	const taken = downloads(stage, matte, signal);
	const choices = backdropChoices(matte, stage.element, use, taken.all, first, signal);
	use(builtIn(first, matte.monitor), choices[0].querySelector(":checked"));

	const filled = (is) => {
		section.classList.toggle("full", Boolean(is));
		sheet.open = !is;
		full.hidden = Boolean(is);
		leave.hidden = !is;
		(is ? leave : full).focus({ preventScroll: true }); // the one that had the focus is hidden
	};
	// Browsers of phones let only videos fill the screen: there it is the window.
	const full = h("button", { type: "button", onclick: () => (section.requestFullscreen ? section.requestFullscreen() : filled(true)) }, t("full"));
	const leave = h("button.leave", { type: "button", hidden: true, onclick: () => (document.fullscreenElement ? document.exitFullscreen() : filled(false)) }, t("full.leave"));
	const keys = h("button", { type: "button", onclick: () => document.getElementById("keys").showModal() }, t("keys"));
	const folded = (title, ...about) => h("details", h("summary", title), about);
	const sheet = h("details.panel.sheet", { open: true }, h("summary", t("controls")),
		h("div.row", full, play, recordButton(stage, matte, signal), explained.button, controls.reset, keys, h("label", transparent, " ", t("transparent")), unmasked),
		stage.status, explained.panel, choices,
		folded(t("placement"), h("p.hint", t("placement.how")), controls.sliders),
		folded(t("compare"), comparison(stage, matte, others)), folded(t("take"), taken.element), video.element, stage.renderer);
	const section = h("section.composite", { "aria-label": t("compositing") }, stage.element, leave, sheet);
	section.addEventListener("fullscreenchange", () => filled(document.fullscreenElement));
	return { section, stage };
}

// What can be a backdrop: a built-in one, the camera, or a file that is dropped, pasted or chosen. Of several files `all`
// makes composites.
function backdropChoices(matte, stage, use, all, first, signal) {
	const builtIns = NAMES.map((name) => choice("backdrop", t(`scene.${name}`), scenery(name, 96, 72).picture, name === first, (control) => use(builtIn(name, matte.monitor), control)));
	const choices = thumbs(t("backdrop"), [...builtIns, choice("backdrop", t("camera"), cameraSymbol(), false, (control) => use(cameraBackdrop(), control))]);
	let own; // the choice of the last file
	const take = async (files) => {
		if (files.length > 1) return all([...files]);
		const [file] = files;
		const open = () => (isFilm(file) ? clipBackdrop(file) : fromFile(file));
		const place = h("span");
		const next = choice("backdrop", file.name || t("backdrop.pasted"), place, false, (control) => use(open(), control));
		const control = next.querySelector("input");
		const taken = await use(open(), control);
		if (!taken) return;
		own?.remove();
		choices.lastChild.append((own = next));
		place.replaceWith(thumbOf(taken));
		control.checked = true;
	};
	const input = fileField({ id: "backdrop", multiple: true, accept: `${STILLS},video/*,.mts,.m2ts` }, take);
	onDrop(stage, take);
	addEventListener("paste", ({ clipboardData }) => clipboardData?.files.length && take(clipboardData.files), { signal });
	return [choices, h("div.drop.small", h("label", { for: "backdrop" }, parts("backdrop.drop", { own: h("strong", t("backdrop.own")) }),
		h("span.hint", t("backdrop.what"))), input)];
}
