// Looks for a screen in a picture of the camera, and measures what would spoil a film of it.

const LEAST = 0.02; // share of the picture that the screen takes
const CELLS = { along: 26, across: 16 }; // of the border, lit and dark in turn while the camera is aimed
const ENOUGH = 0.75; // share of the changes between cells that have to be seen
const BESIDE = [-2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2]; // thicknesses of the border
const CLIPPED = 250; // of 255
const CHANGED = 0.12; // share of the contrast by which a pixel changes if something moves

// The light of a frame of a video, no wider than `widest`.
export function readFrame(video, context, widest) {
	const width = Math.min(widest, video.videoWidth);
	const height = Math.round((width * video.videoHeight) / video.videoWidth);
	Object.assign(context.canvas, { width, height });
	context.drawImage(video, 0, 0, width, height);
	const { data } = context.getImageData(0, 0, width, height);
	const light = new Uint8Array(width * height);
	for (let i = 0; i < light.length; i++) light[i] = (54 * data[4 * i] + 183 * data[4 * i + 1] + 19 * data[4 * i + 2]) >> 8;
	return { width, height, light };
}

// What a frame shows: whether the screen `isSeen`, `isWhole`, how bright its white is (0 to 255), the share of it that is
// clipped, how sharp its border is (1: from one pixel to the next), and the share of the picture that moved since `before`.
export function look(frame, before) {
	const [dark, bright] = contrastOf(frame);
	const moved = before ? movedShare(frame, before, CHANGED * (bright - dark)) : 0;
	const screen = largestBright(frame, (dark + bright) / 2);
	if (screen.count < LEAST * frame.light.length) return { isSeen: false, moved };
	const { left, right, top, bottom, corners: [a, b, c, d] } = screen;
	const isWhole = left > 0 && top > 0 && right < frame.width - 1 && bottom < frame.height - 1;
	const sides = [[a, b, CELLS.along], [d, c, CELLS.along], [a, d, CELLS.across], [b, c, CELLS.across]];
	const seen = sides.map(([from, to, cells]) => changesAlong(frame, from, to, (bottom - top) / 20, bright - dark, cells - 1));
	// The glass may hide one side, and the picture's edge others.
	const isSeen = seen.filter(({ share }) => share >= ENOUGH).length >= (isWhole ? 3 : 1);
	const sharpness = Math.max(...seen.map((one) => one.sharpness));
	return { isSeen, isWhole, brightness: screen.median, clipped: screen.clipped / screen.count, sharpness, moved };
}

// The light below which, and above which, lie a twentieth of all pixels and a hundredth.
function contrastOf({ light }) {
	const counts = new Uint32Array(256);
	for (const one of light) counts[one]++;
	const at = (share) => {
		let sum = 0;
		return counts.findIndex((count) => (sum += count) >= share * light.length);
	};
	return [at(0.05), at(0.99)];
}

function movedShare({ light }, { light: before }, least) {
	if (light.length !== before.length) return 1;
	let count = 0;
	for (let i = 0; i < light.length; i++) if (Math.abs(light[i] - before[i]) > Math.max(least, 8)) count++;
	return count / light.length;
}

// The largest connected area that is brighter than a threshold: its extent, its corners and its light.
function largestBright({ width, height, light }, threshold) {
	const seen = new Uint8Array(light.length);
	const stack = new Int32Array(light.length);
	let largest = { count: 0 };
	for (let start = 0; start < light.length; start++) {
		if (seen[start] || light[start] <= threshold) continue;
		const found = { count: 0, clipped: 0, left: width, right: 0, top: height, bottom: 0, corners: [] };
		const counts = new Uint32Array(256);
		const far = [Infinity, -Infinity, -Infinity, Infinity]; // of x + y, x - y, x + y, x - y
		let depth = 0;
		stack[depth++] = start;
		seen[start] = 1;
		while (depth) {
			const at = stack[--depth];
			const [x, y] = [at % width, Math.floor(at / width)];
			found.count++;
			counts[light[at]]++;
			if (light[at] >= CLIPPED) found.clipped++;
			found.left = Math.min(found.left, x);
			found.right = Math.max(found.right, x);
			found.top = Math.min(found.top, y);
			found.bottom = Math.max(found.bottom, y);
			for (const [corner, value, sign] of [[0, x + y, -1], [1, x - y, 1], [2, x + y, 1], [3, x - y, -1]]) {
				if (sign * (value - far[corner]) > 0) [far[corner], found.corners[corner]] = [value, [x, y]];
			}
			for (const [next, isInside] of [[at - 1, x > 0], [at + 1, x < width - 1], [at - width, y > 0], [at + width, y < height - 1]]) {
				if (!isInside || seen[next] || light[next] <= threshold) continue;
				seen[next] = 1;
				stack[depth++] = next;
			}
		}
		if (found.count <= largest.count) continue;
		let sum = 0;
		found.median = counts.findIndex((count) => (sum += count) >= found.count / 2);
		largest = found;
	}
	return largest;
}

// The share of the changes between lit and dark cells that are seen along a side, and how sharp they are. The corners are
// known to within the thickness of the border only, so lines from beside one to beside the other are tried.
function changesAlong(frame, [x0, y0], [x1, y1], thickness, contrast, expected) {
	const length = Math.hypot(x1 - x0, y1 - y0);
	const [right, down] = [-(thickness * (y1 - y0)) / length, (thickness * (x1 - x0)) / length];
	let best = { share: 0, sharpness: 0 };
	for (const first of BESIDE) {
		for (const last of BESIDE) {
			const profile = profileOf(frame, x0 + first * right, y0 + first * down, x1 + last * right, y1 + last * down);
			const found = changesIn(profile, contrast);
			const share = found.count > 1.3 * expected ? 0 : Math.min(1, found.count / expected); // more is no border
			if (share > best.share) best = { share, sharpness: found.steepest / contrast };
		}
	}
	return best;
}

// The light along a line, as far as it is in the frame.
function profileOf({ width, height, light }, x0, y0, x1, y1) {
	const steps = Math.ceil(Math.hypot(x1 - x0, y1 - y0));
	const profile = [];
	for (let n = 0; n <= steps; n++) {
		const [x, y] = [Math.round(x0 + (n / steps) * (x1 - x0)), Math.round(y0 + (n / steps) * (y1 - y0))];
		if (x >= 0 && y >= 0 && x < width && y < height) profile.push(light[y * width + x]);
	}
	return profile;
}

// How often a profile crosses its middle, and its steepest step; nothing if it has little contrast.
function changesIn(profile, contrast) {
	const [least, most] = [Math.min(...profile), Math.max(...profile)];
	const middle = (least + most) / 2;
	const found = { count: 0, steepest: 0 };
	if (most - least < contrast / 4) return found;
	for (let i = 1; i < profile.length; i++) {
		if (profile[i] > middle !== profile[i - 1] > middle) found.count++;
		found.steepest = Math.max(found.steepest, Math.abs(profile[i] - profile[i - 1]));
	}
	return found;
}
