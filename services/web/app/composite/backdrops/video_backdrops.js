// Moving backdrops: the camera of this device, and clips.
import { Problem } from "../../lib/api.js";
import { openCamera } from "../../lib/recordings.js";
import { PREVIEW, snapshot } from "./backdrops.js";
import { t } from "../../lib/words.js";

const WHOLE = 1920; // pixels of the longer side of a frame that is sent as a still

export async function cameraBackdrop() {
	if (!navigator.mediaDevices) {
		throw new Problem({ title: t("camera.failed"), detail: t("camera.https") });
	}
	const stream = await openCamera({ width: { ideal: 1280 }, height: { ideal: 720 } });
	const stop = () => stream.getTracks().forEach((track) => track.stop());
	return played(t("camera"), (video) => (video.srcObject = stream), stop).catch((error) => {
		stop();
		throw error;
	});
}

export async function clipBackdrop(file) {
	const url = URL.createObjectURL(file);
	try {
		return { ...(await played(file.name, (video) => (video.src = url), () => URL.revokeObjectURL(url))), clip: file };
	} catch {
		URL.revokeObjectURL(url);
		const none = () => {
			throw new Problem({ title: t("clip.unplayed"), detail: t("clip.make") });
		};
		return { name: file.name, exact: none, quick: none, clip: file };
	}
}

async function played(name, load, close) {
	const video = Object.assign(document.createElement("video"), { muted: true, playsInline: true, loop: true });
	const ready = new Promise((resolve, reject) => {
		video.onloadeddata = resolve;
		video.onerror = () => reject(video.error);
	});
	load(video);
	await ready;
	if (!video.videoWidth) throw new Error(t("clip.empty"));
	await video.play();
	const shot = (longest, type) => () => snapshot(video, video.videoWidth, video.videoHeight, longest, type);
	return {
		name, picture: video, moving: video, exact: shot(WHOLE, "image/png"), quick: shot(PREVIEW, "image/jpeg"),
		close() {
			video.pause();
			video.srcObject = null;
			video.removeAttribute("src");
			video.load();
			close();
		},
	};
}
