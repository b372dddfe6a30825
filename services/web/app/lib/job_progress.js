// The progress of a job: bar, stage, time left, what it waits for, and its log.
import { getJson } from "./api.js";
import { ACTIVE, follow } from "./events.js";
import { badge, duration, facts, h, newest, pause, problemBox } from "./dom.js";
import { known, locale, said, t } from "./words.js";

const POLL = 2000; // ms between two requests for the log
const TICK = 1000; // ms

// Fills `panel` and follows a job to its end; resolves with its last state. `changed` gets every state, the `known` first.
export async function followJob(panel, id, signal, changed = () => {}, known = null) {
	const bar = h("progress", { max: 1, value: 0, "aria-label": t("progress") });
	const doing = h("span", { role: "status" }, " ");
	const left = h("span"); // no part of the status: a screen reader would read each second
	const waits = h("p.waits", { hidden: true });
	const about = h("div");
	const problem = h("div");
	const lines = h("ol.log", { tabindex: 0, "aria-label": t("log") });
	const log = h("details", { open: panel.dataset.log != null }, h("summary", t("log")), lines);
	panel.append(h("p.stage", doing, left), bar, waits, about, problem, log);

	let last = 0;
	const read = newest(async (ended) => {
		try {
			const found = (await getJson(`v1/jobs/${id}/log?after=${last}`, signal)).lines;
			const atEnd = lines.scrollTop + lines.clientHeight >= lines.scrollHeight - 8;
			lines.append(...found.map(({ at, text }) => h("li", h("time", { datetime: at }, new Date(at).toLocaleTimeString(locale())), " ", said(text))));
			last = found.at(-1)?.line ?? last;
			if (atEnd) lines.scrollTop = lines.scrollHeight;
			if (!ended) await pause(POLL, signal);
		} catch {} // the next event reads it again
	});

	const show = (job, since = 0) => {
		left.textContent = timeLeft(job, since);
		about.replaceChildren(facts({
			[t("job.tiles")]: job.tiles.total ? t("of", { n: job.tiles.done, all: job.tiles.total }) : null,
			[t("job.lost")]: job.tiles.failed || null,
			[t("job.workers")]: job.state === "running" ? job.workers : null,
			[t("job.ran")]: job.run_seconds ? duration(job.run_seconds + since) : null,
			[t("job.waited")]: job.queued_seconds >= 1 ? duration(job.queued_seconds) : null,
		}));
	};
	let tick; // goes on while no event comes
	let latest;
	const update = (job) => {
		latest = job;
		const active = ACTIVE.includes(job.state);
		const now = performance.now();
		clearInterval(tick);
		if (job.state === "running" && !job.paused) tick = setInterval(() => show(job, (performance.now() - now) / 1000), TICK);
		bar.value = job.progress;
		if (job.state === "running" && job.stage === "finishing") bar.removeAttribute("value"); // it has no parts to count
		bar.hidden = !active && job.state !== "failed";
		doing.replaceChildren(badge(job.paused && active ? "paused" : job.state), ` ${describe(job)}`);
		waits.hidden = !job.waits_for;
		waits.textContent = job.waits_for ? t("job.waits", { why: said(job.waits_for) }) : "";
		show(job);
		problem.replaceChildren(...(job.problem ? [problemBox(job.problem)] : []));
		read(!active);
		changed(job);
	};
	if (known) update(known);
	const lost = (away) => {
		const wasAway = panel.classList.contains("lost");
		panel.classList.toggle("lost", away);
		if (away) {
			clearInterval(tick);
			doing.textContent = t("job.away");
			left.textContent = "";
		} else if (wasAway && latest) update(latest); // an event comes only once something changes
	};
	return follow(`v1/jobs/${id}/events`, signal, update, { lost, over: (job) => !ACTIVE.includes(job.state) }).finally(() => clearInterval(tick));
}

function describe(job) {
	const percent = `${Math.floor(100 * job.progress)} %`;
	if (job.state === "running") {
		if (job.stage !== "finishing") return `${known(`stage.${job.stage}`, job.stage)}, ${percent}`;
		return t(job.kind === "ingest" ? "job.reporting" : "stage.finishing"); // it has no tiles to count
	}
	if (job.state === "succeeded") return t("job.in", { time: duration(job.run_seconds) });
	return job.state === "queued" ? "" : t("job.at", { percent });
}

// What is left `since` some seconds ago; nothing once it takes longer than it was expected to.
function timeLeft({ state, eta_seconds: eta }, since) {
	return state !== "running" || eta == null || eta - since < 0.1 ? "" : t("job.left", { time: duration(eta - since) });
}
