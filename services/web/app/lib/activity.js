// The activity menu: the last jobs. It is refreshed while it is open or something runs.
import { getJson } from "./api.js";
import { badge, h, newest } from "./dom.js";
import { ACTIVE } from "./events.js";

const REFRESH = 4000; // ms
const SHOWN = 8;
export const KINDS = { ingest: "Ingest of a capture", recover: "Recovery of a matte", composite: "Composite of a clip" };
const menu = document.getElementById("activities");
const count = document.getElementById("active");
let timer;

export const jobCard = (job, ...more) =>
	h("a.card", { href: `#/jobs/${job.id}` }, h("span.name", KINDS[job.kind]), badge(job.state),
		h("span.about", job.problem?.detail ?? (job.state === "running" ? `${job.stage}, ${Math.floor(100 * job.progress)} %` : job.id)), more);

export const refreshActivity = newest(async () => {
	clearTimeout(timer);
	const { jobs } = await getJson(`v1/jobs?limit=${SHOWN}`).catch(() => ({}));
	const isOpen = menu.matches(":popover-open");
	if (jobs) {
		const active = jobs.filter(({ state }) => ACTIVE.includes(state)).length;
		count.textContent = active || "";
		const focused = menu.contains(document.activeElement) ? document.activeElement.hash : undefined;
		menu.replaceChildren(
			h("ul.list", jobs.map((job) => h("li", jobCard(job)))),
			jobs.length ? h("a", { href: "#/jobs" }, "All jobs") : h("p", "No jobs yet"));
		if (focused) menu.querySelector(`[href="${focused}"]`)?.focus();
		if (!active && !isOpen) return;
	}
	if (jobs || isOpen) timer = setTimeout(refreshActivity, REFRESH);
});

menu.addEventListener("toggle", ({ newState }) => newState === "open" && refreshActivity());
addEventListener("hashchange", () => menu.hidePopover());
