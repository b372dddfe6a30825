// What people read, in their language: `speak` sets the words of `../words/`, `t` finds one of them.
export const LANGUAGES = { de: "Deutsch", en: "English" };
const LOCALES = { de: "de-DE", en: "en-GB" };
const spoken = { language: "en", words: {} };

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

// Takes the words of a language, and fills in the page's own: `data-word` is a text, `data-label` a label.
export function speak(language, words) {
	Object.assign(spoken, { language, words });
	document.documentElement.lang = language;
	for (const element of document.querySelectorAll("[data-word]")) element.textContent = t(element.dataset.word);
	for (const element of document.querySelectorAll("[data-label]")) element.ariaLabel = t(element.dataset.label);
}
