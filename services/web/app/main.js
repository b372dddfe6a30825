// Shows the view that the part of the URL after `#` names, so that a reload and the back button keep it.
import { RETRY } from "./lib/api.js";
import { h, pause, problemBox } from "./lib/dom.js";
import { refreshActivity } from "./lib/activity.js";
import { recordings } from "./lib/recordings.js";
import { home } from "./home/home.js";
import { captures } from "./views/captures.js";
import { capture } from "./views/capture.js";
import { filming, program } from "./film/program.js";
import { job, jobs } from "./views/jobs.js";
import { matte, mattes } from "./views/mattes.js";
import { languageSwitch, loadWords } from "./lib/language.js";
import { t } from "./lib/words.js";
import { offerFilms } from "./upload/upload.js";

const VIEWS = { home: [home], film: [filming, program], captures: [captures, capture], jobs: [jobs, job], mattes: [mattes, matte] };
const main = document.getElementById("main");
const note = document.getElementById("recording");
const views = new Map(); // by their part of the URL: the one that is shown, and those that record a film
let shown;

// Ends the views that are not shown, except those that record a film: these are shown again when opened.
function tidy() {
	for (const [hash, view] of views) {
		if (view === shown || recordings.has(view.signal)) continue;
		view.stop.abort();
		views.delete(hash);
	}
	const [away] = [...views].find(([, view]) => view !== shown) ?? [];
	note.hidden = !away;
	if (away) note.hash = away;
}
addEventListener("recording", tidy);

function open(hash) {
	const stop = new AbortController();
	const view = { stop, signal: stop.signal, element: h("div.view") };
	views.get(hash)?.stop.abort();
	views.set(hash, view);
	return view;
}

// Waits until the service, which was away, answers again.
async function returned(signal) {
	do await pause(RETRY, signal);
	while (!(await fetch("healthz", { signal }).catch(() => null))?.ok);
}

async function route(navigated) {
	// What follows a question mark is the view's own.
	const [, hash, name = "home", id] = /^(#\/(?:(\w+)(?:\/([\w-]+))?)?)(?:\?.*)?$/.exec(location.hash) ?? [];
	if (hash === undefined || !VIEWS[name]?.[id ? 1 : 0]) return location.replace("#/");
	for (const dialog of document.querySelectorAll("dialog[open]:not(#unlock)")) dialog.close(); // it was about the view before
	const before = views.get(hash);
	const view = (shown = recordings.has(before?.signal) ? before : open(hash));
	tidy();
	if (name !== "home") refreshActivity(); // the first view needs no key
	for (const link of document.querySelectorAll("nav a")) {
		if (link.hash === `#/${name}`) link.setAttribute("aria-current", "page");
		else link.removeAttribute("aria-current");
	}
	main.replaceChildren(view.element);
	main.ariaBusy = "true";
	try {
		if (view === before) view.resume();
		else view.resume = await VIEWS[name][id ? 1 : 0](view.element, view.signal, id);
	} catch (error) {
		const final = error.status >= 400 && error.status < 500 && error.status !== 401;
		const again = !final && h("p", h("button", { type: "button", onclick: () => route(true) }, t("again")));
		if (!view.signal.aborted) view.element.append(problemBox(error), again || "");
		if (error.isTemporary) returned(view.signal).then(() => route(false), () => {}); // the user left the view
	}
	if (view !== shown) return;
	main.ariaBusy = "false";
	const title = main.querySelector("h1");
	document.title = `${title?.textContent ?? "envmatte"} · envmatte`;
	if (navigated) {
		scrollTo(0, 0);
		main.focus({ preventScroll: true });
	}
}

// Moves the focus without following the link, which would replace the view in the URL.
document.querySelector(".skip").onclick = (event) => {
	event.preventDefault();
	main.focus();
};
// Ignores files dropped beside a drop zone: the browser would leave the page to show them.
for (const type of ["dragover", "drop"]) {
	addEventListener(type, (event) => {
		if (event.defaultPrevented || !event.dataTransfer.types.includes("Files")) return;
		event.preventDefault();
		event.dataTransfer.dropEffect = "none";
	});
}
addEventListener("keydown", ({ key, target }) => key === "?" && !target.matches("input, select") && document.getElementById("keys").showModal());
await loadWords();
document.getElementById("languages").append(...languageSwitch());
addEventListener("hashchange", () => route(true));
route(false);
offerFilms();
