// Records a film.
import { h, pause, problemBox } from "../lib/dom.js";
import { openCamera, setRecording, videoType } from "../lib/recordings.js";
import { t } from "../lib/words.js";
import { aiming } from "./aim.js";

const BITS = 40e6; // per second: stronger compression costs the matte decibels
const LOCKED = ["exposureMode", "whiteBalanceMode", "focusMode"];
const AFTER = 1000; // ms that recording continues after the program

// Why this browser cannot record, in words; null if it can.
export function noCamera() {
	if (!isSecureContext) return t("camera.insecure");
	if (!navigator.mediaDevices?.getUserMedia || !window.MediaRecorder) return t("camera.unable");
	return null;
}

// A panel to record with. `filmed(file, whole)` is called with every film, `ready` when all is well before one; call `resume`
// when the panel is shown again.
export function cameraPanel(signal, filmed, ready) {
	const picture = h("video", { muted: true, playsinline: true, "aria-label": t("camera.sees") });
	const frame = h("div.picture", { hidden: true }, picture);
	const status = h("p.hint", { role: "status" });
	const problem = h("div");
	const which = h("select", { "aria-label": t("camera"), hidden: true });
	const open = h("button", { type: "button", onclick: () => use() }, t("camera.use"));
	const shoot = h("button.primary", { type: "button", hidden: true, onclick: () => (recorder ? stop() : start()) }, t("record.start"));
	const aim = aiming(picture, signal, () => ready().catch((error) => problem.replaceChildren(problemBox(error))));
	let stream;
	let recorder;
	let whole; // whether the program was shown to its end

	async function use(deviceId) {
		problem.replaceChildren();
		open.disabled = which.disabled = true;
		try {
			close();
			const wanted = { width: { ideal: 1920 }, height: { ideal: 1080 }, frameRate: { ideal: 30 } };
			stream = await openCamera(deviceId ? { ...wanted, deviceId: { exact: deviceId } } : { ...wanted, facingMode: "environment" });
			if (signal.aborted) return close();
			picture.srcObject = stream;
			frame.hidden = which.hidden = shoot.hidden = false;
			open.hidden = true;
			const { width, height, deviceId: used } = stream.getVideoTracks()[0].getSettings();
			picture.style.aspectRatio = `${width} / ${height}`;
			const cameras = (await navigator.mediaDevices.enumerateDevices()).filter(({ kind }) => kind === "videoinput");
			which.replaceChildren(...cameras.map(({ deviceId: id, label }, n) => h("option", { value: id, selected: id === used }, label || `${t("camera")} ${n + 1}`)));
			status.textContent = t("record.ready", { width, height });
			await picture.play();
			aim.on = !recorder;
		} catch (error) {
			if (!signal.aborted) problem.replaceChildren(problemBox(error));
		} finally {
			open.disabled = false;
			which.disabled = Boolean(recorder);
		}
	}
	which.onchange = () => use(which.value);

	// Keeps the settings that the camera has found, as a change would look like one of light. Returns those it cannot lock.
	async function lock(track) {
		const can = track.getCapabilities?.() ?? {};
		const free = [];
		for (const mode of LOCKED) {
			if (!can[mode]?.includes("manual")) free.push(t(`lock.${mode}`));
			else await track.applyConstraints({ advanced: [{ [mode]: "manual" }] }).catch(() => free.push(t(`lock.${mode}`)));
		}
		return free;
	}

	async function start() {
		if (!stream || recorder) return;
		const parts = [];
		const mine = (recorder = new MediaRecorder(stream, { mimeType: videoType(), videoBitsPerSecond: BITS }));
		mine.ondataavailable = ({ data }) => parts.push(data);
		mine.onstop = () => {
			recorder = undefined;
			shoot.textContent = t("record.start");
			which.disabled = false;
			status.textContent = t("record.done");
			const [kind] = mine.mimeType.split(";");
			filmed(new File(parts, `film.${kind.endsWith("mp4") ? "mp4" : "webm"}`, { type: kind }), whole);
			setRecording(signal, false);
			aim.on = Boolean(stream);
		};
		whole = false;
		mine.start(1000);
		setRecording(signal, true);
		aim.on = false;
		shoot.textContent = t("record.stop");
		which.disabled = true;
		const free = await lock(stream.getVideoTracks()[0]);
		if (recorder === mine) status.textContent = free.length ? t("record.free", { what: free.join(", ") }) : t("record.on");
	}

	async function stop(ended = true) {
		if (recorder?.state !== "recording") return;
		await pause(AFTER, signal).catch(() => {});
		if (recorder?.state !== "recording") return;
		whole = ended;
		recorder.stop();
	}

	function close() {
		stream?.getTracks().forEach((track) => track.stop());
		stream = undefined;
		aim.on = false;
	}
	signal.addEventListener("abort", close, { once: true });
	const panel = h("div.stack", h("div.row", open, which, shoot), frame, aim.element, status, problem);
	const resume = () => picture.play().catch(() => {}); // the preview stops outside of the page, the recording does not
	return { panel, start, stop, resume };
}
