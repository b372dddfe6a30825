// The first view: a sample to play with, before anything is read or filmed.
import { button, h, problemBox } from "../lib/dom.js";
import { fromFile } from "../composite/backdrops.js";
import { handleGestures, placement } from "../composite/placement.js";
import { camera } from "../composite/video_backdrops.js";
import { fileInput, onDrop, upload } from "../upload/upload.js";
import { GlassWindow } from "./glass_window.js";
import { areRemoved, fetchSamples, removeSamples, still } from "./samples.js";
import { NAMES, scenery } from "./scenery.js";

const GREETING = 2600; // ms that the backdrop moves by itself at first, to show that it can be moved
const SWAY = 0.16; // how far, in widths of the monitor

export async function home(main, signal) {
	if (areRemoved()) return location.replace("#/captures");
	const samples = await fetchSamples(signal);
	await new Promise((next) => requestAnimationFrame(() => setTimeout(next))); // the header shows while WebGL2 starts
	const placed = placement(() => glass.moved());
	const glass = new GlassWindow(placed.values, signal);
	handleGestures(glass.element, placed, glass.monitor);
	const problem = h("div");
	const fail = (error) => signal.aborted || problem.replaceChildren(problemBox(error));
	const title = h("h1");
	const about = h("p", { class: "about" });

	async function show(sample) {
		title.textContent = sample.title;
		about.textContent = `${sample.about}.${glass.isLive ? " Drag the picture: what is behind the glass moves." : ""}`;
		await glass.show(sample).catch(fail);
	}
	let used; // the control of the backdrop that is shown
	async function use(promise, control) {
		problem.replaceChildren();
		try {
			await glass.use(promise);
			used = control;
		} catch (error) {
			if (used) used.checked = true;
			fail(error);
		}
	}
	const drawn = (name) => Promise.resolve(scenery(name, ...samples[0].monitor));
	const backdrops = NAMES.map((name, i) => choice("backdrop", name, scenery(name, 96, 72).picture, i === 0, (control) => use(drawn(name), control)));
	backdrops.push(choice("backdrop", "Use my camera", cameraSymbol(), false, (control) => use(camera(), control)));
	const glasses = samples.map((sample, i) =>
		choice("sample", sample.title, h("img", { src: still(sample), alt: "", width: 96, height: 72, draggable: "false" }), i === 0, () => show(sample)));

	const take = (files) => {
		if (!files[0].type.startsWith("image/")) return upload(files);
		for (const control of main.querySelectorAll("[name=backdrop]")) control.checked = false;
		use(fromFile(files[0]).then((found) => found.picture ? found : Promise.reject(new Error("This browser cannot show the picture. Use PNG or JPEG."))));
	};
	onDrop(glass.element, take);
	const remove = button("Remove the samples", problem, () => {
		removeSamples();
		location.hash = "#/captures";
	}, "plain");
	const sheet = h("section", { class: "controls", "aria-label": "Sample" },
		h("div", { class: "title" }, h("div", { class: "row" }, title, h("span", { class: "badge sample" }, "Sample: traced, not filmed")), about, glass.status),
		thumbs("Glass", glasses), glass.isLive ? thumbs("Backdrop", backdrops) : null,
		h("div", { class: "actions" }, h("a", { class: "primary", href: "#/film" }, "Film your own"),
			h("span", { class: "upload" }, fileInput("upload"), h("label", { for: "upload" }, "Upload")), remove),
		problem);
	main.append(h("div", { class: "home" }, glass.element, sheet));

	const fitted = new ResizeObserver(() => glass.fit(sheet.offsetTop));
	for (const element of [glass.element, sheet]) fitted.observe(element);
	signal.addEventListener("abort", () => fitted.disconnect());
	glass.fit(sheet.offsetTop);
	use(drawn(NAMES[0]), backdrops[0].querySelector("input"));
	await show(samples[0]);
	greet(glass.element, placed, signal);
}

// Sways the backdrop until something is touched.
function greet(element, placed, signal) {
	if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
	const touched = new AbortController();
	for (const type of ["pointerdown", "keydown", "wheel"]) addEventListener(type, () => touched.abort(), { signal: touched.signal, passive: true });
	const start = performance.now();
	(function sway() {
		const part = Math.min(1, (performance.now() - start) / GREETING);
		if (touched.signal.aborted || signal.aborted) return;
		placed.set({ right: SWAY * Math.sin(2 * Math.PI * part) * (1 - part) });
		if (part < 1) requestAnimationFrame(sway);
		else touched.abort();
	})();
}

const thumbs = (legend, choices) => h("fieldset", { class: "thumbs" }, h("legend", {}, legend), h("div", {}, choices));

function choice(group, name, picture, checked, chosen) {
	const control = h("input", { type: "radio", name: group, checked, onchange: () => chosen(control) });
	return h("label", { class: "thumb-choice" }, control, h("span", { class: "frame" }, picture), h("span", {}, name));
}

function cameraSymbol() {
	const symbol = document.createElementNS("http://www.w3.org/2000/svg", "svg");
	symbol.setAttribute("viewBox", "0 0 24 18");
	symbol.setAttribute("aria-hidden", "true");
	const path = document.createElementNS(symbol.namespaceURI, "path");
	path.setAttribute("d", "M4 3h3l1.5-2h7L17 3h3a2 2 0 0 1 2 2v10a2 2 0 0 1-2 2H4a2 2 0 0 1-2-2V5a2 2 0 0 1 2-2zm8 2.5a4.5 4.5 0 1 0 0 9 4.5 4.5 0 0 0 0-9zm0 2a2.5 2.5 0 1 1 0 5 2.5 2.5 0 0 1 0-5z");
	symbol.append(path);
	return symbol;
}
