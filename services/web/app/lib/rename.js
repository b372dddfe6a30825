// A heading whose text the user can change in place.
import { button, h, problemBox } from "./dom.js";
import { t } from "./words.js";

// `save` stores a new text, and resolves with the text as it is stored.
export function renamable(text, label, save) {
	const problem = h("div");
	const title = h("h1", text);
	const input = h("input", { type: "text", maxlength: 200, required: true, "aria-label": label });
	const form = h("form.row", { hidden: true }, input, h("button.primary", t("save")), h("button", { type: "button", onclick: () => edit(false) }, t("cancel")));
	const rename = button(t("rename"), problem, () => edit(true));
	function edit(editing) {
		form.hidden = !editing;
		title.hidden = rename.hidden = editing;
		problem.replaceChildren();
		if (!editing) return rename.focus();
		input.value = title.textContent;
		input.focus();
		input.select();
	}
	form.onkeydown = ({ key }) => {
		if (key === "Escape") edit(false);
	};
	form.onsubmit = async (event) => {
		event.preventDefault();
		try {
			title.textContent = await save(input.value.trim());
			if (title.isConnected) document.title = `${title.textContent} · envmatte`;
			edit(false);
		} catch (error) {
			problem.replaceChildren(problemBox(error));
		}
	};
	return h("div.stack", h("div.row", title, rename, form), problem);
}
