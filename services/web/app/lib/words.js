// What people read, in their language: `speak` sets the words of `../words/`, `t` finds one of them.
export const LANGUAGES = { de: "Deutsch", en: "English" };
const LOCALES = { de: "de-DE", en: "en-GB" };
const spoken = { language: "en", words: {} };
let sentences = []; // of the service: what matches each, and its translation

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
const value = (text) => translated(text) ?? text.replace(/^([-+]?\d+)\.(\d+)$/, `$1${(0.5).toLocaleString(locale())[1]}$2`);

// A text of the service, or undefined if the language has no sentence for any part of it.
function translated(text) {
	for (const [pattern, words] of sentences) {
		const found = pattern.exec(text);
		if (found) return words.replace(/\{(\w+)\}/g, (_, name) => value(found.groups[name]));
	}
	for (const { 0: mark, index } of text.matchAll(/[;:] /g)) {
		const [before, after] = [text.slice(0, index), text.slice(index + mark.length)];
		const [first, rest] = [before, after].map(translated);
		if (first ?? rest) return (first ?? before) + mark + (rest ?? after);
	}
}

// What the service says, in the language of the reader as far as that has its sentences.
export const said = (text) => translated(text) ?? text;

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
