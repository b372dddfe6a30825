// The form that starts a recovery. Its options and their descriptions come from GET /v1/options.
import { getJson, post } from "../lib/api.js";
import { duration, h, problemBox, prose } from "../lib/dom.js";
import { QUALITIES, staying } from "../lib/view.js";
import { said, t } from "../lib/words.js";

const BY_HAND = "envmatte-recover-by-hand"; // in this browser's storage
export const automatic = new Set(); // jobs whose matte is shown once it is done

function field(option) {
	const id = `option-${option.method ?? "any"}-${option.name}`; // two methods may have an option of the same name
	const attributes = { id, name: option.name, "aria-describedby": `${id}-about` };
	let input;
	if (option.values) {
		input = h("select", attributes, option.values.map((value) => h("option", { value, selected: value === option.default }, value)));
	} else if (option.type === "boolean") {
		input = h("input", { ...attributes, type: "checkbox", checked: option.default });
	} else {
		const whole = option.type === "integer";
		input = h("input", {
			...attributes, type: "number", min: option.minimum, max: option.maximum, step: whole ? 1 : "any",
			placeholder: option.default ?? "", inputmode: whole ? "numeric" : "decimal",
		});
	}
	const range = !option.values && option.minimum != null ? ` ${t("option.range", { least: option.minimum, most: option.maximum })}` : "";
	const about = h("p.hint", { id: `${id}-about` }, prose(said(option.description)), range);
	const row = h("div.option", h("label", { for: id }, option.name.replaceAll("_", " ")), input, about);
	return { option, input, row };
}

function chosen(fields, method) {
	const options = {};
	for (const { option, input } of fields) {
		if (option.method && option.method !== method) continue;
		const value = input.type === "checkbox" ? input.checked : input.type === "number" ? input.value && Number(input.value) : input.value;
		if (value !== "" && value !== option.default) options[option.name] = value;
	}
	return options;
}

function cards({ name, default: usual }, seconds) {
	return h("fieldset.row.qualities", h("legend", t("quality")), QUALITIES.map((value) =>
		h("label.choice", h("input", { type: "radio", name, value, checked: value === usual, "aria-describedby": `about-${value}` }),
			h("strong", t(`quality.${value}`)), seconds && ` ${t("quality.takes", { time: duration(Math.max(seconds[value], 1)) })}`, h("span.hint", { id: `about-${value}` }, t(`quality.${value}.about`)))));
}

// The form; whether the recovery `isAutomatic` once the frames are read, and what starts it then.
export async function recoveryForm(capture, signal) {
	const { options } = await getJson("v1/options", signal);
	const isQuality = ({ name }) => name === "quality";
	const qualities = cards(options.find(isQuality), capture.recovery_seconds);
	const cutOut = h("input", { type: "checkbox", name: "cut_out", checked: true, "aria-describedby": "about-cut-out" });
	const fields = options.filter((option) => !isQuality(option) && option.name !== "cut_out").map(field);
	const method = fields.find(({ option }) => option.name === "method").input;
	const problem = h("div");
	const isWaiting = capture.state === "ingesting";
	const itself = h("input", { type: "checkbox", checked: !localStorage.getItem(BY_HAND) });
	itself.onchange = () => (itself.checked ? localStorage.removeItem(BY_HAND) : localStorage.setItem(BY_HAND, "1"));
	const form = h("form.panel", { id: "recovery" }, h("h2", t("recover.title")),
		h("p", t("recover.about")),
		qualities,
		h("p", h("label", cutOut, " ", t("recover.cut")), " ", h("span.hint", { id: "about-cut-out" }, t("recover.cut.about"))),
		isWaiting && h("label", itself, " ", t("recover.itself")),
		h("details", h("summary", t("recover.expert")), h("p.hint", t("recover.defaults")),
			h("div.options", fields.map(({ row }) => row))),
		problem, h("p.row", h("button.primary", t(isWaiting ? "recover.soon" : "recover"))));
	const sort = () => {
		for (const { option, row, input } of fields) input.disabled = row.hidden = Boolean(option.method) && option.method !== method.value;
		qualities.disabled = qualities.hidden = method.value !== options.find(isQuality).method;
	};
	method.onchange = sort;
	sort();

	async function start(once) {
		const submit = form.querySelector("button.primary");
		submit.disabled = true;
		const isHere = staying();
		problem.replaceChildren();
		fields.forEach(({ input }) => input.removeAttribute("aria-invalid"));
		try {
			const quality = new FormData(form).get("quality");
			const wanted = { ...chosen(fields, method.value), ...(quality === "fast" && { quality }), ...(cutOut.checked && { cut_out: true }) };
			const job = await post("v1/jobs", { capture: capture.id, options: wanted }, once);
			if (once) automatic.add(job.id);
			if (isHere()) location.hash = `#/jobs/${job.id}`;
		} catch (error) {
			if (once && error.isTemporary) throw error; // its caller starts it again
			problem.replaceChildren(problemBox(error));
			const wrong = fields.find(({ option, input }) => option.name === error.field && !input.disabled)?.input;
			wrong?.setAttribute("aria-invalid", "true");
			wrong?.focus();
		} finally {
			submit.disabled = false;
		}
	}
	form.onsubmit = (event) => {
		event.preventDefault();
		start();
	};
	// A closed section cannot show that an option is out of range.
	form.addEventListener("invalid", () => (form.querySelector("details").open = true), true);
	// Two tabs that show the same capture start one job.
	return { form, isAutomatic: () => itself.checked, start: () => start(`recovery-of-${capture.id}`) };
}
