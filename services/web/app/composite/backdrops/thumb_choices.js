// Choices that are shown as small pictures.
import { h, svg } from "../../lib/dom.js";
import { sizeOf } from "../live/webgl.js";

export const thumbs = (legend, choices) => h("fieldset.thumbs", h("legend", legend), h("div", choices));

export function choice(group, name, picture, checked, chosen) {
	const control = h("input", { type: "radio", name: group, checked, onchange: () => chosen(control) });
	return h("label.thumb-choice", control, h("span.frame", picture), h("span", name));
}

const symbol = (d) => svg("svg", { viewBox: "0 0 24 18", "aria-hidden": "true" }, svg("path", { d }));

export const cameraSymbol = () => symbol("M4 3h3l1.5-2h7L17 3h3a2 2 0 0 1 2 2v10a2 2 0 0 1-2 2H4a2 2 0 0 1-2-2V5a2 2 0 0 1 2-2zm8 2.5a4.5 4.5 0 1 0 0 9 4.5 4.5 0 0 0 0-9zm0 2a2.5 2.5 0 1 1 0 5 2.5 2.5 0 0 1 0-5z");

export const fileSymbol = () => symbol("M10.5 2h3v5.5h5.5v3h-5.5v5.5h-3v-5.5h-5.5v-3h5.5z");

const WIDE = 96; // pixels

// The thumb of a backdrop: its picture or a frame of it, or the end of its name if this browser cannot draw it.
export function thumbOf({ picture, name }) {
	if (!picture) return h("strong.kind", name.slice(name.lastIndexOf(".") + 1));
	const [width, height] = sizeOf(picture);
	const thumb = h("canvas", { width: WIDE, height: Math.max(1, Math.round((WIDE * height) / width)) });
	const draw = () => thumb.getContext("2d").drawImage(picture, 0, 0, thumb.width, thumb.height);
	draw();
	picture.requestVideoFrameCallback?.(draw); // a video that has just begun may have no picture yet
	return thumb;
}
