// What can be a backdrop: a built-in one, the camera, or a file that is dropped, pasted or chosen.
import { fileField, h } from "../../lib/dom.js";
import { STILLS, isFilm } from "../../upload/archive.js";
import { onDrop } from "../../upload/upload.js";
import { builtIn, fromFile } from "./backdrops.js";
import { NAMES, scenery } from "./scenery.js";
import { cameraSymbol, choice, fileSymbol, thumbOf, thumbs } from "./thumb_choices.js";
import { cameraBackdrop, clipBackdrop } from "./video_backdrops.js";
import { t } from "../../lib/words.js";

// `use(promise, control)` shows a backdrop, and resolves with it if it can be used; `all` makes composites of several
// files. Files can be dropped on the stage's element, too. `first` is the built-in one that is checked.
export function backdropChoices(matte, stage, { use, all, first }, signal) {
	const builtIns = NAMES.map((name) => choice("backdrop", t(`scene.${name}`), scenery(name, 96, 72).picture, name === first, (control) => use(builtIn(name, matte.monitor), control)));
	const camera = choice("backdrop", t("camera"), cameraSymbol(), false, (control) => use(cameraBackdrop(), control));
	const input = fileField({ multiple: true, accept: `${STILLS},video/*,.mts,.m2ts`, title: "" }, take);
	const file = h("label.thumb-choice", input, h("span.frame", fileSymbol()), h("span", t("backdrop.own")));
	const choices = thumbs(t("backdrop"), [...builtIns, camera, file]);
	let own; // the choice of the last file
	async function take(files) {
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
	}
	onDrop(stage, take);
	addEventListener("paste", ({ clipboardData }) => clipboardData?.files.length && take(clipboardData.files), { signal });
	return [choices, h("p.hint", t("backdrop.what"))];
}
