// Mattes: the list, and one matte with its composite and layers.
import { getComposite, getJson, save } from "../lib/api.js";
import { backdrop } from "../composite/backdrops.js";
import { badge, button, empty, facts, h, size, when } from "../lib/dom.js";
import { compositing } from "../composite/compositing.js";
import { layers } from "../composite/layers.js";
import { list } from "../lib/list.js";
import { PLAY, deletion, steps, thumbnails } from "../lib/view.js";
import { QUALITIES } from "./recovery_form.js";

const THUMB = 240; // pixels
const checker = backdrop("Checker", THUMB, 180);

export function matteCards(signal) {
	const thumb = thumbnails(signal, async (id) => getComposite(id, { size: THUMB, around: "backdrop" }, "image/jpeg", await checker, signal));
	return (one) => h("a.card.pictured", { href: `#/mattes/${one.id}` }, thumb(one),
		h("span.name", `Matte ${one.id.slice(0, 8)}`), badge(one.state),
		h("span.about", [size(one), one.options.method, QUALITIES[one.options.quality]].filter(Boolean).join(" · ")), when(one.created_at));
}

export async function mattes(main, signal) {
	main.append(h("h1", "Mattes"));
	await list(main, signal, {
		page: (after) => getJson(`v1/mattes?limit=50${after}`, signal).then((answer) => answer.mattes),
		busy: (one) => one.state === "recovering",
		none: () => empty("No mattes yet", "Open a capture that is ready, and start a recovery."),
		item: matteCards(signal),
	});
}

export async function matte(main, signal, id) {
	const found = await getJson(`v1/mattes/${id}`, signal);
	const problem = h("div");
	const { capture, job, options } = found;
	const isReady = found.state === "ready";
	const removal = deletion(`v1/mattes/${id}`, problem, "You can recover it again from its capture, or import an archive of it.");
	const archive = button("Download the matte", problem, () => save(`v1/mattes/${id}/archive`, `matte-${id}.zip`));
	const page = button("Save as a web page", problem, () => save(`v1/mattes/${id}/live.html`, `matte-${id}.html`));
	archive.hidden = page.hidden = !isReady;
	main.append(
		steps(PLAY, "#/captures", capture && `#/captures/${capture}`, job && `#/jobs/${job}`),
		h("div.row.spread", h("h1", `Matte ${id.slice(0, 8)}`), badge(found.state)),
	);
	const details = h("details.panel", { open: !isReady }, h("summary", h("h2", "Details")), facts({
		Frame: found.width && `${size(found)} pixels`, Monitor: found.monitor && `${found.monitor.join(" × ")} pixels`,
		Made: when(found.created_at), "Kept until": found.expires_at && when(found.expires_at),
		Method: options.method, Quality: QUALITIES[options.quality],
		Capture: capture && h("a", { href: `#/captures/${capture}` }, capture.slice(0, 8)),
		Job: job && h("a", { href: `#/jobs/${job}` }, job.slice(0, 8)),
	}));
	if (isReady) {
		main.append(compositing(found, await otherQualities(found, signal), signal), layers(found, signal));
	} else {
		const text = found.state === "failed" ? "The recovery failed; the job says why." : "The recovery is still running; the job shows its progress.";
		main.append(h("div.empty", h("strong", "Not ready"), h("p", text), job && h("p", h("a", { href: `#/jobs/${job}` }, "Show the job"))));
	}
	main.append(details, h("p.row", page, archive, removal), problem);
}

// The newest matte of the same capture in each other quality, by its name.
async function otherQualities({ capture, options }, signal) {
	if (!capture) return {};
	const { mattes } = await getJson(`v1/mattes?capture=${capture}&state=ready&limit=20`, signal);
	const others = mattes.filter((one) => QUALITIES[one.options.quality] && one.options.quality !== options.quality);
	return Object.fromEntries(others.reverse().map((one) => [QUALITIES[one.options.quality], one]));
}
