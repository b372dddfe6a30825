// One capture: its report, its frames, and the form that starts a recovery.
import { getBlob, getJson, patchJson } from "../lib/api.js";
import { badge, bytes, facts, h, newest, problemBox, prose, sentence, show, size, when } from "../lib/dom.js";
import { followJob } from "../lib/job_progress.js";
import { renamable } from "../lib/rename.js";
import { CHECK, deletion, persist, showAgain, steps } from "../lib/view.js";
import { matteCards } from "./mattes.js";
import { recoveryForm } from "./recovery_form.js";
import { verdictOf } from "./report.js";
import { said, t } from "../lib/words.js";
import { failedFilm } from "../film/failed_film.js";
import { forgetFilmOf } from "../upload/kept_films.js";

const NEWEST = 2; // mattes that are shown at once: the form for another recovery comes after them

export async function capture(main, signal, id) {
	const found = await getJson(`v1/captures/${id}`, signal);
	const problem = h("div");
	const rename = async (name) => (await patchJson(`v1/captures/${id}`, { name })).name;
	const removal = deletion(`v1/captures/${id}`, problem, t("capture.lost"));
	main.append(
		steps(CHECK, "#/captures"),
		h("p.crumb", h("a", { href: "#/captures" }, t("nav.captures"))),
		h("div.row.spread", renamable(found.name || t("capture.unnamed", { id: id.slice(0, 8) }), t("capture.name"), rename), h("span.row", badge(found.state), removal)),
		problem,
		facts({
			[t("frame")]: found.width && t("pixels", { size: size(found) }), [t("frames")]: found.frames,
			[t("monitor")]: t("pixels", { size: size(found.program.monitor) }), [t("size")]: bytes(found.bytes),
			[t("added")]: when(found.created_at), [t("until")]: found.expires_at && when(found.expires_at),
			[t("capture.by")]: h("a", { href: `#/jobs/${found.job}` }, t("capture.job")),
		}),
	);
	if (found.state === "failed") return main.append(problemBox(found.problem), await failedFilm(id, signal));
	if (found.state === "ready") {
		forgetFilmOf(id);
		const [report, { form }, made] = await Promise.all([getJson(found.report.slice(1), signal), recoveryForm(found, signal), mattesOf(id, signal)]);
		return main.append(verdict(report), made, form, h("div.columns", frames(found, signal), sheet(found, signal)));
	}
	const panel = h("section.panel", h("h2", t("capture.reading")));
	const { form, isAutomatic, start } = await recoveryForm(found, signal);
	main.append(panel, form);
	followJob(panel, found.job, signal).then(({ state }) => persist(async () => {
		if (state === "succeeded" && isAutomatic() && (await getJson(`v1/captures/${id}/report`, signal)).level !== "bad") return start();
		showAgain(); // it is ready, or has failed
	}, problem, signal)).catch((error) => signal.aborted || problem.replaceChildren(problemBox(error)));
}

async function mattesOf(id, signal) {
	const { mattes } = await getJson(`v1/mattes?capture=${id}&limit=8`, signal);
	const card = matteCards(signal);
	const cards = (some) => h("ul.list", some.map((one) => h("li", card(one))));
	const older = mattes.slice(NEWEST);
	return h("section.stack", { hidden: !mattes.length, "aria-label": t("nav.mattes") }, h("h2", t("capture.mattes")),
		cards(mattes.slice(0, NEWEST)), h("details", { hidden: !older.length }, h("summary", t("capture.older", { n: older.length })), cards(older)));
}

// The report: a verdict, then what is wrong with its remedies; what is fine is folded.
function verdict(report) {
	const { level, findings } = report;
	const rows = (some) => h("ul.findings", some.map((one) =>
		h("li", badge(one.level), h("div", h("p", prose(sentence(said(one.message)))), one.remedy && h("p.remedy", prose(sentence(said(one.remedy))))))));
	const fine = findings.filter((one) => one.level === "good");
	const wrong = findings.filter((one) => one.level !== "good");
	return h("section.panel", { "aria-label": t("report") }, h("div.row", h("h2", verdictOf(report)), badge(level)),
		wrong.length ? rows(wrong) : "", h("details", { hidden: !fine.length }, h("summary", t("report.fine", { n: fine.length })), rows(fine)));
}

function frames(found, signal) {
	const middle = found.frames >> 1; // the first ones are black and white
	const image = h("img", { alt: t("frame.n", { n: middle }), width: found.width, height: found.height, hidden: true });
	const frame = h("div.picture", image);
	frame.style.aspectRatio = `${found.width} / ${found.height}`; // keeps its place until the picture is there
	const last = found.frames - 1; // they count from 0, as in the report, the API and names of files
	const number = h("input", { type: "range", id: "frame", min: 0, max: last, value: middle });
	const position = h("output", { for: "frame" });
	const problem = h("div");
	const look = newest(() => persist(async () => {
		const n = number.value;
		await show(image, await getBlob(`v1/captures/${found.id}/frames/${n}.png`, signal));
		image.alt = t("frame.n", { n });
	}, problem, signal));
	number.oninput = () => {
		position.textContent = t("frame.of", { n: number.value, last });
		look();
	};
	number.oninput();
	return h("section.panel", h("h2", t("frames")), frame,
		h("div.row", h("label", { for: "frame" }, t("frame")), number, position), problem);
}

function sheet(found, signal) {
	const image = h("img", { alt: t("sheet.alt"), hidden: true });
	const frame = h("div.picture.whole", image);
	frame.style.aspectRatio = `${2 * found.width} / ${1.1 * found.height}`; // most sheets are four by two frames: this keeps the page from moving when it loads
	const problem = h("div");
	persist(async () => {
		await show(image, await getBlob(`v1/captures/${found.id}/contact-sheet.png`, signal));
		frame.style.aspectRatio = `${image.naturalWidth} / ${image.naturalHeight}`;
	}, problem, signal);
	return h("section.panel", h("h2", t("sheet")), frame, problem,
		h("p.hint", t("sheet.clipped")));
}
