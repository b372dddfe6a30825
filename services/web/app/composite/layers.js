// The layers of a matte.
import { getBlob, save } from "../lib/api.js";
import { button, h, newest, problemBox, show } from "../lib/dom.js";
import { t } from "../lib/words.js";

const FIRST = "rho";
const LAYERS = ["S", "rho", "alpha", "confidence"];
const OF_PLATE = ["stmap.exr", "blender.py", "nuke.nk", "nuke_stmap.nk"];

const altOf = (name) => t("layer.name", { name: t(`layer.label.${name}`) });

// Folded; the pictures are requested once it is opened.
export function layers(matte, signal) {
	const image = h("img", { alt: altOf(FIRST), width: matte.width, height: matte.height, hidden: true });
	const frame = h("div.picture.layer", image);
	frame.style.aspectRatio = `${matte.width} / ${matte.height}`;
	const about = h("p.hint");
	const problem = h("div");
	const choose = newest(async (name) => {
		try {
			about.textContent = t(`layer.${name}`);
			await show(image, await getBlob(`v1/mattes/${matte.id}/layers/${name}.png`, signal));
			image.alt = altOf(name);
			image.classList.toggle("linear", ["S", "rho"].includes(name)); // linear light, to be encoded for the display
			problem.replaceChildren();
		} catch (error) {
			image.hidden = true; // it shows another layer
			if (!signal.aborted) problem.replaceChildren(problemBox(error));
		}
	});
	const names = h("fieldset.row", h("legend", t("layer")), LAYERS.map((name) =>
		h("label.choice", h("input", { type: "radio", name: "layer", value: name, checked: name === FIRST, onchange: () => choose(name) }), t(`layer.label.${name}`))));
	const plate = h("input", { type: "checkbox", checked: true });
	const file = (name) => button(name, problem, () => {
		const query = matte.cut_out && plate.checked && OF_PLATE.includes(name) ? "?plate=true" : "";
		return save(`v1/mattes/${matte.id}/layers/${name}${query}`, name);
	});
	const files = ["all.exr", "stmap.exr"].map(file);
	const nodes = ["lookups.exr", "blender.py", "nuke.nk", "nuke_stmap.nk"].map(file);
	const panel = h("details.panel", h("summary", h("h2", t("layers"))),
		h("div.stack", names, frame, about, h("p.row", t("layers.tools"), files), h("p.row", t("layers.nodes"), nodes),
			matte.cut_out && h("label.choice", plate, t("layers.plate")), problem));
	panel.addEventListener("toggle", () => panel.open && image.hidden && choose(names.querySelector(":checked").value));
	return panel;
}
