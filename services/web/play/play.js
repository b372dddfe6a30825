// Plays a program full screen, and reports its progress to the service for a phone that follows.
import { LEAD, LEAD_SECONDS, borderOn, draw, schedule } from "./border.js";
import { newKey, received, request } from "../app/lib/api.js";
import { checks } from "../app/film/checklist.js";
import { countScreen, knownScreen, onZoom, rememberScreen } from "../app/film/screen.js";
import { loadWords } from "../app/lib/language.js";
import { parts, said, t } from "../app/lib/words.js";
import { h, sentence } from "../app/lib/dom.js";
import { follow } from "../app/lib/events.js";

const COUNTDOWN = 5; // seconds
const AHEAD = 8; // pictures decoded ahead: all of them would fill the memory
const AT_ONCE = 4; // parallel requests
const REPORT = 2000; // ms between two reports of progress
const NEXT = [" ", "Enter", "ArrowRight", "ArrowDown", "PageDown"]; // keys, some of them those of a presenter
const BACK = ["Backspace", "ArrowLeft", "ArrowUp", "PageUp"];

// The pictures of a program: all are fetched before it starts, the next few are decoded.
class Pictures {
	#blobs = [];
	#decoded = new Map();

	async load(count, fetched, progress) {
		let next = 0;
		let done = 0;
		const work = async () => {
			while (next < count) {
				const n = next++;
				this.#blobs[n] = await received((await fetched(`patterns/${n}.png`)).blob());
				progress(++done / count);
			}
		};
		await Promise.all(Array.from({ length: AT_ONCE }, work));
	}

	// Decodes the pictures from a number on, and frees those before it.
	async prepare(first) {
		for (const [n, entry] of this.#decoded) {
			if (n < first) {
				this.#decoded.delete(n);
				entry.then((picture) => picture.close(), () => {});
			}
		}
		for (let n = first; n < Math.min(first + AHEAD, this.#blobs.length); n++) {
			if (!this.#decoded.has(n)) {
				const entry = createImageBitmap(this.#blobs[n], { colorSpaceConversion: "none" });
				entry.then((picture) => (entry.picture = picture), () => {});
				this.#decoded.set(n, entry);
			}
		}
		await Promise.all(this.#decoded.values());
	}

	// The picture of a number if it is decoded.
	at(n) {
		return this.#decoded.get(n)?.picture;
	}
}

// The next animation frame. A hidden page has none, so stopping rejects.
const nextFrame = (stopped) =>
	new Promise((resolve, reject) => {
		if (stopped.aborted) return reject(stopped.reason);
		requestAnimationFrame(resolve);
		stopped.onabort = () => reject(stopped.reason);
	});

// Shows each step for a whole number of the display's refreshes, once its picture is decoded. If one refresh is missed, the
// next step is shorter by it; if more are, the beat starts again. Returns when each step was first shown.
async function show(context, border, steps, pictures, refresh, stopped, passed) {
	const shown = [];
	let due = -Infinity;
	for (const [i, step] of steps.entries()) {
		let now;
		let picture;
		do {
			now = await nextFrame(stopped);
			picture = pictures.at(step.number);
		} while (now < due - refresh / 2 || (step.number !== LEAD && !picture));
		draw(context, border, step, picture);
		shown.push({ number: step.number, white: step.white, at: now });
		passed(step.number);
		// On time, the next step follows the beat; too late, a new beat starts.
		const start = now < due + 1.5 * refresh ? due : now;
		due = start + Math.max(1, Math.round((step.seconds * 1000) / refresh)) * refresh;
		if (i + 1 < steps.length && steps[i + 1].number !== LEAD) {
			pictures.prepare(steps[i + 1].number).catch(() => {}); // the program waits for a picture that fails, until Escape
		}
	}
	while ((await nextFrame(stopped)) < due - refresh / 2);
	return shown;
}

// Counts down, and measures the refresh interval of the display meanwhile: the median between frames, in ms.
async function countDown(element, stopped) {
	const begin = await nextFrame(stopped);
	const times = [begin];
	while (times.at(-1) < begin + COUNTDOWN * 1000) {
		const left = String(Math.ceil(COUNTDOWN - (times.at(-1) - begin) / 1000));
		if (element.textContent !== left) element.textContent = left;
		times.push(await nextFrame(stopped));
	}
	element.textContent = "";
	const distances = times.slice(1).map((time, i) => time - times[i]).sort((a, b) => a - b);
	return distances[Math.floor(distances.length / 2)];
}

// The pixels of the display under an element, at any zoom.
const measure = (element) =>
	new Promise((resolve) => {
		const observer = new ResizeObserver(([entry]) => {
			observer.disconnect();
			const exact = entry.devicePixelContentBoxSize?.[0];
			const rounded = (length) => Math.round(length * devicePixelRatio);
			const { width, height } = entry.contentRect;
			resolve({
				width: exact?.inlineSize ?? rounded(width),
				height: exact?.blockSize ?? rounded(height),
				isMeasured: true,
				isExact: Boolean(exact),
			});
		});
		try {
			observer.observe(element, { box: "device-pixel-content-box" });
		} catch {
			observer.observe(element); // Safari measures in CSS pixels only
		}
	});

const $ = (id) => document.getElementById(id);
const setStatus = (text) => ($("status").textContent = text);
const fail = ({ title, detail, message }) => setStatus(title ? `${said(title)}. ${sentence(said(detail))}` : message);
const here = new URL(".", location.href);
const sizeOf = ({ width, height }) => `${width} × ${height}`;

async function ask(path, options) {
	try {
		return await request(new URL(path, here), options);
	} catch (error) {
		if (error.status === 401) $("unlock").hidden = false;
		throw error;
	}
}

const id = here.pathname.split("/").at(-2);

// Reports progress. The program continues if that fails; `keepalive` sends it when the page is closed, too.
const report = (progress) =>
	ask("showing", { method: "PUT", body: JSON.stringify(progress), headers: { "Content-Type": "application/json" }, keepalive: true }).catch(() => {});

let surface; // what shows the patterns, as far as the page knows

// The zoom in per cent of a page that counts one size where there is another; 100 if zoom does not explain it.
function zoomBetween(counted, real) {
	const [across, down] = [counted.width / real.width, counted.height / real.height];
	return Math.abs(across / down - 1) < 0.05 ? Math.round(100 * across) : 100; // full screen may be lower than the screen
}

// Compares a program with a surface, and says what to do where patterns are resampled. Returns whether they fit.
function checkFit({ display, program }, found) {
	surface = found;
	const { width, height, isMeasured, isWindow } = surface;
	const near = isMeasured ? 1 : devicePixelRatio;
	const fits = Boolean(display) && Math.abs(display.width - width) < near && Math.abs(display.height - height) < near;
	const made = display ? t("play.made", { size: sizeOf(display) }) : t("play.borderless");
	const misfit = t(isWindow ? "play.window" : "play.screen", { made, size: sizeOf(surface) });
	const real = isMeasured ? surface : display;
	const zoom = real && !isWindow ? zoomBetween(countScreen(), real) : 100;
	const zoomed = t(isMeasured ? "play.zoomed" : "play.maybe", { zoom });
	$("misfit").textContent = zoom === 100 ? misfit : `${zoomed} ${isMeasured ? "" : `${t("play.stays")} `}${misfit}`;
	$("refit").onclick = () => refit(program, { width, height }).catch(fail);
	$("fit").hidden = fits;
	return fits;
}

async function open() {
	const program = await received((await ask(`../${id}`)).json());
	const { patterns, monitor } = program;
	$("about").textContent = t("play.about", { n: patterns, size: sizeOf(monitor) });
	checkFit(program, knownScreen());
	onZoom(() => checkFit(program, knownScreen()));
	const pictures = new Pictures();
	setStatus(t("play.loading"));
	await pictures.load(patterns, ask, (share) => ($("loaded").value = share));
	setStatus(t("play.ready"));
	disable(false);
	$("settings").onsubmit = (event) => {
		event.preventDefault();
		play(program, pictures, Number($("rate").value), event.submitter.id);
	};
}

const disable = (is) => {
	for (const name of ["start", "aim", "stills"]) $(name).disabled = is;
};

async function refit(program, monitor) {
	const body = JSON.stringify({ program, monitor, border: true });
	const answer = await ask("../../programs", { method: "POST", body, headers: { "Content-Type": "application/json" } });
	location.assign(new URL(`../${(await received(answer.json())).id}/play`, here));
}

// Shows white in the border until a click, a key, or a camera that sees it starts the program.
async function aim(canvas, border, stopped, listen) {
	const context = canvas.getContext("2d", { alpha: false });
	draw(context, border, { number: LEAD, white: true });
	const since = Date.now();
	await new Promise((resolve, reject) => {
		listen(document, "click", resolve);
		listen(document, "keydown", ({ key }) => [" ", "Enter"].includes(key) && resolve());
		stopped.addEventListener("abort", () => reject(stopped.reason));
		const changed = ({ showing }) => showing?.phase === "countdown" && Date.now() - since > 1000 * showing.age_seconds && resolve();
		follow(new URL("events", here).href, stopped, changed).catch(reject);
	});
}

// Shows one picture after another for a still of each: the next at a click or a key, or the one before. There is no border,
// whose light would be in the stills.
async function step(context, border, count, pictures, stopped, listen) {
	let pressed;
	listen(document, "click", () => pressed?.(1));
	listen(document, "keydown", ({ key, repeat }) => !repeat && pressed?.(NEXT.includes(key) - BACK.includes(key)));
	for (let number = 0; number < count; ) {
		await pictures.prepare(number);
		draw(context, border, { number, plain: true }, pictures.at(number));
		number = Math.max(0, number + await new Promise((resolve, reject) => {
			pressed = resolve;
			if (stopped.aborted) return reject(stopped.reason);
			stopped.onabort = () => reject(stopped.reason);
		}));
	}
}

// Plays a program for a film, `how` is "start" or "aim", or for "stills".
async function play(program, pictures, rate, how) {
	const forStills = how === "stills";
	const [stage, canvas] = [$("stage"), $("canvas")];
	const stop = new AbortController();
	const { signal } = stop;
	const listen = (target, event, listener) => target.addEventListener(event, listener, { signal });
	const end = (why) => stop.abort(new Error(why));
	const progress = { playback: newKey(), phase: "countdown", patterns_per_second: rate, seconds: COUNTDOWN + LEAD_SECONDS.reduce((sum, one) => sum + one) };
	const reportStop = () => !forStills && report({ ...progress, phase: "stopped", seconds: 0 });
	let lock;
	let reportedAt = -REPORT;
	$("record").hidden = true;
	disable(true);
	try {
		stage.hidden = false;
		// What stops it is heard from the start: full screen may take a while.
		listen(document, "keydown", (event) => event.key === "Escape" && end(t("play.stopped")));
		listen(document, "visibilitychange", () => document.hidden && end(t("play.hidden")));
		listen(window, "pagehide", reportStop); // what a page sends later, even a microtask later, is sometimes lost
		// The back button stops the program without leaving the page and what it has loaded.
		if (!history.state?.showing) history.pushState({ showing: true }, "");
		listen(window, "popstate", () => end(t("play.stopped")));
		// Without full screen for elements, the stage fills the window.
		const full = await stage.requestFullscreen?.({ navigationUI: "hide" }).then(() => true, () => false);
		listen(document, "fullscreenchange", () => full && !document.fullscreenElement && end(t("play.stopped")));
		lock = await navigator.wakeLock?.request("screen").catch(() => undefined);
		await pictures.prepare(0);
		signal.throwIfAborted();
		const found = { ...(await measure(canvas)), isWindow: !full };
		if (full && found.isExact) rememberScreen(found);
		const isNew = sizeOf(found) !== sizeOf(surface);
		if (!checkFit(program, found) && isNew) throw new Error(t("play.misfit"));
		if (how === "aim") {
			const { width, height } = found;
			[canvas.width, canvas.height] = [width, height];
			const border = borderOn(width, height);
			if (!border.fits) throw new Error(t("play.small"));
			await aim(canvas, border, signal, listen);
			canvas.width = canvas.height = 0;
		}
		if (!forStills) report(progress);
		const refresh = forStills ? 0 : await countDown($("countdown"), signal);
		const { width, height } = await measure(canvas);
		[canvas.width, canvas.height] = [width, height];
		listen(window, "resize", () => end(t("play.resized")));
		const border = borderOn(canvas.width, canvas.height);
		if (!border.fits) throw new Error(t("play.small"));
		const context = canvas.getContext("2d", { alpha: false });
		if (forStills) {
			await step(context, border, program.patterns, pictures, signal, listen);
			return setStatus(t("play.stills.done", { n: program.patterns }));
		}
		Object.assign(progress, { phase: "showing", seconds: 0, border: { width: border.width, height: border.height } });
		const passed = (number) => {
			if (number === LEAD || performance.now() < reportedAt + REPORT) return;
			reportedAt = performance.now();
			report({ ...progress, shown: number + 1 });
		};
		const shown = await show(context, border, schedule(program.patterns, rate), pictures, refresh, signal, passed);
		progress.patterns_per_second = finish(program, border, shown, refresh);
		report({ ...progress, phase: "shown", shown: program.patterns });
	} catch (error) {
		reportStop();
		fail(error);
	} finally {
		stop.abort();
		if (history.state?.showing && !document.hidden) history.back();
		lock?.release();
		if (document.fullscreenElement) await document.exitFullscreen();
		canvas.width = canvas.height = 0;
		$("countdown").textContent = "";
		stage.hidden = true;
		disable(false);
		$(how).focus();
	}
}

function finish(program, { width, height }, shown, refresh) {
	const patterns = shown.filter((step) => step.number !== LEAD);
	const seconds = (patterns.at(-1).at - patterns[0].at) / 1000;
	const rate = Number(((patterns.length - 1) / seconds).toFixed(4));
	const video = { file: "film.mp4", patterns_per_second: rate, border: { width, height } };
	const manifest = { format: "envmatte-capture/1", program: program.program, video };
	URL.revokeObjectURL($("capture").href);
	$("capture").href = URL.createObjectURL(new Blob([JSON.stringify(manifest, null, 1)], { type: "application/json" }));
	$("record").hidden = false;
	setStatus(t("play.done", { n: patterns.length, rate }));
	document.dispatchEvent(new CustomEvent("played", { detail: { shown, refresh } }));
	return rate;
}

$("unlock").onsubmit = (event) => {
	event.preventDefault();
	sessionStorage.setItem("envmatte-key", $("key").value.trim());
	$("unlock").hidden = true;
	start();
};

await loadWords();
document.title = `${t("play.title")} · envmatte`;
$("record").append(...parts("play.record", { record: h("a", { id: "capture", download: "capture.json" }, "capture.json"), film: h("code", "film.mp4"), name: h("code", "capture.json") }));
$("checks").append(...checks().map((text) => Object.assign(document.createElement("li"), { textContent: text })));
$("follow").href = new URL(`/#/film/${id}`, here);
document.querySelector("main").hidden = false; // at once, since words that come later would shift what is below

const start = () => open().catch(fail);
start();
