// Moving backdrops: the camera of this device, and clips.
import { Problem } from "../lib/api.js";
import { PREVIEW, still } from "./backdrops.js";

const WHOLE = 1920; // pixels of the longer side of a frame that is sent as a still
const REFUSED = {
	NotAllowedError: "The browser does not let this page use the camera. Allow it at the lock or camera symbol beside the address, then choose it again.",
	NotFoundError: "This device has no camera, or none is plugged in.",
	NotReadableError: "Another program uses the camera. Close that program, then choose the camera again.",
};

export async function camera() {
	const title = "Cannot use the camera";
	if (!navigator.mediaDevices) {
		throw new Problem({ title, detail: "Browsers allow the camera only on pages from https or from this device. Open this page at https://… or at http://localhost." });
	}
	let stream;
	try {
		stream = await navigator.mediaDevices.getUserMedia({ video: { width: { ideal: 1280 }, height: { ideal: 720 } } });
	} catch (error) {
		throw new Problem({ title, detail: REFUSED[error.name] ?? error.message });
	}
	const stop = () => stream.getTracks().forEach((track) => track.stop());
	return played("Camera", (video) => (video.srcObject = stream), stop).catch((error) => {
		stop();
		throw error;
	});
}

export async function clip(file) {
	const url = URL.createObjectURL(file);
	try {
		return { ...(await played(file.name, (video) => (video.src = url), () => URL.revokeObjectURL(url))), clip: file };
	} catch {
		URL.revokeObjectURL(url);
		const none = () => {
			throw new Problem({ title: "This browser cannot play the clip", detail: "The service may still read it: make the video and look at that." });
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
	if (!video.videoWidth) throw new Error("The video has no picture.");
	await video.play();
	const shot = (longest, type) => () => still(video, video.videoWidth, video.videoHeight, longest, type);
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
