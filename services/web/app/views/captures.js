// The list of captures, and the zone to upload another one.
import { getBlob } from "../lib/api.js";
import { badge, button, bytes, empty, h, size, when } from "../lib/dom.js";
import { areRemoved, fetchCapture, restoreSamples } from "../home/samples.js";
import { list } from "../lib/list.js";
import { FILM, steps, thumbnails } from "../lib/view.js";
import { dropZone, upload } from "../upload/upload.js";
import { t } from "../lib/words.js";

const nameOf = ({ id, name }) => name || t("capture.unnamed", { id: id.slice(0, 8) });

export async function captures(main, signal) {
	const problem = h("div");
	const restore = button(t("samples.again"), problem, () => {
		restoreSamples();
		location.hash = "#/";
	});
	const thumb = thumbnails(signal, (id) => getBlob(`v1/captures/${id}/thumbnail.png`, signal));
	main.append(
		steps(FILM),
		h("h1", t("nav.captures")),
		h("p.lead", t("captures.lead")),
		dropZone(),
		h("p.row", button(t("captures.sample"), problem, async () => upload([await fetchCapture(signal)])), areRemoved() && restore),
		problem,
	);
	await list(main, signal, {
		kind: "captures", states: ["ingesting", "ready", "failed"], named: true, text: nameOf,
		busy: (one) => one.state === "ingesting",
		none: () => empty(t("captures.none"), t("captures.first")),
		item: (one) =>
			h("a.card.pictured", { href: `#/captures/${one.id}` }, thumb(one),
				h("span.name", nameOf(one)), badge(one.state),
				h("span.about", [size(one), t("frames.n", { n: one.frames }), bytes(one.bytes)].filter(Boolean).join(" · ")),
				when(one.created_at)),
	});
}
