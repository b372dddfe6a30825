// Mattes: the list, and one matte with its composite and layers.
import { ask, getJson, remove, save } from "../lib/api.js";
import { backdrop } from "../composite/backdrops.js";
import { badge, button, confirmed, empty, facts, h, newest, show, size, when } from "../lib/dom.js";
import { compositing } from "../composite/compositing.js";
import { layers } from "../composite/layers.js";
import { list } from "../lib/list.js";

const THUMB = 240; // pixels
const thumbs = new Map(); // a matte never changes once it is ready
const checker = backdrop("Checker", THUMB, 180);

export async function mattes(main, signal) {
	main.append(h("h1", {}, "Mattes"));
	const queue = [];
	const draw = newest(async () => {
		while (queue.length && !signal.aborted) await thumb(queue.shift(), signal).catch(() => {});
	});
	// Requests thumbnails one after the other, and only of mattes that are in view.
	const seen = new IntersectionObserver((entries) => {
		for (const { isIntersecting, target } of entries) {
			if (!isIntersecting) continue;
			seen.unobserve(target);
			queue.push(target);
		}
		draw();
	});
	signal.addEventListener("abort", () => seen.disconnect());
	await list(main, signal, {
		page: (after) => getJson(`v1/mattes?limit=50${after}`, signal).then((answer) => answer.mattes),
		busy: (one) => one.state === "recovering",
		none: () => empty("No mattes yet", "Open a capture that is ready, and start a recovery."),
		item: (one) => {
			const image = h("img", { alt: "", width: 96, height: 72, hidden: true });
			const frame = h("span", { class: "thumb", "data-matte": one.id }, image);
			if (one.state === "ready") seen.observe(frame);
			return h("a", { class: "card pictured", href: `#/mattes/${one.id}` }, frame,
				h("span", { class: "name" }, `Matte ${one.id.slice(0, 8)}`), badge(one.state),
				h("span", { class: "about" }, [size(one), one.options.method, one.options.quality].filter(Boolean).join(" · ")), when(one.created_at));
		},
	});
}

async function thumb(frame, signal) {
	const id = frame.dataset.matte;
	if (!thumbs.has(id)) {
		const headers = { Accept: "image/jpeg" };
		const answer = await ask(`v1/mattes/${id}/composite?size=${THUMB}`, { method: "POST", headers, body: await checker, signal });
		thumbs.set(id, await answer.blob());
	}
	await show(frame.firstChild, thumbs.get(id));
}

export async function matte(main, signal, id) {
	const found = await getJson(`v1/mattes/${id}`, signal);
	const problem = h("div");
	const deletion = button("Delete", problem, async () => {
		if (!(await confirmed("Delete this matte?", "You can recover it again from its capture, or import an archive of it.", "Delete matte"))) return;
		await remove(`v1/mattes/${id}`);
		location.replace("#/mattes");
	}, "quiet");
	const archive = button("Download the matte", problem, () => save(`v1/mattes/${id}/archive`, `matte-${id}.zip`));
	const page = button("Save as a web page", problem, () => save(`v1/mattes/${id}/live.html`, `matte-${id}.html`));
	archive.hidden = page.hidden = found.state !== "ready";
	main.append(
		h("p", { class: "crumb" }, h("a", { href: "#/mattes" }, "Mattes")),
		h("div", { class: "row spread" }, h("h1", {}, `Matte ${id.slice(0, 8)}`), h("span", { class: "row" }, badge(found.state), page, archive, deletion)),
		problem,
		facts({
			Frame: found.width && `${size(found)} pixels`, Monitor: found.monitor && `${found.monitor.join(" × ")} pixels`,
			Made: when(found.created_at), "Kept until": found.expires_at && when(found.expires_at),
			Method: found.options.method, Quality: found.options.quality,
			Capture: found.capture && h("a", { href: `#/captures/${found.capture}` }, found.capture.slice(0, 8)),
			Job: found.job && h("a", { href: `#/jobs/${found.job}` }, found.job.slice(0, 8)),
		}),
	);
	if (found.state === "ready") return main.append(compositing(found, signal), layers(found, signal));
	const text = found.state === "failed" ? "The recovery failed; the job says why." : "The recovery is still running; the job shows its progress.";
	main.append(h("div", { class: "empty" }, h("strong", {}, "Not ready"), h("p", {}, text),
		found.job && h("p", {}, h("a", { href: `#/jobs/${found.job}` }, "Show the job"))));
}
