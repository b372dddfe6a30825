// The layers of a matte, and where the light of one of its pixels comes from.
import { getBlob, getJson, save } from "../lib/api.js";
import { button, h, newest, pause, problemBox, show } from "../lib/dom.js";

const CALM = 120; // ms that the pointer rests before its pixel is requested
const FIRST = "rho";
const LAYERS = {
	S: "Reflections: light that is there even when the monitor is black, such as a lamp that the glass mirrors.",
	rho: "Transparency: how much of the monitor’s light comes through, for each colour.",
	alpha: "White pixels were recovered; black ones were left out by the mask.",
	confidence: "How well the matte explains what the camera saw: white is certain, black has failed.",
};

export function layers(matte, signal) {
	const image = h("img", { alt: FIRST, width: matte.width, height: matte.height, draggable: "false", hidden: true });
	const mark = h("span", { class: "mark", hidden: true });
	const stage = h("div", {
		class: "picture layer", tabindex: 0, role: "group",
		"aria-label": "Layer. Move over a pixel, or move the mark by arrow keys, to see where its light comes from.",
	}, image, mark);
	stage.style.aspectRatio = `${matte.width} / ${matte.height}`;
	const about = h("p", { class: "hint" });
	const problem = h("div");
	const light = h("img", { alt: "", hidden: true });
	const status = h("p", { class: "hint", role: "status" }, "Point at a pixel of the layer.");
	const figures = h("div");
	const fail = (error) => signal.aborted || problem.replaceChildren(problemBox(error));

	const choose = newest(async (name) => {
		try {
			about.textContent = LAYERS[name];
			await show(image, await getBlob(`v1/mattes/${matte.id}/layers/${name}.png`, signal));
			image.alt = `The layer ${name}`;
			image.classList.toggle("linear", ["S", "rho"].includes(name)); // linear light, to be encoded for the display
			problem.replaceChildren();
		} catch (error) {
			fail(error);
		}
	});

	let wanted;
	const look = newest(async () => {
		try {
			await pause(CALM, signal);
			const [x, y] = wanted;
			const path = (end) => `v1/mattes/${matte.id}/transport${end}?x=${x}&y=${y}`;
			const [found, picture] = await Promise.all([getJson(path(""), signal), getBlob(path(".png"), signal)]);
			figures.replaceChildren(lobeTable(found));
			await show(light, picture);
			light.alt = `Where on the monitor the light of pixel (${x}, ${y}) comes from`;
			status.textContent = `Pixel (${x}, ${y})`;
			problem.replaceChildren();
		} catch (error) {
			fail(error);
		}
	});
	function point(x, y) {
		const pixel = [Math.min(matte.width - 1, Math.max(0, x)), Math.min(matte.height - 1, Math.max(0, y))];
		if (wanted?.every((value, i) => value === pixel[i])) return;
		wanted = pixel;
		mark.hidden = false;
		mark.style.left = `${(100 * (pixel[0] + 0.5)) / matte.width}%`;
		mark.style.top = `${(100 * (pixel[1] + 0.5)) / matte.height}%`;
		look();
	}
	stage.onpointermove = stage.onpointerdown = (event) => {
		const box = image.getBoundingClientRect();
		point(Math.floor(((event.clientX - box.left) / box.width) * matte.width), Math.floor(((event.clientY - box.top) / box.height) * matte.height));
	};
	stage.onkeydown = (event) => {
		const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
		if (!by || event.ctrlKey || event.metaKey || event.altKey) return;
		event.preventDefault();
		const far = event.shiftKey ? 10 : 1;
		const [x, y] = wanted ?? [matte.width >> 1, matte.height >> 1];
		point(x + far * by[0], y + far * by[1]);
	};
	const names = h("fieldset", { class: "row" }, h("legend", {}, "Layer"), Object.keys(LAYERS).map((name) =>
		h("label", { class: "choice" }, h("input", { type: "radio", name: "layer", checked: name === FIRST, onchange: () => choose(name) }), name)));
	const files = ["all.exr", "stmap.exr"].map((name) => button(name, problem, () => save(`v1/mattes/${matte.id}/layers/${name}`, name)));
	choose(FIRST);
	return h("section", { class: "panel", "aria-label": "Layers" }, h("h2", {}, "Layers, and where the light comes from"),
		h("div", { class: "columns" }, h("div", { class: "stack" }, names, stage, about, h("p", { class: "row" }, "For other tools:", files)),
			h("div", { class: "stack" }, status, h("div", { class: "picture sheet light", tabindex: 0, role: "group", "aria-label": "Where its light comes from" }, light), figures, problem)));
}

// What the picture shows, as a table. The centre of a lobe is in pixels of the monitor from its top left.
function lobeTable({ recovered, S, rho, monitor: [width, height], lobes }) {
	if (!recovered) return h("p", {}, "The mask left this pixel out.");
	const percent = (values) => values.map((value) => h("td", {}, `${(100 * value).toFixed(0)} %`));
	const head = ["", "Red", "Green", "Blue", "Centre", "Spread"].map((name) => h("th", { scope: "col" }, name));
	const row = (name, values, ...more) => h("tr", {}, h("th", { scope: "row" }, name), percent(values), more.map((text) => h("td", {}, text)));
	return h("div", { class: "sheet", tabindex: 0, role: "group", "aria-label": "Lobes of this pixel" },
		h("table", {}, h("thead", {}, h("tr", {}, head)), h("tbody", {}, row("Reflections (S)", S, "", ""), row("Transparency (rho)", rho, "", ""),
			lobes.map(({ u, v, weight, sigma_u: a, sigma_v: b }, n) =>
				row(`Lobe ${n + 1}`, weight, `${Math.round(u * width)}, ${Math.round((1 - v) * height)}`, `${(a * width).toFixed(1)} × ${(b * width).toFixed(1)}`)))));
}
