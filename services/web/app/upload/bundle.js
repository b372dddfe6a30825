// Makes a capture archive of a film: asks which program it shows, and puts both into one ZIP.
import { getJson } from "../lib/api.js";
import { h, size, when } from "../lib/dom.js";
import { zip } from "./zip.js";
import { parts, t } from "../lib/words.js";

const ENDS = /\.(mp4|m4v|mov|mkv|webm|avi|3gp|mts|m2ts)$/i;
export const isFilm = (file) => file.type.startsWith("video/") || ENDS.test(file.name);

export const programName = (program) => t(program.display ? "program.screen" : "program.plain", { n: program.patterns, size: size(program.display ?? {}) });

// The capture.json of a film of a program, shown by the player page or as a video.
export function recordOf(program, rate) {
	const border = program.showing?.border ?? program.display;
	const video = { patterns_per_second: rate, ...(border && { border }) };
	return { format: "envmatte-capture/1", program: program.program, video };
}

export async function filmArchive(film, record, signal) {
	const file = `film${ENDS.exec(film.name)?.[0].toLowerCase() ?? ".mp4"}`;
	const name = record.name || film.name.replace(/\.\w+$/, "").slice(0, 200);
	const text = JSON.stringify({ ...record, name, video: { ...record.video, file } });
	return zip([["capture.json", new Blob([text])], [file, film]], signal);
}

// Asks in `where` which program a film shows; resolves with its capture.json.
export async function askForRecord(where, signal) {
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
				const found = JSON.parse(await own.files[0].text());
				if (!found.video?.patterns_per_second) throw new Error(t("record.novideo"));
				resolve(found);
			} catch (error) {
				problem.textContent = t("record.wrong", { why: error.message });
				own.value = "";
			}
		};
		const form = h("form.stack",
			h("p", h("strong", t("program.which"))),
			programs.length
				? [h("label", t("program"), which), h("label", t("rate"), rate), h("p.row", h("button.primary", t("upload")))]
				: h("p", parts("program.none", { play: h("a", { href: "#/film" }, t("program.play")) })),
			h("label", t("program.own"), own), problem);
		form.onsubmit = (event) => {
			event.preventDefault();
			getJson(`v1/programs/${programs[which.value].id}`, signal).then((program) => resolve(recordOf(program, Number(rate.value))), reject);
		};
		where.replaceChildren(form);
		(programs.length ? which : own).focus();
	}).finally(() => where.replaceChildren());
}
