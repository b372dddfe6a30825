// What people read, in their language: `speak` sets the words of `../words/`, `t` finds one of them.
export const LANGUAGES = { de: "Deutsch", en: "English" };
const LOCALES = { de: "de-DE", en: "en-GB" };
const spoken = { language: "en", words: {} };
let sentences = []; // of the service: what matches each, and its translation
const MOST = 8; // parts of a sentence
const LONGEST = 800; // characters of one, so that no text takes long

// The first language of this browser that the app knows, unless another one is `kept`.
export const preferred = (kept) =>
	[kept, ...navigator.languages.map((one) => one.slice(0, 2))].find((one) => Object.hasOwn(LANGUAGES, one)) ?? "en";

// For numbers and times.
export const locale = () => LOCALES[spoken.language];

// A text with values in its {places}.
export const t = (key, values = {}) => spoken.words[key].replace(/\{(\w+)\}/g, (_, name) => values[name]);

// The same with elements, as children of an element.
export const parts = (key, elements) => spoken.words[key].split(/\{(\w+)\}/).map((part, i) => (i % 2 ? elements[part] : part));

// The text for something that the service names, or what it says itself if there is none.
export const known = (key, otherwise) => spoken.words[key] ?? otherwise;

// The values that stand in {places} of the service's sentences: numbers get the language's decimal mark.
const value = (text) => said(text).replace(/^([-+]?\d+)\.(\d+)$/, `$1${(0.5).toLocaleString(locale())[1]}$2`);

// A sentence of the service, or undefined if the language does not have it.
function translated(text) {
	if (text.length > LONGEST) return;
	for (const [pattern, words] of sentences) {
		const found = pattern.exec(text);
		if (found) return words.replace(/\{(\w+)\}/g, (_, name) => value(found.groups[name]));
	}
}

// What the service says, in the language of the reader as far as that has its sentences. Of the parts between colons and
// semicolons, the most that are one sentence are translated together, from the left.
export function said(text) {
	const parts = text.split(/(?<=[;:] )/);
	let all = "";
	for (let at = 0, n; at < parts.length; at += n) {
		for (n = MOST; n > 0; n--) {
			const [, run, mark = ""] = /^(.*?)([;:] )?$/s.exec(parts.slice(at, at + n).join(""));
			const words = translated(run);
			if (words === undefined && n > 1) continue;
			all += (words ?? run) + mark;
			break;
		}
	}
	return all;
}

// Takes what the service says, in another language: what is most of a text is tried first.
export function learn(service) {
	const fixed = ([text]) => text.replace(/\{\w+\}/g, "").length;
	sentences = Object.entries(service).sort((a, b) => fixed(b) - fixed(a)).map(([text, words]) =>
		[new RegExp(`^${text.replace(/[.*+?^$()|[\]\\]/g, "\\$&").replace(/\{(\w+)\}/g, "(?<$1>[^;]+?)")}$`), words]);
}

// Takes the words of a language, and fills in the page's own: `data-word` is a text, `data-label` a label.
export function speak(language, words) {
	Object.assign(spoken, { language, words });
	document.documentElement.lang = language;
	for (const element of document.querySelectorAll("[data-word]")) element.textContent = t(element.dataset.word);
	for (const element of document.querySelectorAll("[data-label]")) element.ariaLabel = t(element.dataset.label);
}
