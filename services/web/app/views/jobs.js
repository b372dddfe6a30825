// Jobs: the list, and one job with its progress; a recovery fills in its frame tile by tile.
import { getComposite, getJson, post, save } from "../lib/api.js";
import { jobCard, jobTitle } from "../lib/activity.js";
import { backdrop } from "../composite/backdrops/backdrops.js";
import { pauseButton } from "../composite/recovering.js";
import { button, empty, facts, h, newest, pause, problemBox, show, when } from "../lib/dom.js";
import { ACTIVE } from "../lib/events.js";
import { list } from "../lib/list.js";
import { followJob } from "../lib/job_progress.js";
import { RECOVER, CHECK, deletion, qualityOf, showAgain, steps } from "../lib/view.js";
import { automatic } from "./recovery_form.js";
import { reportLink } from "./report.js";
import { t } from "../lib/words.js";

const POLL = 2000; // ms between two pictures of what is recovered
const LONGER = 640; // pixels of their longer side, at most

const isActive = ({ state }) => ACTIVE.includes(state);

export async function jobs(main, signal) {
	main.append(h("h1", t("jobs")));
	await list(main, signal, {
		kind: "jobs", states: ["queued", "running", "succeeded", "failed", "cancelled"],
		text: (one) => `${jobTitle(one)} ${one.id}`,
		busy: isActive, fixed: isActive,
		none: () => empty(t("jobs.none"), t("jobs.first")),
		item: (one) => jobCard(one, when(one.created_at)),
	});
}

export async function job(main, signal, id) {
	const found = await getJson(`v1/jobs/${id}`, signal);
	const problem = h("div");
	const halt = pauseButton(id, problem);
	const cancel = button(t("cancel"), problem, () => post(`v1/jobs/${id}/cancel`));
	const retry = button(t("again"), problem, async () => {
		await post(`v1/jobs/${id}/retry`);
		watch();
	}, "primary");
	const lost = t(found.kind === "composite" ? "job.lost.video" : "job.lost.log");
	const removal = deletion(`v1/jobs/${id}`, problem, lost);
	const asked = h("details.panel", { hidden: found.kind !== "recover" }, h("summary", t("options")), facts(found.options));
	const links = h("p.row");
	const panel = h("section.panel", { "aria-label": t("progress"), "data-log": "" });
	const [preview, report] = found.kind === "recover" ? await Promise.all([progressPicture(found, signal), reportLink(found.capture, signal)]) : [];
	const step = { ingest: CHECK, recover: RECOVER }[found.kind];
	main.append(
		step ? steps(step, "#/captures", `#/captures/${found.capture}`) : "",
		h("p.crumb", h("a", { href: "#/jobs" }, t("jobs"))),
		h("div.row.spread", h("h1", jobTitle(found)), h("span.row", halt.button, cancel, retry, removal)),
		problem,
		facts({
			[t("job.asked")]: when(found.created_at), [t("capture")]: found.capture && h("a", { href: `#/captures/${found.capture}` }, t("job.capture")),
			[t("method")]: found.options.method, [t("quality")]: qualityOf(found), [t("report")]: report,
		}),
		links, h("div", { class: preview ? "columns" : "stack" }, preview?.panel, h("div.stack", panel, asked)),
	);
	let hasPreview = false; // the matte, from some moment of its recovery on
	let looked;
	let latest;
	watch(found);

	async function lookForPreview() {
		try {
			hasPreview = Boolean((await getJson(`v1/mattes/${found.matte}`, signal)).preview);
			if (hasPreview) update(latest);
		} catch {
			looked = null; // the next event looks again
		}
	}

	function update(now) {
		latest = now;
		halt.update(now);
		cancel.hidden = !ACTIVE.includes(now.state);
		removal.hidden = ACTIVE.includes(now.state);
		retry.hidden = now.state !== "failed";
		const made = now.state === "succeeded";
		if (now.stage === "recovering") looked ??= lookForPreview();
		const isShown = made || (hasPreview && now.state === "running");
		if (isShown && automatic.delete(id)) return location.replace(`#/mattes/${now.matte}`);
		links.replaceChildren(...[
			isShown && !made && h("a.primary", { href: `#/mattes/${now.matte}` }, t("job.preview")),
			made && now.kind === "recover" && h("a.primary", { href: `#/mattes/${now.matte}` }, t("job.matte")),
			made && now.kind === "ingest" && h("a.primary", { href: `#/captures/${now.capture}` }, t("job.capture")),
			made && now.video && button(t("video.download"), problem, () => save(now.video.slice(1), "composite.mp4"), "primary"),
		].filter(Boolean));
		preview?.update(now);
	}

	function watch(known) {
		panel.replaceChildren();
		return followJob(panel, id, signal, update, known).catch((error) => {
			if (signal.aborted) return;
			if (error.status === 404) showAgain(); // deleted meanwhile: show that it is not found
			else panel.append(problemBox(error));
		});
	}
}

// The composite of what is recovered so far; the rest is transparent.
async function progressPicture(found, signal) {
	const { width, height } = await getJson(`v1/captures/${found.capture}`, signal).catch(() => ({}));
	const image = h("img", { alt: t("job.sofar"), hidden: true });
	const frame = h("div.picture.filling", image);
	if (width) frame.style.aspectRatio = `${width} / ${height}`;
	const before = backdrop("Checker", 640, 480);
	let shown;
	const look = newest(async (now) => {
		const next = `${now.state} ${now.tiles.done}`;
		if (next === shown) return;
		const size = Math.min(LONGER, Math.max(width ?? LONGER, height ?? LONGER));
		try {
			await show(image, await getComposite(now.matte, { size }, "image/png", await before, signal));
			shown = next;
			if (now.state === "running") await pause(POLL, signal);
		} catch {
			await pause(POLL, signal).catch(() => {}); // nothing recovered yet, or the service is away, which the progress panel shows
		}
	});
	return {
		panel: h("section.panel", h("h2", t("job.frame")), frame),
		update: (now) => now.tiles.total > 0 && ["running", "succeeded"].includes(now.state) && look(now),
	};
}
