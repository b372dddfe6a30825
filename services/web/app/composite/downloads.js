// What the user takes along: the picture as a file or in the clipboard, and composites of several pictures as a ZIP.
import { Problem, saveBlob } from "../lib/api.js";
import { button, h, problemBox } from "../lib/dom.js";
import { zip } from "../upload/zip.js";
import { fromFile } from "./backdrops/backdrops.js";
import { fileName } from "../lib/view.js";
import { said, t } from "../lib/words.js";

const FORMATS = { PNG: "image/png", JPEG: "image/jpeg", EXR: "image/x-exr" };

// `element`, and `all`, which composites several files.
export function downloads(stage, matte, signal) {
	const status = h("p.hint", { role: "status" });
	const problem = h("div");
	const larger = h("input", { type: "checkbox" });
	const buttons = Object.entries(FORMATS).map(([name, type]) =>
		button(name, stage.problem, async () => saveBlob(await stage.composite(type, { enlarge: larger.checked ? 2 : 1 }), fileName(matte, name.toLowerCase()))));

	async function all(files) {
		const made = [];
		const refused = [];
		problem.replaceChildren();
		for (const [n, file] of files.entries()) {
			status.textContent = t("take.n", { n: n + 1, all: files.length });
			try {
				const backdrop = await fromFile(file);
				made.push([entryName(file.name, n), await stage.composite(FORMATS.PNG, {}, backdrop)]);
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
