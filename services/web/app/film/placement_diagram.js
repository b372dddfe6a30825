// How the camera, the glass and the monitor stand, from the side.
import { svg } from "../lib/dom.js";
import { t } from "../lib/words.js";

export function placementDiagram() {
	const label = (x, key) => svg("text", { x, y: 116, "text-anchor": "middle" }, t(key));
	return svg("svg", { viewBox: "0 0 320 124", class: "diagram", role: "img", "aria-label": t("diagram") },
		svg("path", { class: "sight", d: "M46 54 L276 10 V98 Z" }),
		svg("path", { d: "M276 8 h8 v92 h-8 z M280 100 v4 M264 104 h32" }),
		svg("path", { class: "object", d: "M150 34 h24 l-4 48 h-16 z" }),
		svg("path", { d: "M126 104 v-22 h72 v22" }),
		svg("path", { d: "M18 44 h22 v-4 h6 v28 h-6 v-4 h-22 z M28 64 l-10 40 M30 64 v40 M32 64 l10 40" }),
		label(32, "camera"), label(162, "home.glasses"), label(280, "monitor"));
}
