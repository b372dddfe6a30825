// The first view: a sample to play with, before anything is read or filmed.
import { button, fileField, h, problemBox } from "../lib/dom.js";
import { fromFile } from "../composite/backdrops/backdrops.js";
import { scenery } from "../composite/backdrops/scenery.js";
import { cameraSymbol, choice, fileSymbol, thumbOf, thumbs } from "../composite/backdrops/thumb_choices.js";
import { handleGestures, placementControls } from "../composite/placement.js";
import { cameraBackdrop } from "../composite/backdrops/video_backdrops.js";
import { fileInput, onDrop, upload } from "../upload/upload.js";
import { GlassWindow } from "./glass_window.js";
import { aboutOf, areRemoved, fetchSamples, pictureOf, removeSamples, titleOf } from "./samples.js";
import { t } from "../lib/words.js";

const SCENES = ["Dusk", "Lights", "Tiles"];
const GREETING = 2600; // ms that the backdrop moves by itself at first, to show that it can be moved
const SWAY = 0.16; // how far, in widths of the monitor

export async function home(main, signal) {
	if (areRemoved()) return location.replace("#/captures");
	const samples = await fetchSamples(signal);
	await new Promise((next) => requestAnimationFrame(() => setTimeout(next))); // the header shows while WebGL2 starts
	const controls = placementControls(() => glass.moved());
	const glass = new GlassWindow(controls.values, signal);
	handleGestures(glass.element, controls, glass);
	const problem = h("div");
	const fail = (error) => signal.aborted || problem.replaceChildren(problemBox(error));
	const title = h("h1");
	const about = h("p.about");

	async function show(sample) {
		title.textContent = titleOf(sample);
		about.textContent = `${aboutOf(sample)}. ${glass.gl ? t("home.drag") : ""}`;
		problem.replaceChildren();
		await glass.show(sample).catch(fail);
	}
	let used; // the control of the backdrop that is shown
	async function use(promise, control) {
		problem.replaceChildren();
		try {
			const taken = await glass.use(promise);
			if (taken) used = control;
			return taken;
		} catch (error) {
			if (used) used.checked = true;
			fail(error);
		}
	}
	const drawn = (name) => Promise.resolve(scenery(name, ...samples[0].monitor));
	const backdrops = SCENES.map((name, i) => choice("backdrop", t(`scene.${name}`), scenery(name, 96, 72).picture, i === 0, (control) => use(drawn(name), control)));
	backdrops.push(choice("backdrop", t("home.camera"), cameraSymbol(), false, (control) => use(cameraBackdrop(), control)));
	// A file is no choice before it is chosen: then a radio button that nobody sees marks it.
	const isOwn = h("input", { type: "radio", name: "backdrop", hidden: true });
	const frame = h("span.frame", fileSymbol());
	backdrops.push(h("label.thumb-choice", fileField({ accept: "image/*", title: "" }, take), isOwn, frame, h("span", t("page.own"))));
	const glasses = samples.map((sample, i) =>
		choice("sample", titleOf(sample), h("img", { src: pictureOf(sample), alt: "", width: 96, height: 72, draggable: "false" }), i === 0, () => show(sample)));

	async function take(files) {
		if (files.length > 1 || !files[0].type.startsWith("image/")) return upload(files);
		const opened = fromFile(files[0]).then((found) => found.picture ? found : Promise.reject(new Error(t("home.unreadable"))));
		const own = await use(opened, isOwn);
		if (!own) return;
		isOwn.checked = true;
		frame.replaceChildren(thumbOf(own));
	}
	onDrop(glass.element, take);
	const remove = button(t("home.remove"), problem, () => {
		removeSamples();
		location.hash = "#/captures";
	}, "plain");
	const sheet = h("section.controls", { "aria-label": t("home.sample") },
		h("div.title", h("div.row", title, h("span.badge.sample", t("home.traced"))), about, glass.status),
		thumbs(t("home.glasses"), glasses), glass.gl ? thumbs(t("backdrop"), backdrops) : null,
		h("div.actions", h("a.primary", { href: "#/film" }, t("home.film")),
			h("span.upload", fileInput("upload"), h("label", { for: "upload" }, t("upload"))), remove),
		problem);
	main.append(h("div.home", glass.element, sheet));

	const fitted = new ResizeObserver(() => glass.fit(sheet.offsetTop));
	for (const element of [glass.element, sheet]) fitted.observe(element);
	signal.addEventListener("abort", () => fitted.disconnect());
	glass.fit(sheet.offsetTop);
	use(drawn(SCENES[0]), backdrops[0].querySelector("input"));
	await show(samples[0]);
	greet(glass.element, controls, signal);
}

// Sways the backdrop until something is touched.
function greet(element, controls, signal) {
	if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
	const touched = new AbortController();
	for (const type of ["pointerdown", "keydown", "wheel"]) addEventListener(type, () => touched.abort(), { signal: touched.signal, passive: true });
	const start = performance.now();
	(function sway() {
		const part = Math.min(1, (performance.now() - start) / GREETING);
		if (touched.signal.aborted || signal.aborted) return;
		controls.set({ right: SWAY * Math.sin(2 * Math.PI * part) * (1 - part) });
		if (part < 1) requestAnimationFrame(sway);
		else touched.abort();
	})();
}
