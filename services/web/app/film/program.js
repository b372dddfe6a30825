// Filming: the choice of a program, and one program with its checklist, its progress on the monitor, and its film.
import { getJson, post } from "../lib/api.js";
import { camera, noCamera } from "./recorder.js";
import { CHECKS } from "./checklist.js";
import { badge, duration, empty, facts, fileField, h, pause, problemBox, prose, size, when } from "../lib/dom.js";
import { follow } from "../lib/events.js";
import { isFilm, programName, recordOf } from "../upload/film_bundle.js";
import { list } from "../lib/list.js";
import { FILM, steps } from "../lib/view.js";
import { countScreen, onZoom } from "./screen.js";
import { begin, onDrop, running } from "../upload/upload.js";

const SILENT = 8; // seconds without a report after which the player page counts as gone; it reports every 2
const CUT = "The program stopped before its end, so this film does not show all of it.";
const isPlaying = ({ showing }) => ["countdown", "showing"].includes(showing?.phase) && showing.age_seconds < SILENT + showing.seconds;

export async function filming(main, signal) {
	const { presets } = await getJson("v1/presets", signal);
	const problem = h("div");
	const number = () => h("input", { type: "number", min: 1, max: 16384, step: 1, required: true });
	const [width, height] = [number(), number()];
	const fill = () => ({ width: width.value, height: height.value } = countScreen());
	fill();
	onZoom(fill, signal);
	const choices = presets.map(({ name, description }, n) => {
		const about = h("span.hint", { id: `preset-${name}` }, description);
		return h("p", h("label.choice", h("input", { type: "radio", name: "preset", value: name, checked: n === 0, "aria-describedby": about.id }), name), " ", about);
	});
	const form = h("form.panel", h("h2", "Choose a program"),
		h("fieldset.stack", h("legend", "What the monitor shows"), choices),
		h("div.row", h("label", "The monitor’s width", width), h("label", "Height", height), "pixels"),
		h("p.hint", "The size of this screen, if the page’s zoom is 100 % (Ctrl+0 or ⌘0). Change it if another screen shows the program."),
		problem, h("p.row", h("button.primary", "Continue")));
	form.onsubmit = async (event) => {
		event.preventDefault();
		problem.replaceChildren();
		try {
			const monitor = { width: width.valueAsNumber, height: height.valueAsNumber };
			const made = await post("v1/programs", { preset: form.elements.preset.value, monitor, border: true });
			location.hash = `#/film/${made.id}`;
		} catch (error) {
			problem.replaceChildren(problemBox(error));
		}
	};
	main.append(steps(FILM), h("h1", "Filming"),
		h("p.lead", "A monitor behind the glass shows patterns, one after another, and a camera films them."),
		form, running, await nearby(signal), h("h2", "Programs"));
	await list(main, signal, {
		page: (after) => getJson(`v1/programs?limit=50${after}`, signal).then((answer) => answer.programs),
		busy: isPlaying,
		none: () => empty("No programs yet", "Choose one above."),
		item: (one) => h("a.card", { href: `#/film/${one.id}` }, h("span.name", programName(one)), isPlaying(one) ? badge("running") : h("span"),
			h("span.about", one.id), when(one.created_at)),
	});
}

// The address of this page for a phone, to be read off the screen.
async function nearby(signal) {
	const isOwn = /^(localhost|127\.|\[::1\]$)/.test(location.hostname);
	const { url, problem } = isOwn ? await getJson("v1/network", signal) : { url: location.origin };
	return h("section.panel", h("h2", "On a phone"),
		url ? [h("p", "A phone in the same network can follow the program and upload its film at"), h("p.address", `${url}/#/film`),
				h("p.hint", "Choose the program there; the newest is first.")]
			: h("p", prose(problem), "."));
}

export async function program(main, signal, id) {
	let found = await getJson(`v1/programs/${id}`, signal);
	const phase = h("p.phase", { role: "timer", "aria-label": "On the monitor" });
	const bar = h("progress", { max: found.patterns, value: 0, "aria-label": "Patterns shown" });
	const about = h("p.hint");
	const problem = h("div");
	const live = h("section.panel", h("h2", "On the monitor"), phase, bar, about,
		h("p.row", h("a.primary", { href: `v1/programs/${id}/play`, target: "_blank", rel: "opener" }, "Play it on this screen")));
	const film = (file, about) => begin(file, recordOf(found, found.showing?.patterns_per_second ?? 2), about);
	const why = noCamera();
	const recorder = why ? null : camera(signal, (file, whole) => film(file, { unsaved: true, warning: whole ? "" : CUT }));
	const take = ([file]) => {
		problem.replaceChildren();
		if (isFilm(file)) film(file);
		else problem.replaceChildren(problemBox({ title: "Not a film", detail: `${file.name} has the type ${file.type || "unknown"}. Choose the video that the camera recorded.` }));
	};
	const choose = fileField({ accept: "video/*", id: "film" }, take);
	const zone = h("div.drop.small", h("label", { for: "film" }, h("strong", "Choose the film"), " that the camera recorded of this program, or drop it here"), choose);
	onDrop(zone, take);
	const filmed = h("section.panel", h("h2", "The film"), recorder ? recorder.panel : h("p", why), zone, problem, running);
	main.append(
		steps(FILM),
		h("p.crumb", h("a", { href: "#/film" }, "Filming")),
		h("h1", programName(found)),
		facts({ Patterns: `${size(found.monitor)} pixels`, "At 2 a second": duration(found.patterns / 2), Made: when(found.created_at) }),
		h("div.columns",
			h("section.panel", h("h2", "Before you start"),
				h("ul.checks", CHECKS.map((text) => h("li", h("label", h("input", { type: "checkbox" }), h("span", text)))))),
			h("div.stack", live, filmed)),
		await nearby(signal),
	);
	let since = performance.now();
	const age = () => (found.showing?.age_seconds ?? 0) + (performance.now() - since) / 1000;
	const draw = () => {
		const now = describe(found, age());
		if (phase.textContent !== now.phase) phase.textContent = now.phase;
		about.textContent = now.about;
		bar.value = now.shown;
	};
	const changed = (now) => {
		[found, since] = [now, performance.now()];
		draw();
		const { phase: reported } = found.showing ?? {};
		if (reported === "countdown" && age() < SILENT) recorder?.start();
		if (reported === "shown" || reported === "stopped") recorder?.stop(reported === "shown");
	};
	const lost = (away) => away && (about.textContent = "The service does not answer; trying again.");
	follow(`v1/programs/${id}/events`, signal, changed, { lost }).catch((error) => signal.aborted || live.append(problemBox(error)));
	(async () => {
		for (;;) {
			draw();
			await pause(250, signal);
		}
	})().catch(() => {}); // the user left the view
	return () => {
		filmed.append(running);
		recorder?.resume();
	};
}

// What the monitor shows now, from what its page reported some seconds ago.
function describe({ showing, patterns }, age) {
	if (!showing) return { phase: "Not started", about: "Open the player on the monitor, and start the program there.", shown: 0 };
	const { phase, seconds, shown, patterns_per_second: rate } = showing;
	if (phase === "shown") return { phase: "All shown", about: `${patterns} patterns, ${rate} a second. Stop recording.`, shown: patterns };
	if (phase === "stopped") return { phase: "Stopped", about: "The program stopped before its end. Start both again, the recording first.", shown: 0 };
	if (age > SILENT + seconds + 1 / rate) return { phase: "No signal", about: `The player has reported nothing for ${duration(age)}.`, shown };
	const ahead = Math.max(seconds - age, 0);
	if (ahead) return { phase: `Starts in ${Math.ceil(ahead)}`, about: "The camera should be recording by now.", shown: 0 };
	const now = Math.min(patterns, Math.floor(shown + Math.max(age - seconds, 0) * rate));
	return { phase: `${now} of ${patterns}`, about: `About ${duration((patterns - now) / rate)} left. Do not touch anything.`, shown: now };
}
