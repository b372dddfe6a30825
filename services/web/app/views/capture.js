// One capture: its report, its frames, and the form that starts a recovery.
import { getBlob, getJson, patchJson, remove } from "../lib/api.js";
import { badge, button, bytes, confirmed, facts, h, newest, problemBox, prose, sentence, show, size, when } from "../lib/dom.js";
import { recoveryForm } from "./recovery_form.js";
import { followJob } from "../lib/job_progress.js";
import { renamable } from "../lib/rename.js";

export async function capture(main, signal, id) {
	const found = await getJson(`v1/captures/${id}`, signal);
	const problem = h("div");
	const rename = async (name) => (await patchJson(`v1/captures/${id}`, { name })).name;
	const deletion = button("Delete", problem, async () => {
		if (!(await confirmed("Delete this capture?", "Its frames will be deleted. Mattes recovered from it stay.", "Delete capture"))) return;
		await remove(`v1/captures/${id}`);
		location.replace("#/captures");
	}, "quiet");
	main.append(
		h("p", { class: "crumb" }, h("a", { href: "#/captures" }, "Captures")),
		h("div", { class: "row spread" }, renamable(found.name || `Capture ${id.slice(0, 8)}`, "Name of the capture", rename), h("span", { class: "row" }, badge(found.state), deletion)),
		problem,
		facts({
			Frame: found.width && `${size(found)} pixels`, Frames: found.frames, Monitor: `${size(found.program.monitor)} pixels`,
			Size: bytes(found.bytes), Added: when(found.created_at), "Kept until": found.expires_at && when(found.expires_at),
			"Read by": h("a", { href: `#/jobs/${found.job}` }, "its ingest job"),
		}),
	);
	if (found.state === "failed") return main.append(problemBox(found.problem));
	const [report, form] = await Promise.all([found.state === "ready" ? reportPanels(found, signal) : [], recoveryForm(id, found.state, signal)]);
	const panel = h("section", { class: "panel", hidden: found.state === "ready" }, h("h2", {}, "Reading the frames"));
	main.append(panel, ...report, form);
	if (found.state === "ready") return;
	followJob(panel, found.job, signal).then(
		() => signal.aborted || dispatchEvent(new HashChangeEvent("hashchange")), // shows the view of a capture that is ready or has failed
		(error) => signal.aborted || panel.append(problemBox(error)),
	);
}

async function reportPanels(found, signal) {
	const report = await getJson(found.report.slice(1), signal);
	const findings = h("section", { class: "panel" }, h("div", { class: "row" }, h("h2", {}, "Report"), badge(report.level)),
		h("ul", { class: "findings" }, report.findings.map((one) =>
			h("li", {}, badge(one.level), h("div", {}, h("p", {}, prose(sentence(one.message))), one.remedy && h("p", { class: "remedy" }, prose(sentence(one.remedy))))))));
	return [findings, h("div", { class: "columns" }, frames(found, signal), sheet(found, signal))];
}

function frames(found, signal) {
	const middle = found.frames >> 1; // the first ones are black and white
	const image = h("img", { alt: `Frame ${middle + 1}`, width: found.width, height: found.height, hidden: true });
	const frame = h("div", { class: "picture" }, image);
	frame.style.aspectRatio = `${found.width} / ${found.height}`; // keeps its place until the picture is there
	const number = h("input", { type: "range", id: "frame", min: 0, max: found.frames - 1, value: middle });
	const position = h("output", { for: "frame" }, `${middle + 1} of ${found.frames}`);
	const problem = h("div");
	const look = newest(async () => {
		try {
			await show(image, await getBlob(`v1/captures/${found.id}/frames/${number.value}.png`, signal));
			image.alt = `Frame ${Number(number.value) + 1}`;
			problem.replaceChildren();
		} catch (error) {
			if (!signal.aborted) problem.replaceChildren(problemBox(error));
		}
	});
	number.oninput = () => {
		position.textContent = `${Number(number.value) + 1} of ${found.frames}`;
		look();
	};
	look();
	return h("section", { class: "panel" }, h("h2", {}, "Frames"), frame,
		h("div", { class: "row" }, h("label", { for: "frame" }, "Frame"), number, position), problem);
}

function sheet(found, signal) {
	const image = h("img", { alt: "Some of the frames side by side", hidden: true });
	const frame = h("div", { class: "picture whole" }, image);
	frame.style.aspectRatio = `${2 * found.width} / ${1.1 * found.height}`; // most sheets are four by two frames: this keeps the page from moving when it loads
	const fit = (blob) => show(image, blob).then(() => (frame.style.aspectRatio = `${image.naturalWidth} / ${image.naturalHeight}`));
	getBlob(`v1/captures/${found.id}/contact-sheet.png`, signal).then(fit, (error) => {
		if (!signal.aborted) image.replaceWith(problemBox(error));
	});
	return h("section", { class: "panel" }, h("h2", {}, "Contact sheet"), frame,
		h("p", { class: "hint" }, "Red pixels are clipped at white, blue ones at black."));
}
