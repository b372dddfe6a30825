// Backdrops: built-in pictures, and files that users choose.

export const PREVIEW = 640; // pixels of the longer side, of what is sent while the user moves the backdrop
const DRAWABLE = 2048; // pixels of the longer side of what this browser draws: as fine as monitors

const canvasOf = (width, height) => Object.assign(document.createElement("canvas"), { width, height });

const blobOf = (canvas, type = "image/png", quality) => new Promise((resolve) => canvas.toBlob(resolve, type, quality));

const DRAWN = {
	Checker(context, width, height) {
		sky(context, width, height, ["#fde7c3", "#f7a48b", "#3d7ea6"]);
		const edge = Math.max(width, height) / 16;
		context.fillStyle = "#10243e";
		for (let y = 0; y * edge < height; y++) {
			for (let x = y % 2; x * edge < width; x += 2) context.fillRect(x * edge, y * edge, edge, edge);
		}
	},
	Dusk(context, width, height) {
		sky(context, width, height, ["#1b2a6b", "#b44a8c", "#ffb457"]);
		context.fillStyle = "#fff3d6";
		context.arc(width * 0.62, height * 0.68, height * 0.12, 0, 7);
		context.fill();
		context.fillStyle = "#14202e";
		context.fillRect(0, height * 0.8, width, height * 0.2);
	},
	Stripes(context, width, height) {
		const colours = ["#f25f5c", "#ffe066", "#247ba0", "#70c1b3", "#50514f", "#f7f7f2"];
		const edge = width / 24;
		for (let i = 0; i < 24; i++) {
			context.fillStyle = colours[i % colours.length];
			context.fillRect(i * edge, 0, edge + 1, height);
		}
	},
	White(context, width, height) {
		context.fillStyle = "#fff";
		context.fillRect(0, 0, width, height);
	},
};

export const NAMES = Object.keys(DRAWN);

function sky(context, width, height, colours) {
	const gradient = context.createLinearGradient(0, 0, width * 0.3, height);
	colours.forEach((colour, i) => gradient.addColorStop(i / (colours.length - 1), colour));
	context.fillStyle = gradient;
	context.fillRect(0, 0, width, height);
}

export async function backdrop(name, width, height) {
	const canvas = canvasOf(width, height);
	DRAWN[name](canvas.getContext("2d"), width, height);
	return blobOf(canvas);
}

// A backdrop is `{name, exact, quick}`: two functions that make what the service gets, at full size and while the user
// moves it. With `picture`, this browser can draw it too; a `moving` one plays; `close` frees what it holds.

// A built-in backdrop, with the aspect of a monitor.
export async function builtIn(name, [wide, high]) {
	const width = Math.min(wide, 1280);
	const picture = canvasOf(width, Math.max(1, Math.round((width * high) / wide)));
	DRAWN[name](picture.getContext("2d"), picture.width, picture.height);
	const blob = await blobOf(picture);
	return { name, exact: () => blob, quick: () => blob, picture };
}

// A picture from a file. A small copy is sent while the user moves it. `copy` makes what the service takes if it refuses
// the file: as large as this browser draws it.
export async function fromFile(file) {
	const exact = () => file;
	const name = file.name || "Pasted picture";
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
	const shot = (longest, type) => still(picture, picture.width, picture.height, longest, type);
	const quick = async () => (small ??= await shot(PREVIEW, "image/jpeg"));
	return { name, exact, quick, picture, copy: () => shot(DRAWABLE, "image/png"), close: () => picture.close() };
}

// The picture, or the current frame of a video, no larger than `longest`; transparent parts become black, as in the service.
export function still(picture, width, height, longest, type) {
	const much = Math.min(1, longest / Math.max(width, height));
	const canvas = canvasOf(Math.max(1, Math.round(width * much)), Math.max(1, Math.round(height * much)));
	const context = canvas.getContext("2d");
	context.fillRect(0, 0, canvas.width, canvas.height);
	context.imageSmoothingQuality = "high";
	context.drawImage(picture, 0, 0, canvas.width, canvas.height);
	return blobOf(canvas, type, 0.9);
}
