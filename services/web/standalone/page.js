// The glass without a service: the page holds the matte, and the browser draws it. `services/api/mattes/live_page.py` makes
// one file of this module, of those that it imports, and of a matte.
import { builtIn, fromFile } from "../app/composite/backdrops/backdrops.js";
import { LiveGlass } from "../app/composite/live/live_glass.js";
import { decodeLive } from "../app/composite/live/live_form.js";
import { handleGestures, placementControls } from "../app/composite/placement.js";
import { NAMES } from "../app/composite/backdrops/scenery.js";
import { h } from "../app/lib/dom.js";
import { preferred, speak, t } from "../app/lib/words.js";
import { de } from "../app/words/de.js";
import { en } from "../app/words/en.js";

const language = preferred();
speak(language, { de, en }[language]);
const stage = document.getElementById("stage");
const choices = document.getElementById("choices");
const monitor = document.body.dataset.monitor.split(" ").map(Number);
const controls = placementControls(() => glass.moved());
const glass = new LiveGlass(stage.querySelector("canvas"), controls.values, new AbortController().signal);

const say = (text) => (document.getElementById("status").textContent = text);

// The matte of this page: the bytes that the service sends, which are gzip, as base64.
async function matte() {
	const text = atob(document.getElementById("matte").textContent);
	const bytes = Uint8Array.from({ length: text.length }, (_, i) => text.charCodeAt(i));
	const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
	return decodeLive(await new Response(unpacked).arrayBuffer());
}

const readable = (found) => {
	if (!found.picture) throw new Error(t("page.unreadable", found));
	return found;
};

const use = (promise) => glass.use(promise.then(readable)).then((found) => found && say(""), (error) => say(error.message));

function take([file]) {
	if (!file) return;
	for (const input of choices.querySelectorAll("[type=radio]")) input.checked = false;
	use(fromFile(file));
}

async function start() {
	say(t("stage.loading"));
	if (!glass.gl) return say(t("page.nogl"));
	glass.lost = () => say(t("page.lost"));
	const found = await matte();
	if (!glass.load(found, monitor)) return glass.gl && say(t("page.large"));
	stage.style.setProperty("--aspect", found.width / found.height);
	handleGestures(stage, controls, glass);
	const choice = (name, i) =>
		h("label", h("input", { type: "radio", name: "backdrop", checked: i === 0, onchange: () => use(builtIn(name, monitor)) }), t(`scene.${name}`));
	choices.prepend(h("fieldset", h("legend", t("backdrop")), NAMES.map(choice)));
	document.getElementById("reset").append(controls.reset);
	const own = document.querySelector("#own input");
	own.onchange = () => {
		take(own.files);
		own.value = "";
	};
	choices.hidden = false;
	await use(builtIn(NAMES[0], monitor));
	// Keys and the wheel work at once, unless another page frames this one and would lose the focus.
	if (window === window.top) stage.focus();
}

// A picture may be dropped anywhere: beside the stage the browser would leave the page to show it.
addEventListener("dragover", (event) => (event.preventDefault(), stage.classList.add("over")));
addEventListener("dragleave", () => stage.classList.remove("over"));
addEventListener("drop", (event) => {
	event.preventDefault();
	stage.classList.remove("over");
	take(event.dataTransfer.files);
});
start().catch((error) => say(t("page.failed", { why: error.message })));
