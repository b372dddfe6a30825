// Makes a capture archive of a film or of stills: asks which program they show, and puts all into one ZIP.
import { Problem, getJson } from "../lib/api.js";
import { h, size, when } from "../lib/dom.js";
import { countPatterns } from "./archive_info.js";
import { zip } from "./zip.js";
import { parts, t } from "../lib/words.js";

const RAW = /\.(dng|nef|cr2|cr3|arw|raf|orf|rw2)$/i;
const LAST = 9999; // number that a camera gives a still
const ENDS = /\.(mp4|m4v|mov|mkv|webm|avi|3gp|mts|m2ts)$/i;
// Browsers know no type of MKV, and give MTS that of something else.
export const isFilm = (file) => file.type.startsWith("video/") || ENDS.test(file.name);
// What a field for files takes: the last are the usual names of camera RAW.
export const STILLS = "image/*,.heic,.heif,.hif,.exr,.hdr,.tif,.tiff,.dng,.nef,.cr2,.cr3,.arw,.raf,.orf,.rw2";
const STILL_ENDS = new RegExp(`(${STILLS.split(",").slice(1).join("|").replaceAll(".", "\\.")})$`, "i");
export const isStill = (file) => file.type.startsWith("image/") || STILL_ENDS.test(file.name);

export const programName = (program) => t(program.display ? "program.screen" : "program.plain", { n: program.patterns, size: size(program.display ?? {}) });

// The capture.json of a film of a program, shown by the player page or as a video.
export function filmManifestOf(program, rate) {
	const border = program.showing?.border ?? program.display;
	const video = { patterns_per_second: rate, ...(border && { border }) };
	return { ...stillsManifestOf(program), video };
}

export const stillsManifestOf = ({ program }) => ({ format: "envmatte-capture/1", program });

export async function filmArchive(film, manifest, signal) {
	const file = `film${ENDS.exec(film.name)?.[0].toLowerCase() ?? ".mp4"}`;
	const name = manifest.name || film.name.replace(/\.\w+$/, "").slice(0, 200);
	const text = JSON.stringify({ ...manifest, name, video: { ...manifest.video, file } });
	return zip([["capture.json", new Blob([text])], [file, film]], signal);
}

// Stills as one thing to upload: one of each pattern, in the order of their names. A `note` says what was done to them.
export function together(files) {
	const all = [...files].sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
	const raw = onlyRaw(all);
	const { stills, note } = inOrder(raw ?? all);
	const [{ name: first, lastModified }] = stills;
	const kind = raw && endOf(first);
	return {
		name: stills.length > 1 ? t("stills.name", { first, n: stills.length }) : first, type: "", stills, lastModified,
		note: [raw && t("stills.raw", { kind }), note].filter(Boolean).join(" "),
	};
}

const endOf = (name) => /\.\w+$/.exec(name)?.[0] ?? "";
const stemOf = ({ name }) => name.slice(0, name.length - endOf(name).length).toLowerCase();

// The camera RAW of stills that a camera stored as JPEG or HEIC as well.
function onlyRaw(stills) {
	const raw = stills.filter(({ name }) => RAW.test(name));
	const others = stills.filter((one) => !raw.includes(one)).map(stemOf);
	return raw.length && `${raw.map(stemOf)}` === `${others}` ? raw : undefined;
}

// After 9999 cameras count from 0 or 1 again: what comes after the wide gap in the numbers was taken first, unless the
// times of the files say otherwise.
function inOrder(stills) {
	const numbers = stills.map((one) => Number(/\d+(?=\D*$)/.exec(stemOf(one))));
	const gap = numbers.findIndex((number, n) => number - numbers[n - 1] > LAST / 2);
	const [first, last] = [stills[0], stills.at(-1)];
	if (gap < 0 || numbers.at(-1) > LAST || last.lastModified > first.lastModified) return { stills };
	return { stills: [...stills.slice(gap), ...stills.slice(0, gap)], note: t("stills.rolled", { first: first.name, last: last.name }) };
}

export async function stillsArchive({ stills }, { video, mask, ...manifest }, signal) {
	const patterns = countPatterns(manifest.program);
	if (stills.length !== patterns) throw new Problem({ status: 422, title: t("upload.none"), detail: t("stills.count", { n: stills.length, patterns }) });
	const name = manifest.name || stills[0].name.replace(/\.\w+$/, "").slice(0, 200);
	// The report names files as the photographer knows them, but not every character may be in an archive.
	const frames = stills.map((still, pattern) => ({ file: `${String(pattern).padStart(5, "0")}/${still.name.replace(/[^\w .()+-]/g, "_")}`, pattern }));
	const text = JSON.stringify({ ...manifest, name, frames });
	return zip([["capture.json", new Blob([text])], ...frames.map(({ file }, n) => [file, stills[n]])], signal);
}

// What JSON says; the browser's own errors are in its language, and for programmers.
function parsed(text) {
	try {
		return JSON.parse(text);
	} catch {
		throw new Error(t("manifest.nojson"));
	}
}

// Asks in `where` which program a film or stills show; resolves with their capture.json.
export async function askForManifest(where, isFilmed, signal) {
	const { programs } = await getJson("v1/programs?limit=100", signal);
	return new Promise((resolve, reject) => {
		signal.addEventListener("abort", () => reject(signal.reason), { once: true });
		const problem = h("p.hint", { role: "status" });
		const which = h("select", { "aria-label": t("program") }, programs.map((one, n) => h("option", { value: n }, `${programName(one)}, ${when(one.created_at).textContent}`)));
		const rate = h("input", { type: "number", min: 0.01, max: 120, step: "any", required: true });
		const suggest = () => (rate.value = programs[which.value]?.showing?.patterns_per_second ?? 2);
		which.onchange = suggest;
		suggest();
		const own = h("input", { type: "file", accept: ".json,application/json" });
		own.onchange = async () => {
			try {
				const found = parsed(await own.files[0].text());
				if (isFilmed && !found?.video?.patterns_per_second) throw new Error(t("manifest.novideo"));
				if (!found?.program?.parts) throw new Error(t("manifest.noprogram"));
				resolve(found);
			} catch (error) {
				problem.textContent = t("manifest.wrong", { why: error.message });
				own.value = "";
			}
		};
		const form = h("form.stack",
			h("p", h("strong", t("program.which"))),
			programs.length
				? [h("label", t("program"), which), isFilmed && h("label", t("rate"), rate), h("p.row", h("button.primary", t("upload")))]
				: h("p", parts("program.none", { play: h("a", { href: "#/film" }, t("program.play")) })),
			h("label", t("program.own"), own), problem);
		form.onsubmit = (event) => {
			event.preventDefault();
			getJson(`v1/programs/${programs[which.value].id}`, signal).then((program) => resolve(isFilmed ? filmManifestOf(program, Number(rate.value)) : stillsManifestOf(program)), reject);
		};
		where.replaceChildren(form);
		(programs.length ? which : own).focus();
	}).finally(() => where.replaceChildren());
}
