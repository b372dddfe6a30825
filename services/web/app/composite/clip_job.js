// Composites of clips: the service composites every frame, as a job that ends with a video.
import { ask, newKey, save } from "../lib/api.js";
import { button, h, problemBox } from "../lib/dom.js";
import { followJob } from "../lib/job_progress.js";
import { t } from "../lib/words.js";

// The controls for the clip that is chosen; `place` returns where it stands, and what is around the glass.
export function clipJob(matte, place, signal) {
	const problem = h("div");
	const progress = h("div.stack");
	let chosen;
	const make = button(t("video.make"), problem, async () => {
		progress.replaceChildren(h("p.hint", { role: "status" }, t("video.sending")));
		try {
			const headers = { "Content-Type": chosen.type.startsWith("video/") ? chosen.type : "video/mp4", "Idempotency-Key": newKey() };
			const path = `v1/mattes/${matte.id}/composite?${new URLSearchParams(place())}`;
			const job = await (await ask(path, { method: "POST", headers, body: chosen, signal })).json();
			progress.replaceChildren();
			watch(job);
		} catch (error) {
			progress.replaceChildren();
			throw error;
		}
	});
	async function watch(job) {
		const panel = h("div.stack");
		const way = h("p.row", h("a", { href: `#/jobs/${job.id}` }, t("job.show")));
		progress.replaceChildren(panel, way);
		try {
			const ended = await followJob(panel, job.id, signal, () => {}, job);
			if (ended.video) way.prepend(button(t("video.download"), problem, () => save(ended.video.slice(1), "composite.mp4"), "primary"));
		} catch (error) {
			if (!signal.aborted) panel.append(problemBox(error));
		}
	}
	const element = h("div.stack", { hidden: true }, h("p.row", make), problem, progress);
	return {
		element,
		choose(file) {
			chosen = file;
			element.hidden = !file;
			progress.replaceChildren();
		},
	};
}
