// A matte that is being recovered while its preview is on the stage: its progress, a pause, and what comes first.
import { getJson, patchJson } from "../lib/api.js";
import { ACTIVE } from "../lib/events.js";
import { button, h, newest, pause, problemBox } from "../lib/dom.js";
import { followJob } from "../lib/job_progress.js";
import { showAgain } from "../lib/view.js";
import { t } from "../lib/words.js";

const POLL = 3000; // ms between two pictures
const LEAST = 4; // pixels that are dragged for a rectangle

// `done` is called once all of the matte is there.
export function recovering(matte, stage, signal, done) {
	const problem = h("div");
	const region = regionChoice(stage, matte, problem);
	const halt = pauseButton(matte.job, problem);
	const progress = h("div");
	const look = newest(async () => {
		stage.renew();
		await pause(POLL, signal).catch(() => {});
	});
	followJob(progress, matte.job, signal, (job) => {
		halt.update(job);
		region.hidden = job.state !== "running";
		if (job.state === "running") look();
	}).then(async ({ state }) => {
		if (state !== "succeeded") return;
		Object.assign(matte, await getJson(`v1/mattes/${matte.id}`, signal));
		stage.fetch();
		stage.renew(); // also where this browser cannot draw the glass
		done();
	}).catch((error) => {
		if (signal.aborted) return;
		if (error.isTemporary) showAgain(); // once the service answers
		else problem.replaceChildren(problemBox(error));
	});
	return h("section.panel", { "aria-label": t("progress") }, h("p", t("matte.preview")), h("p.row", halt.button, region), progress, problem);
}

// A button that pauses a job and continues it, and what sets it to the state of the job.
export function pauseButton(id, problem) {
	let isPaused = false;
	const made = button(t("job.pause"), problem, () => patchJson(`v1/jobs/${id}`, { paused: !isPaused }));
	made.hidden = true;
	return {
		button: made,
		update: ({ state, paused }) => {
			made.hidden = !ACTIVE.includes(state);
			isPaused = paused;
			const text = t(paused ? "job.continue" : "job.pause");
			if (made.textContent !== text) made.textContent = text;
		},
	};
}

// A button after which a rectangle is dragged on the stage; it is recovered first.
function regionChoice(stage, matte, problem) {
	const box = h("div.region", { hidden: true });
	const cover = h("div.choosing", { hidden: true }, box);
	stage.element.append(cover);
	const made = h("button", { type: "button", "aria-pressed": "false", onclick: () => choose(cover.hidden) }, t("region"));
	const choose = (is) => {
		cover.hidden = !is;
		box.hidden = true;
		if (is) stage.element.scrollIntoView({ block: "nearest" });
		made.setAttribute("aria-pressed", is);
	};
	let start;
	// In shares of the stage: left, top, width and height.
	const dragged = ({ clientX, clientY }) => {
		const { left, top, width, height } = cover.getBoundingClientRect();
		const inside = (at) => Math.min(Math.max(at, 0), 1);
		const now = [inside((clientX - left) / width), inside((clientY - top) / height)];
		start ??= now;
		return [...start.map((at, n) => Math.min(at, now[n])), ...start.map((at, n) => Math.abs(at - now[n]))];
	};
	cover.onpointerdown = (event) => {
		event.stopPropagation();
		cover.setPointerCapture(event.pointerId);
		dragged(event);
	};
	cover.onpointermove = (event) => {
		if (!start) return;
		const [left, top, width, height] = dragged(event).map((share) => `${100 * share}%`);
		Object.assign(box.style, { left, top, width, height });
		box.hidden = false;
	};
	cover.onpointercancel = () => (start = undefined);
	cover.onpointerup = async (event) => {
		if (!start) return;
		const shares = dragged(event);
		start = undefined;
		const [x, y, width, height] = shares.map((share, n) => Math.round(share * (n % 2 ? matte.height : matte.width)));
		choose(false);
		if (Math.min(width, height) < LEAST) return;
		try {
			await patchJson(`v1/jobs/${matte.job}`, { region: { x, y, width, height } });
			problem.replaceChildren();
		} catch (error) {
			problem.replaceChildren(problemBox(error));
		}
	};
	return made;
}
