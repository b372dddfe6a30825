// The language of the app: that of the browser, or the one that was chosen here. Only its words are loaded.
import { h } from "./dom.js";
import { LANGUAGES, learn, locale, preferred, speak } from "./words.js";

const SERVICE = "en"; // the language that the service speaks
const KEPT = "envmatte-language"; // in this browser's storage

export async function loadWords() {
	const language = preferred(localStorage.getItem(KEPT));
	// Once more under another name: when the network changes, browsers abort what they load.
	const load = async (file) => (await import(file).catch(() => import(`${file}?again`)))[language];
	const [words, service] = await Promise.all([load(`../words/${language}.js`), language === SERVICE ? {} : load(`../words/service/${language}.js`)]);
	learn(service);
	speak(language, words);
}

// A button for each other language.
export const languageSwitch = () => Object.entries(LANGUAGES).filter(([language]) => !locale().startsWith(language)).map(([language, name]) => h("button", {
	type: "button", lang: language,
	onclick() {
		localStorage.setItem(KEPT, language);
		location.reload();
	},
}, name));
