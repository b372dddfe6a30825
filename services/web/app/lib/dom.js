// Elements of pages, and text for numbers and times.
import { known, locale, said, t } from "./words.js";

// `h("p.hint", { id: "why" }, "Text")`: an element with its classes, its attributes if it has any, and its children.
export function h(name, ...children) {
	const [tag, ...classes] = name.split(".");
	const element = document.createElement(tag);
	if (classes.length) element.className = classes.join(" ");
	for (const [name, value] of Object.entries(children[0]?.constructor === Object ? children.shift() : {})) {
		if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
		else if (value !== false && value != null) element.setAttribute(name, value === true ? "" : value);
	}
	element.append(...children.flat(2).filter((child) => child != null && child !== false));
	return element;
}

export function svg(tag, attributes, ...children) {
	const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
	for (const pair of Object.entries(attributes)) element.setAttribute(...pair);
	element.append(...children);
	return element;
}

// A text as elements: what stands between `backticks` is code.
export const prose = (text) => text.split(/`([^`]*)`/).map((part, i) => (i % 2 ? h("code", part) : part));

// A text of the API with a capital letter, unless it begins with a name: of a file, a field or an option.
export const sentence = (text, name) =>
	name && text.startsWith(name) ? text : text.replace(/^\p{Ll}+(?=[ ,])/u, (word) => word[0].toUpperCase() + word.slice(1));

// A box with an error as the API words it, or as the browser does.
export const problemBox = (error) =>
	h("div.problem", { role: "alert" }, h("strong", said(error.title ?? t("wrong"))),
		h("p", prose(sentence(said(error.detail ?? error.message), error.entry))));

export const empty = (title, text) => h("div.empty", h("strong", title), h("p", text)); // a text, or its parts

const LEVEL = {
	good: "good", ready: "good", succeeded: "good",
	warning: "warning", paused: "warning", ingesting: "busy", recovering: "busy", running: "busy", queued: "busy",
	bad: "bad", failed: "bad", cancelled: "off",
};
export const badge = (word) => h("span", { class: `badge ${LEVEL[word] ?? "off"}` }, known(`state.${word}`, word));

export const facts = (pairs) =>
	h("dl.facts", Object.entries(pairs).filter(([, value]) => value != null && value !== "")
		.map(([name, value]) => h("div", h("dt", name), h("dd", value))));

export const bytes = (count) => {
	const units = [t("bytes"), "kB", "MB", "GB", "TB"];
	const power = Math.min(units.length - 1, Math.floor(Math.log10(Math.max(count, 1)) / 3));
	return `${(count / 1000 ** power).toLocaleString(locale(), { maximumFractionDigits: power ? 1 : 0 })} ${units[power]}`;
};

export const tenths = (number) => number.toLocaleString(locale(), { minimumFractionDigits: 1, maximumFractionDigits: 1 });

export const duration = (seconds) => {
	if (seconds == null) return null;
	if (seconds < 10) return `${tenths(seconds)} s`;
	if (seconds < 100) return `${Math.round(seconds)} s`;
	if (seconds < 6000) return `${Math.round(seconds / 60)} min`;
	return `${tenths(seconds / 3600)} h`;
};

export const when = (time) =>
	h("time", { datetime: time }, new Date(time).toLocaleString(locale(), { dateStyle: "medium", timeStyle: "short" }));

export const size = ({ width, height }) => (width ? `${width} × ${height}` : null);

export const pause = (ms, signal) =>
	new Promise((resolve, reject) => {
		const stop = () => (clearTimeout(timer), reject(signal.reason));
		const timer = setTimeout(() => (signal?.removeEventListener("abort", stop), resolve()), ms);
		signal?.aborted ? stop() : signal?.addEventListener("abort", stop, { once: true });
	});

// Wraps a function so that it runs once at a time; of the calls that come meanwhile, only the newest runs.
export function newest(work) {
	let next;
	let busy = false;
	return async (...given) => {
		next = given;
		if (busy) return;
		busy = true;
		try {
			while (next) {
				const now = next;
				next = undefined;
				await work(...now);
			}
		} finally {
			busy = false;
		}
	};
}

// Puts a picture into an `img`, which appears with its first one, and frees the one before.
export async function show(image, blob) {
	const url = URL.createObjectURL(blob);
	const before = image.dataset.url;
	image.dataset.url = image.src = url;
	await image.decode().catch(() => {});
	image.hidden = false;
	if (before) URL.revokeObjectURL(before);
}

// Asks a question that "yes" or "no" answers; resolves with true for yes.
export function confirmed(title, text, yes) {
	const dialog = document.getElementById("confirm");
	document.getElementById("confirm-title").textContent = title;
	document.getElementById("confirm-text").textContent = text;
	document.getElementById("confirm-yes").textContent = yes;
	dialog.returnValue = "no";
	dialog.showModal();
	return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}

// A field for files, which `take` gets; the same file can be chosen again.
export function fileField(attributes, take) {
	const input = h("input", { type: "file", ...attributes });
	input.onchange = () => {
		if (input.files.length) take(input.files);
		input.value = "";
	};
	return input;
}

// A button that is disabled while its work runs; an error is shown in `where`.
export function button(text, where, work, kind = "") {
	return h("button", {
		type: "button", class: kind,
		onclick: async ({ currentTarget }) => {
			currentTarget.disabled = true;
			where.replaceChildren();
			try {
				await work();
			} catch (error) {
				if (error.name !== "AbortError") where.replaceChildren(problemBox(error));
			} finally {
				currentTarget.disabled = false;
				// What is disabled loses the focus, and keys would begin again at the top.
				if (document.activeElement.matches("body, dialog:not([open]) *")) currentTarget.focus({ preventScroll: true });
			}
		},
	}, text);
}
