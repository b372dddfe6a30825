// The form that starts a recovery. Its options and their descriptions come from GET /v1/options.
import { getJson, post } from "../lib/api.js";
import { h, problemBox, prose } from "../lib/dom.js";

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
	const range = !option.values && option.minimum != null ? ` ${option.minimum} to ${option.maximum}.` : "";
	const about = h("p", { class: "hint", id: `${id}-about` }, prose(option.description), range);
	const row = h("div", { class: "option" }, h("label", { for: id }, option.name.replaceAll("_", " ")), input, about);
	return { option, input, row };
}

// The options that differ from their defaults.
function chosen(fields, method) {
	const options = {};
	for (const { option, input } of fields) {
		if (option.method && option.method !== method) continue;
		const value = input.type === "checkbox" ? input.checked : input.type === "number" ? input.value && Number(input.value) : input.value;
		if (value !== "" && value !== option.default) options[option.name] = value;
	}
	return options;
}

export async function recoveryForm(capture, state, signal) {
	const { options } = await getJson("v1/options", signal);
	const fields = options.map(field);
	const choices = fields.filter(({ option }) => option.values);
	const constants = fields.filter(({ option }) => !option.values);
	const method = fields.find(({ option }) => option.name === "method").input;
	const problem = h("div");
	const form = h("form", { class: "panel", id: "recovery" }, h("h2", {}, "Recover a matte"),
		h("p", {}, "Finds, for each pixel, where on the monitor its light comes from. ",
			state === "ingesting" && "It can be started now, and begins when the frames are read."),
		h("div", { class: "options" }, choices.map(({ row }) => row)),
		h("details", {}, h("summary", {}, "All options"), h("p", { class: "hint" }, "An empty field takes the default shown in grey, or what the choices above set."),
			h("div", { class: "options" }, constants.map(({ row }) => row))),
		problem, h("p", { class: "row" }, h("button", { class: "primary" }, "Start")));
	const sort = () => fields.forEach(({ option, row, input }) => {
		row.hidden = Boolean(option.method) && option.method !== method.value;
		input.disabled = row.hidden;
	});
	method.onchange = sort;
	sort();
	form.onsubmit = async (event) => {
		event.preventDefault();
		const submit = form.querySelector("button.primary");
		submit.disabled = true;
		problem.replaceChildren();
		fields.forEach(({ input }) => input.removeAttribute("aria-invalid"));
		try {
			const job = await post("v1/jobs", { capture, options: chosen(fields, method.value) });
			location.hash = `#/jobs/${job.id}`;
		} catch (error) {
			problem.replaceChildren(problemBox(error));
			const wrong = fields.find(({ option, input }) => option.name === error.field && !input.disabled)?.input;
			wrong?.setAttribute("aria-invalid", "true");
			wrong?.focus();
		} finally {
			submit.disabled = false;
		}
	};
	// Opens the options when one of them is out of range: a closed section cannot show it.
	form.addEventListener("invalid", () => (form.querySelector("details").open = true), true);
	return form;
}
