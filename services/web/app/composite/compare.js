// Divides the picture: its left shows the live picture, the bare backdrop or another matte.
import { h, newest } from "../lib/dom.js";
import { drawPlaced } from "./backdrops/backdrops.js";
import { t } from "../lib/words.js";

// Returns the controls. `others` are mattes by a name.
export function comparison(stage, matte, others) {
	const { width, height } = matte;
	const aside = h("canvas.aside", { width, height, hidden: true, "aria-hidden": "true" });
	const context = aside.getContext("2d");
	const divider = h("input.divider", { type: "range", min: 0, max: 100, step: "any", value: 50, hidden: true, "aria-label": t("compare.divide") });
	const cut = () => stage.element.style.setProperty("--divide", `${divider.value}%`);
	divider.oninput = cut;
	cut();
	divider.onpointerdown = divider.onkeydown = (event) => event.stopPropagation(); // the backdrop stays where it is
	const kinds = {
		[t("compare.nothing")]: null,
		[t("compare.live")]: () => stage.isLive && context.drawImage(stage.drawn(), 0, 0, width, height),
		[t("backdrop")]: () => {
			if (stage.isLive) return context.drawImage(stage.drawn(true), 0, 0, width, height);
			return stage.backdrop.picture ? drawPlaced(context, stage.backdrop.picture, stage.place, matte.monitor) : false;
		},
	};
	for (const [name, other] of Object.entries(others)) {
		kinds[name] = async () => context.drawImage(await createImageBitmap(await stage.composite("image/jpeg", {}, stage.backdrop, other.id)), 0, 0, width, height);
	}
	let chosen = null;
	let moves = 0;
	const hide = (is) => (aside.hidden = divider.hidden = is);
	const draw = newest(async () => {
		hide(true);
		if (!chosen || !stage.isExact) return;
		const before = moves;
		const made = await Promise.resolve(chosen()).catch((error) => (stage.fail(error), false));
		hide(made === false || before !== moves); // what is moved meanwhile is drawn again
	});
	stage.element.append(aside, divider);
	stage.element.addEventListener("exact", draw);
	stage.element.addEventListener("moved", () => {
		moves++;
		hide(true);
	});
	const choice = (name) => h("label.choice",
		h("input", { type: "radio", name: "compare", checked: !kinds[name], onchange: () => ((chosen = kinds[name]), draw()) }), name);
	return h("fieldset.row", h("legend", t("compare.with")), Object.keys(kinds).map(choice));
}
