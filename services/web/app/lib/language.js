// The language of the app: that of the browser, or the one that was chosen here. Only its words are loaded.
import { h } from "./dom.js";
import { LANGUAGES, locale, preferred, speak, t } from "./words.js";

const KEPT = "envmatte-language"; // in this browser's storage

export async function loadWords() {
	const language = preferred(localStorage.getItem(KEPT));
	const file = `../words/${language}.js`;
	// Once more under another name: when the network changes, browsers abort what they load.
	const found = await import(file).catch(() => import(`${file}?again`));
	speak(language, found[language]);
}

export const languageSwitch = () => [t("language"), ...Object.entries(LANGUAGES).map(([language, name]) => h("button", {
	type: "button", lang: language, "aria-pressed": String(locale().startsWith(language)),
	onclick() {
		localStorage.setItem(KEPT, language);
		location.reload();
	},
}, name))];
