// Explains a pixel: its lobes on the backdrop, a line to the heaviest one, and words.
import { getJson } from "../lib/api.js";
import { facts, h, newest, pause, problemBox, svg, tenths } from "../lib/dom.js";
import { drawPlaced } from "./backdrops/backdrops.js";
import { t } from "../lib/words.js";

const CALM = 120; // ms that the pointer rests before its pixel is requested
const INSET = 0.4; // widths of the stage that the backdrop takes
const SHARP = 0.02; // widths of the monitor below which a lobe is sharp

const PLACES = ["topleft", "top", "topright", "left", "middle", "right", "bottomleft", "bottom", "bottomright"];

const mean = (colours) => colours.reduce((sum, one) => sum + one, 0) / colours.length;
const percent = (share) => `${Math.round(100 * share)} %`;

// `button` switches it on; then the pointer or arrow keys choose the pixel.
export function explanation(stage, matte, signal) {
	const { width, height, monitor: [wide, high] } = matte;
	const [across, down] = [INSET * width, (INSET * width * high) / wide];
	const inset = h("canvas.inset", { width: 320, height: Math.round((320 * high) / wide), "aria-hidden": "true", hidden: true });
	const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, class: "lobes", "aria-hidden": "true" });
	const words = h("p.explained", { role: "status", hidden: true });
	const figures = h("div");
	const problem = h("div");
	let pixel; // undefined while it is off
	let explained; // what is drawn

	const look = newest(async () => {
		try {
			await pause(CALM, signal);
			if (!pixel) return;
			const [x, y] = pixel;
			const found = await getJson(`v1/mattes/${matte.id}/transport?x=${x}&y=${y}`, signal);
			if (!pixel) return;
			words.textContent = t("pixel", { x, y, words: inWords(found) });
			figures.replaceChildren(found.recovered ? figuresOf(found) : "");
			draw((explained = found));
			problem.replaceChildren();
		} catch (error) {
			if (!signal.aborted) problem.replaceChildren(problemBox(error));
		}
	});

	// The backdrop stands in the corner that is farthest from the pixel, and the words beside it.
	function draw({ x, y, lobes }) {
		const [left, top] = [x < width / 2 ? width - across : 0, y < height / 2 ? height - down : 0];
		Object.assign(inset.style, { left: `${(100 * left) / width}%`, top: `${(100 * top) / height}%`, width: `${100 * INSET}%` });
		Object.assign(words.style, { [left ? "left" : "right"]: 0, [top ? "bottom" : "top"]: 0, [left ? "right" : "left"]: "auto", [top ? "top" : "bottom"]: "auto" });
		inset.hidden = !stage.backdrop?.picture;
		if (!inset.hidden) drawPlaced(inset.getContext("2d"), stage.backdrop.picture, stage.placed, matte.monitor);
		const heaviest = Math.max(...lobes.map(({ weight }) => mean(weight)));
		const marks = lobes.map(({ u, v, weight, sigma_u: a, sigma_v: b, theta }) => {
			const [cx, cy] = [left + u * across, top + (1 - v) * down];
			return svg("ellipse", {
				cx, cy, rx: Math.max(2 * a * across, width / 150), ry: Math.max(2 * b * across, width / 150),
				transform: `rotate(${(-theta * 180) / Math.PI} ${cx} ${cy})`, opacity: Math.max(0.25, mean(weight) / heaviest),
			});
		});
		const line = lobes.length ? [svg("path", { d: `M${x + 0.5} ${y + 0.5}L${left + lobes[0].u * across} ${top + (1 - lobes[0].v) * down}` })] : [];
		drawing.replaceChildren(...line, svg("circle", { cx: x + 0.5, cy: y + 0.5, r: width / 100 }), ...marks);
	}

	function choose(x, y) {
		pixel = [Math.min(width - 1, Math.max(0, x)), Math.min(height - 1, Math.max(0, y))];
		look();
	}
	stage.element.addEventListener("pointermove", (event) => {
		if (!pixel || event.buttons) return;
		const box = stage.element.getBoundingClientRect();
		choose(Math.floor(((event.clientX - box.left) / box.width) * width), Math.floor(((event.clientY - box.top) / box.height) * height));
	});
	stage.element.addEventListener("moved", () => pixel && explained && draw(explained));
	// Before the keys that move the backdrop.
	stage.element.addEventListener("keydown", (event) => {
		if (pixel && event.key === "Escape") return explain();
		const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
		if (!pixel || !by || event.ctrlKey || event.metaKey || event.altKey) return;
		event.preventDefault();
		event.stopImmediatePropagation();
		const far = event.shiftKey ? 10 : 1;
		choose(pixel[0] + far * by[0], pixel[1] + far * by[1]);
	});
	function explain(first) {
		pixel = first;
		explained = undefined;
		button.ariaPressed = String(Boolean(pixel));
		panel.hidden = words.hidden = !pixel;
		inset.hidden = true;
		drawing.replaceChildren();
		if (pixel) look();
	}
	const button = h("button", {
		type: "button", "aria-pressed": "false",
		onclick: () => explain(pixel ? undefined : [width >> 1, height >> 1]),
	}, t("pixel.explain"));
	stage.element.append(inset, drawing, words);
	const panel = h("div.stack", { hidden: true }, figures, problem);
	return { button, panel };
}

function inWords({ recovered, S, rho, lobes }) {
	if (!recovered) return t("pixel.masked");
	const reflected = mean(S) >= 0.005 ? ` ${t("pixel.reflections", { share: percent(mean(S)) })}` : "";
	if (!lobes.length) return (mean(rho) < 0.005 ? t("pixel.opaque") : t("pixel.faint", { light: percent(mean(rho)) })) + reflected;
	const [{ u, v, weight, sigma_u: a, sigma_v: b }] = lobes;
	const third = (share) => Math.min(2, Math.floor(3 * Math.max(0, share)));
	const place = t(`place.${PLACES[3 * third(1 - v) + third(u)]}`);
	const share = Math.min(1, mean(weight));
	const how = Math.max(a, b) < SHARP ? t("pixel.sharp") : t("pixel.spread", { share: percent(Math.min(1, 4 * Math.max(a, b))) });
	return t("pixel.through", { light: percent(mean(rho)), share: percent(share), place, how }) + reflected;
}

// The figures of each colour. The centre and the spread of a lobe are in pixels of the monitor, from its top left.
function figuresOf({ S, rho, monitor: [width, height], lobes }) {
	const colours = (values) => values.map(percent).join(", ");
	const lobe = ({ u, v, weight, sigma_u: a, sigma_v: b }) =>
		t("pixel.lobe", { weight: colours(weight), x: Math.round(u * width), y: Math.round((1 - v) * height), a: tenths(a * width), b: tenths(b * width) });
	return facts({
		[t("pixel.rho")]: colours(rho), [t("pixel.S")]: colours(S),
		...Object.fromEntries(lobes.map((one, n) => [t("pixel.lobe.n", { n: n + 1 }), lobe(one)])),
	});
}
