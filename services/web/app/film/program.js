// Filming: the choice of a program, and one program with its checklist, its progress on the monitor, and its film.
import { elsewhere, getJson, newKey, post, putJson } from "../lib/api.js";
import { cameraPanel, noCamera } from "./recorder.js";
import { checks } from "./checklist.js";
import { badge, duration, empty, facts, fileField, h, pause, problemBox, prose, size, when } from "../lib/dom.js";
import { follow } from "../lib/events.js";
import { STILLS, filmManifestOf, isFilm, isStill, programName, stillsManifestOf, together } from "../upload/archive.js";
import { list } from "../lib/list.js";
import { FILM, staying, steps } from "../lib/view.js";
import { countScreen, isPhone, onZoom } from "./screen.js";
import { begin, onDrop, running } from "../upload/upload.js";
import { parts, said, t } from "../lib/words.js";
import { placementDiagram } from "./placement_diagram.js";

const USUAL = { width: 1920, height: 1080 }; // pixels of a monitor
const COUNTDOWN = 8; // seconds, about
const SILENT = 8; // seconds without a report after which the player page counts as gone; it reports every 2
const isPlaying = ({ showing }) => ["countdown", "showing"].includes(showing?.phase) && showing.age_seconds < SILENT + showing.seconds;

export async function filming(main, signal) {
	const { presets } = await getJson("v1/presets", signal);
	const problem = h("div");
	const number = () => h("input", { type: "number", min: 1, max: 16384, step: 1, required: true });
	const [width, height] = [number(), number()];
	const fill = () => ({ width: width.value, height: height.value } = isPhone() ? USUAL : countScreen());
	fill();
	onZoom(fill, signal);
	const choices = presets.map(({ name, description }, n) => {
		const about = h("span.hint", { id: `preset-${name}` }, said(description));
		return h("p.preset", h("label.choice", h("input", { type: "radio", name: "preset", value: name, checked: n === 0, "aria-describedby": about.id }), name), about);
	});
	const submit = h("button.primary", t("continue"));
	const form = h("form.panel", h("h2", t("film.choose")),
		h("fieldset.stack", h("legend", t("film.shows")), choices),
		h("div.row", h("label", t("film.width"), width), h("label", t("film.height"), height), h("span.unit", t("film.pixels"))),
		h("p.hint", t(isPhone() ? "film.other" : "film.screen")),
		problem, h("p.row", submit));
	form.onsubmit = async (event) => {
		event.preventDefault();
		problem.replaceChildren();
		submit.disabled = true;
		const isHere = staying();
		try {
			const monitor = { width: width.valueAsNumber, height: height.valueAsNumber };
			const made = await post("v1/programs", { preset: form.elements.preset.value, monitor, border: true });
			if (isHere()) location.hash = `#/film/${made.id}`;
		} catch (error) {
			problem.replaceChildren(problemBox(error));
		} finally {
			submit.disabled = false;
		}
	};
	main.append(steps(FILM), h("h1", t("filming")),
		h("p.lead", t("film.lead")),
		form, running, await nearby(signal, "film"), h("h2", t("programs")));
	await list(main, signal, {
		kind: "programs", text: programName,
		busy: isPlaying,
		none: () => empty(t("programs.none"), t("programs.first")),
		item: (one) => h("a.card", { href: `#/film/${one.id}` }, h("span.name", programName(one)), isPlaying(one) ? badge("running") : h("span"),
			h("span.about", duration(one.patterns / 2)), when(one.created_at)),
	});
}

// The address of a view for a phone, to be read off the screen.
async function nearby(signal, view) {
	const { url, problem } = await elsewhere(signal);
	if (!url) return h("section.panel", h("h2", t("phone")), h("p", prose(said(problem)), "."));
	const address = `${url}/#/${view}`;
	const code = h("img.code", { src: `v1/qr.svg?${new URLSearchParams({ text: address })}`, alt: t("phone.code"), width: 160, height: 160 });
	code.onerror = () => (code.hidden = true); // a proxy may have other names for the service than it knows
	return h("section.panel", h("h2", t("phone")),
		h("div.row", code, h("div.stack", h("p", t("phone.at")), h("p.address", address), view === "film" && h("p.hint", t("phone.choose")))));
}

export async function program(main, signal, id) {
	let found = await getJson(`v1/programs/${id}`, signal);
	const phase = h("p.phase", { role: "timer", "aria-label": t("film.on") });
	const bar = h("progress", { max: found.patterns, value: 0, "aria-label": t("film.shown") });
	const about = h("p.hint");
	const problem = h("div");
	const live = h("section.panel", h("h2", t("film.on")), phase, bar, about,
		h("p.row", h("a.primary", { href: `v1/programs/${id}/play`, target: "_blank", rel: "opener" }, t("film.play"))));
	const film = (file, about) => begin(file, filmManifestOf(found, found.showing?.patterns_per_second ?? 2), { again: `#/film/${id}`, ...about });
	// The player starts when it learns that a countdown has begun, and then reports its own.
	const startPlayer = () => putJson(`v1/programs/${id}/showing`, { phase: "countdown", patterns_per_second: found.showing?.patterns_per_second ?? 2, seconds: COUNTDOWN });
	const why = noCamera();
	const recorder = why ? null : cameraPanel(signal, (file, whole) => film(file, { id: newKey(), warning: whole ? "" : t("film.cut") }), startPlayer);
	const take = ([file, ...more]) => {
		problem.replaceChildren();
		if (isFilm(file)) film(file);
		else if (more.length && isStill(file)) begin(together([file, ...more]), stillsManifestOf(found));
		else problem.replaceChildren(problemBox({ title: t("film.none"), detail: t("film.type", { name: file.name, type: file.type || t("film.unknown") }) }));
	};
	const choose = fileField({ accept: `video/*,${STILLS}`, id: "film", multiple: true }, take);
	const zone = h("div.drop.small", h("label", { for: "film" }, parts("film.drop", { choose: h("strong", t("film.file")) })), choose);
	onDrop(zone, take);
	const filmed = h("section.panel", h("h2", t("film.taken")), recorder ? recorder.panel : h("p", why), zone, problem, running);
	main.append(
		steps(FILM),
		h("p.crumb", h("a", { href: "#/film" }, t("filming"))),
		h("h1", programName(found)),
		facts({ [t("patterns")]: t("pixels", { size: size(found.monitor) }), [t("film.at")]: duration(found.patterns / 2), [t("made")]: when(found.created_at) }),
		h("div.columns",
			h("section.panel", h("h2", t("film.before")), placementDiagram(),
				h("ul.checks", checks().map((text) => h("li", h("label", h("input", { type: "checkbox" }), h("span", text)))))),
			h("div.stack", live, filmed)),
		await nearby(signal, `film/${id}`),
	);
	let since = performance.now();
	const age = () => (found.showing?.age_seconds ?? 0) + (performance.now() - since) / 1000;
	let isAway = false;
	const draw = () => {
		const now = describe(found, age());
		if (phase.textContent !== now.phase) phase.textContent = now.phase;
		about.textContent = isAway ? t("film.away") : now.about;
		bar.value = now.shown;
	};
	const changed = (now) => {
		const isNews = now.showing?.told_at !== found.showing?.told_at; // else a playback that may have ended long ago
		[found, since] = [now, performance.now()];
		draw();
		if (!isNews) return;
		const { phase: reported } = found.showing ?? {};
		if (reported === "countdown" && age() < SILENT) recorder?.start();
		if (reported === "shown" || reported === "stopped") recorder?.stop(reported === "shown");
	};
	const lost = (away) => {
		isAway = away;
		draw();
	};
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
	if (!showing) return { phase: t("phase.none"), about: t("phase.none.about"), shown: 0 };
	const { phase, seconds, shown, patterns_per_second: rate } = showing;
	if (phase === "shown") return { phase: t("phase.shown"), about: t("phase.shown.about", { patterns, rate }), shown: patterns };
	if (phase === "stopped") return { phase: t("phase.stopped"), about: t("phase.stopped.about"), shown: 0 };
	if (age > SILENT + seconds + 1 / rate) return { phase: t("phase.silent"), about: t("phase.silent.about", { time: duration(age) }), shown };
	const ahead = Math.max(seconds - age, 0);
	if (ahead) return { phase: t("phase.ahead", { n: Math.ceil(ahead) }), about: t("phase.ahead.about"), shown: 0 };
	const now = Math.min(patterns, Math.floor(shown + Math.max(age - seconds, 0) * rate));
	return { phase: t("of", { n: now, all: patterns }), about: t("phase.left", { time: duration((patterns - now) / rate) }), shown: now };
}
