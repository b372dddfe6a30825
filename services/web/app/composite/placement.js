// Where the backdrop stands before the monitor: four numbers, set by sliders, keys, the wheel, a drag or a pinch.
import { h } from "../lib/dom.js";
import { t } from "../lib/words.js";

const CONTROLS = [
	// name, default, minimum, maximum, step of the slider and of the keys
	["right", 0, -2, 2, 0.01],
	["down", 0, -2, 2, 0.01],
	["scale", 1, 0.1, 10, 0.01],
	["angle", 0, -180, 180, 1],
];
const DEFAULTS = Object.fromEntries(CONTROLS.map(([name, value]) => [name, value]));
const KEYS = {
	ArrowLeft: ["right", -2], ArrowRight: ["right", 2], ArrowUp: ["down", -2], ArrowDown: ["down", 2],
	"+": ["scale", 5], "-": ["scale", -5], "[": ["angle", -2], "]": ["angle", 2],
};

// The four numbers in `values`, at first those `given` as texts, and the elements that set them.
export function placementControls(changed, given = {}) {
	const values = { ...DEFAULTS };
	const sliders = Object.fromEntries(CONTROLS.map(([name, , min, max, step]) => {
		const logarithmic = name === "scale"; // as far from 1 to 10 as from 1 to a tenth
		const [low, high, fine] = logarithmic ? [Math.log10(min), Math.log10(max), 0.01] : [min, max, step];
		const input = h("input", { type: "range", id: `place-${name}`, min: low, max: high, step: fine });
		input.oninput = () => set({ [name]: logarithmic ? 10 ** input.value : Number(input.value) });
		return [name, { input, output: h("output", { for: `place-${name}` }) }];
	}));

	function update(wanted) {
		for (const [name, , min, max] of CONTROLS) {
			let value = wanted[name] ?? values[name];
			if (name === "angle") value = ((((value + 180) % 360) + 360) % 360) - 180;
			values[name] = Number(Math.min(max, Math.max(min, value)).toFixed(4));
			const { input, output } = sliders[name];
			input.value = name === "scale" ? Math.log10(values.scale) : values[name];
			input.ariaValueText = output.textContent = name === "angle" ? `${Math.round(values.angle)}°` : `${Math.round(100 * values[name])} %`;
		}
	}
	function set(wanted) {
		update(wanted);
		changed();
	}
	function step(name, steps) {
		const [, , , , fine] = CONTROLS.find(([control]) => control === name);
		set({ [name]: name === "scale" ? values.scale * 1.02 ** steps : values[name] + steps * fine });
	}

	update(Object.fromEntries(CONTROLS.map(([name]) => [name, parseFloat(given[name])]).filter(([, value]) => Number.isFinite(value))));
	return {
		values, set, step,
		get moved() {
			return Object.entries(values).filter(([name, value]) => value !== DEFAULTS[name]);
		},
		sliders: h("div.sliders", CONTROLS.map(([name]) =>
			[h("label", { for: `place-${name}` }, t(`place-${name}`)), sliders[name].input, sliders[name].output])),
		reset: h("button", { type: "button", onclick: () => set(DEFAULTS) }, t("reset")),
	};
}

// Lets keys, the wheel, the mouse and fingers set a placement behind a glass.
export function handleGestures(element, controls, glass) {
	element.addEventListener("keydown", (event) => {
		const [name, steps] = KEYS[event.key] ?? [];
		if (!name || event.target !== element || event.ctrlKey || event.metaKey || event.altKey) return;
		event.preventDefault();
		controls.step(name, event.shiftKey && event.key.startsWith("Arrow") ? 5 * steps : steps);
	});
	element.addEventListener("wheel", (event) => {
		if (document.activeElement !== element && !event.ctrlKey) return; // without focus the wheel scrolls the page
		event.preventDefault();
		controls.set({ scale: controls.values.scale * Math.exp(-event.deltaY * (event.deltaMode ? 0.03 : 0.001)) });
	}, { passive: false });
	handlePointers(element, controls, glass);
}

// One finger or the mouse moves; two fingers scale and turn as well.
function handlePointers(element, controls, glass) {
	const fingers = new Map();
	const state = () => {
		const [a, b = a] = [...fingers.values()];
		const [dx, dy] = [b.x - a.x, b.y - a.y];
		return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(dx, dy), angle: (Math.atan2(dy, dx) * 180) / Math.PI };
	};
	element.onpointerdown = (event) => {
		if (event.button) return;
		element.setPointerCapture(event.pointerId);
		fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
	};
	element.onpointermove = (event) => {
		if (!fingers.has(event.pointerId)) return;
		const before = state();
		fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
		const now = state();
		const { width, height } = glass.spread;
		const { right, down, scale, angle } = controls.values;
		const wanted = { right: right + (now.x - before.x) / width, down: down + (now.y - before.y) / height };
		if (fingers.size === 2 && before.apart > 10) {
			wanted.scale = (scale * now.apart) / before.apart;
			wanted.angle = angle + now.angle - before.angle;
		}
		controls.set(wanted);
	};
	element.onpointerup = element.onpointercancel = (event) => fingers.delete(event.pointerId);
}
