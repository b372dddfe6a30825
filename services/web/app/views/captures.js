// The list of captures, and the zone to upload another one.
import { getBlob, getJson } from "../lib/api.js";
import { badge, button, bytes, empty, h, size, when } from "../lib/dom.js";
import { areRemoved, fetchCapture, restoreSamples } from "../home/samples.js";
import { list } from "../lib/list.js";
import { FILM, steps, thumbnails } from "../lib/view.js";
import { dropZone, upload } from "../upload/upload.js";

export async function captures(main, signal) {
	const problem = h("div");
	const restore = button("Show the samples again", problem, () => {
		restoreSamples();
		location.hash = "#/";
	});
	const thumb = thumbnails(signal, (id) => getBlob(`v1/captures/${id}/thumbnail.png`, signal));
	main.append(
		steps(FILM),
		h("h1", "Captures"),
		h("p.lead", "Films of a glass before a monitor that shows patterns. Upload one to see its report."),
		dropZone(),
		h("p.row", button("Try it with a sample capture", problem, async () => upload([await fetchCapture(signal)])), areRemoved() && restore),
		problem,
	);
	await list(main, signal, {
		page: (after) => getJson(`v1/captures?limit=50${after}`, signal).then((answer) => answer.captures),
		busy: (one) => one.state === "ingesting",
		none: () => empty("No captures yet", "The first one appears here as soon as it is uploaded."),
		item: (one) =>
			h("a.card.pictured", { href: `#/captures/${one.id}` }, thumb(one),
				h("span.name", one.name || `Capture ${one.id.slice(0, 8)}`), badge(one.state),
				h("span.about", [size(one), `${one.frames} frames`, bytes(one.bytes)].filter(Boolean).join(" · ")),
				when(one.created_at)),
	});
}
