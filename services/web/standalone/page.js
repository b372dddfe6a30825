// The glass without a service: the page holds the matte, and the browser draws it. `services/api/mattes/live_page.py` makes
// one file of this module, of those that it imports, and of a matte.
import { NAMES, builtIn, fromFile } from "../app/composite/backdrops.js";
import { Coarseness } from "../app/composite/coarseness.js";
import { decodeLive } from "../app/composite/live_form.js";
import { handleGestures, placement } from "../app/composite/placement.js";
import { createPainter, webglContext } from "../app/composite/webgl.js";
import { h } from "../app/lib/dom.js";

const STILL = 300; // ms without a change after which all pixels are drawn
const stage = document.getElementById("stage");
const canvas = stage.querySelector("canvas");
const choices = document.getElementById("choices");
const monitor = document.body.dataset.monitor.split(" ").map(Number);
const coarseness = new Coarseness();
const placed = placement(moved);
let painter;
let backdrop;
let wanted = 0;
let frame = 0;
let timer;

const say = (text) => (document.getElementById("status").textContent = text);

// The matte of this page: the bytes that the service sends, which are gzip, as base64.
async function matte() {
	const text = atob(document.getElementById("matte").textContent);
	const bytes = Uint8Array.from({ length: text.length }, (_, i) => text.charCodeAt(i));
	const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
	return decodeLive(await new Response(unpacked).arrayBuffer());
}

function moved() {
	clearTimeout(timer);
	frame ||= requestAnimationFrame((now) => {
		frame = 0;
		painter?.draw(placed.values, coarseness.next(now));
	});
	timer = setTimeout(() => {
		coarseness.rest();
		painter?.draw(placed.values);
	}, STILL);
}

// Shows the backdrop that a promise brings; of several, the one that was chosen last.
async function use(promise) {
	const choice = (wanted += 1);
	const found = await promise;
	if (choice !== wanted) return found.close?.();
	if (!found.picture) return say(`This browser cannot read ${found.name}. Use PNG, JPEG or WebP.`);
	backdrop?.close?.();
	backdrop = found;
	painter?.setBackdrop(found.picture);
	say("");
	moved();
}

function take([file]) {
	if (!file) return;
	for (const input of choices.querySelectorAll("[type=radio]")) input.checked = false;
	use(fromFile(file));
}

async function start() {
	const gl = webglContext(canvas);
	if (!gl) return say("This browser has no WebGL2, which draws the glass. Open the page in another one.");
	canvas.addEventListener("webglcontextlost", () => {
		painter = undefined;
		say("The browser lost the graphics card. Reload the page to draw the glass again.");
	});
	const found = await matte();
	if (Math.max(found.width, found.height, ...found.texture) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
		return say("This matte is too large for the graphics card of this device.");
	}
	stage.style.setProperty("--aspect", found.width / found.height);
	painter = createPainter(gl, found, monitor);
	handleGestures(stage, placed);
	const choice = (name, i) =>
		h("label", {}, h("input", { type: "radio", name: "backdrop", checked: i === 0, onchange: () => use(builtIn(name, monitor)) }), name);
	choices.prepend(h("fieldset", {}, h("legend", {}, "Backdrop"), NAMES.map(choice)));
	document.getElementById("reset").append(placed.reset);
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
start().catch((error) => say(`Cannot draw the glass: ${error.message}`));
