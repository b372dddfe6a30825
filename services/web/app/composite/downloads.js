// What the user takes along: the picture as a file or in the clipboard, and composites of several pictures as a ZIP.
import { Problem, saveBlob } from "../lib/api.js";
import { button, h, problemBox } from "../lib/dom.js";
import { zip } from "../upload/zip.js";
import { fromFile } from "./backdrops/backdrops.js";
import { said, t } from "../lib/words.js";

const FORMATS = { PNG: "image/png", JPEG: "image/jpeg", EXR: "image/x-exr" };
const TIMES = 2;

// `element`, and `all`, which composites several files.
export function downloads(stage, signal) {
	const status = h("p.hint", { role: "status" });
	const problem = h("div");
	const larger = h("input", { type: "checkbox" });
	const buttons = Object.entries(FORMATS).map(([name, type]) =>
		button(name, stage.problem, async () => saveBlob(await picture(stage, type, larger.checked), `composite.${name.toLowerCase()}`)));
	// A browser cannot write EXR, and scales what is in 8 bits.
	larger.onchange = () => (buttons.at(-1).hidden = larger.checked);

	async function all(files) {
		const made = [];
		const refused = [];
		problem.replaceChildren();
		for (const [n, file] of files.entries()) {
			status.textContent = t("take.n", { n: n + 1, all: files.length });
			try {
				const backdrop = await fromFile(file);
				made.push([entryName(file.name, n), await stage.composite(FORMATS.PNG, backdrop)]);
				backdrop.close?.();
			} catch (error) {
				signal.throwIfAborted();
				refused.push(`${file.name}: ${said(error.detail ?? error.message)}`);
			}
		}
		if (made.length) saveBlob(await zip(made, signal), "composites.zip");
		status.textContent = t("take.zip", { n: made.length, all: files.length });
		if (refused.length) problem.replaceChildren(problemBox({ title: t("take.refused"), detail: refused.join("; "), entry: refused[0] }));
	}

	const copy = button(t("take.copy"), stage.problem, async () => {
		await copyPicture(stage);
		status.textContent = t("take.copied");
	});
	const element = h("div.stack", h("div.row", copy, h("span", t("take.as")), buttons,
		h("label", larger, " ", t("take.twice"))), status, problem);
	return { element, all: (files) => all(files).catch((error) => signal.aborted || problem.replaceChildren(problemBox(error))) };
}

// The composite as a file; twice as large it is smoother, and shows no more detail.
async function picture(stage, type, isLarger) {
	if (!isLarger) return stage.composite(type);
	const bitmap = await createImageBitmap(await stage.composite(FORMATS.PNG));
	const canvas = Object.assign(document.createElement("canvas"), { width: TIMES * bitmap.width, height: TIMES * bitmap.height });
	const context = canvas.getContext("2d");
	context.imageSmoothingQuality = "high";
	context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
	return new Promise((resolve) => canvas.toBlob(resolve, type, 0.95));
}

async function copyPicture(stage) {
	const title = t("take.uncopied");
	if (!navigator.clipboard?.write) {
		throw new Problem({ title, detail: t("take.insecure") });
	}
	const made = stage.composite(FORMATS.PNG);
	try {
		await navigator.clipboard.write([new ClipboardItem({ [FORMATS.PNG]: made })]);
	} catch {
		await made; // says what the service refused
		throw new Problem({ title, detail: t("take.forbidden") });
	}
}

// ASCII, and of its own for each file.
const entryName = (name, n) => `${String(n + 1).padStart(3, "0")}-${name.replace(/\.\w+$/, "").replace(/[^\w.-]+/g, "_")}.png`;
