// The activity menu: the last jobs. It is refreshed while it is open or something runs.
import { getJson } from "./api.js";
import { badge, h, newest } from "./dom.js";
import { ACTIVE } from "./events.js";
import { qualityOf } from "./view.js";
import { known, said, t } from "./words.js";

const POLL = 4000; // ms between two requests
const SHOWN = 8;
const menu = document.getElementById("activities");
const entries = menu.firstElementChild;
const count = document.getElementById("active");
let timer;

export const jobTitle = ({ kind, name }) => known(`job.${kind}`, kind) + (name && `: ${name}`);

export const jobCard = (job, ...more) =>
	h("a.card", { href: `#/jobs/${job.id}` }, h("span.name", jobTitle(job)), badge(job.state),
		h("span.about", job.problem ? said(job.problem.detail) : (job.state === "running" ? `${known(`stage.${job.stage}`, job.stage)}, ${Math.floor(100 * job.progress)} %` : qualityOf(job) || "")), more);

export const refreshActivity = newest(async () => {
	clearTimeout(timer);
	const { jobs, isTemporary } = await getJson(`v1/jobs?limit=${SHOWN}`).catch((error) => ({ isTemporary: error.isTemporary }));
	const isOpen = menu.matches(":popover-open");
	if (jobs) {
		const active = jobs.filter(({ state }) => ACTIVE.includes(state)).length;
		count.textContent = active || "";
		const focused = menu.contains(document.activeElement) ? document.activeElement.hash : undefined;
		entries.replaceChildren(
			h("ul.list", jobs.map((job) => h("li", jobCard(job)))),
			jobs.length ? h("a", { href: "#/jobs" }, t("jobs.all")) : h("p", t("jobs.none")));
		if (focused) menu.querySelector(`[href="${focused}"]`)?.focus();
		if (!active && !isOpen) return;
	}
	if (jobs || isOpen || (isTemporary && count.textContent)) timer = setTimeout(refreshActivity, POLL);
});

menu.addEventListener("toggle", ({ newState }) => {
	if (newState === "open") refreshActivity();
});
addEventListener("hashchange", () => menu.hidePopover());
