// Backdrops: built-in pictures, and files that users choose.
import { scenery } from "./scenery.js";
import { t } from "../../lib/words.js";

export const PREVIEW = 640; // pixels of the longer side, of what is sent while the user moves the backdrop
const DRAWABLE = 2048; // pixels of the longer side of what this browser draws: as fine as monitors

const canvasOf = (width, height) => Object.assign(document.createElement("canvas"), { width, height });

const blobOf = (canvas, type = "image/png", quality) => new Promise((resolve) => canvas.toBlob(resolve, type, quality));

export async function backdrop(name, width, height) {
	return blobOf(scenery(name, width, height).picture);
}

// Draws a picture as it stands before a monitor, at a placement; beyond its edges is black.
export function drawPlaced(context, picture, { right, down, scale, angle }, [wide, high]) {
	const { width, height } = context.canvas;
	context.setTransform(1, 0, 0, 1, 0, 0);
	context.fillStyle = "#000";
	context.fillRect(0, 0, width, height);
	context.setTransform(new DOMMatrix().scale(width / wide, height / high).translate((0.5 + right) * wide, (0.5 + down) * high).rotate(angle).scale(scale));
	context.imageSmoothingQuality = "high";
	context.drawImage(picture, -wide / 2, -high / 2, wide, high);
	context.setTransform(1, 0, 0, 1, 0, 0);
}

// A backdrop is `{name, exact, quick}`, with a `label` if people read another name: two functions that make what the service gets, at full size and while the user
// moves it. With `picture`, this browser can draw it too; a `moving` one plays; `close` frees what it holds.

// A built-in backdrop, with the aspect of a monitor.
export async function builtIn(name, [wide, high]) {
	const width = Math.min(wide, 1280);
	const drawn = scenery(name, width, Math.max(1, Math.round((width * high) / wide)));
	const blob = await blobOf(drawn.picture);
	return { ...drawn, label: t(`scene.${name}`), exact: () => blob, quick: () => blob };
}

// A picture from a file. `copy` makes what the service takes if it refuses the file: as large as this browser draws it.
export async function fromFile(file) {
	const exact = () => file;
	const name = file.name || t("backdrop.pasted");
	const read = { premultiplyAlpha: "none" };
	const whole = await createImageBitmap(file, read).catch(() => null); // TIFF, EXR, RAW and mostly HEIC, which only the service reads
	if (!whole) return { name, exact, quick: exact };
	const longer = Math.max(whole.width, whole.height);
	let picture = whole;
	if (longer > DRAWABLE) {
		const resizeWidth = Math.max(1, Math.round((whole.width * DRAWABLE) / longer));
		picture = await createImageBitmap(whole, { ...read, resizeWidth, resizeHeight: Math.max(1, Math.round((whole.height * DRAWABLE) / longer)), resizeQuality: "high" });
		whole.close();
	}
	let small;
	const shot = (longest, type) => snapshot(picture, picture.width, picture.height, longest, type);
	const quick = async () => (small ??= await shot(PREVIEW, "image/jpeg"));
	return { name, exact, quick, picture, copy: () => shot(DRAWABLE, "image/png"), close: () => picture.close() };
}

// The picture, or a video's current frame, no larger than `longest`; black where transparent, as in the service.
export function snapshot(picture, width, height, longest, type) {
	const much = Math.min(1, longest / Math.max(width, height));
	const canvas = canvasOf(Math.max(1, Math.round(width * much)), Math.max(1, Math.round(height * much)));
	const context = canvas.getContext("2d");
	context.fillRect(0, 0, canvas.width, canvas.height);
	context.imageSmoothingQuality = "high";
	context.drawImage(picture, 0, 0, canvas.width, canvas.height);
	return blobOf(canvas, type, 0.9);
}
