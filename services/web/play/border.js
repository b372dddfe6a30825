// The border around a program: its cells, what they show, and when. The same as workflows/programs/border.py.

const BITS = 12;
const TICKS = 8;
export const LEAD = -1;
export const LEAD_SECONDS = [1, 0.5, 0.5, 0.5, 0.5];
const LEAST_CELL = 4;

export function borderOn(width, height) {
	const thickness = Math.floor(height / 20);
	const along = (length, pairs) => {
		const size = Math.floor((length - 2 * thickness) / (2 * pairs));
		const start = Math.floor((length - 2 * pairs * size) / 2);
		return Array.from({ length: 2 * pairs }, (_, i) => [start + i * size, size]);
	};
	const top = along(width, BITS + 1).map(([x, size]) => [x, 0, size, thickness]);
	const left = along(height, TICKS).map(([y, size]) => [0, y, thickness, size]);
	return {
		width,
		height,
		inner: [thickness, thickness, width - 2 * thickness, height - 2 * thickness],
		top,
		bottom: top.map(([x, , w, h]) => [x, height - thickness, w, h]).reverse(),
		left,
		right: left.map(([, y, w, h]) => [width - thickness, y, w, h]),
		fits: Math.min(top[0][2], left[0][3]) >= LEAST_CELL,
	};
}

const pairs = (bits) => bits.flatMap((bit) => (bit ? [true, false] : [false, true]));

export function code(number) {
	const gray = (number + 1) ^ ((number + 1) >> 1);
	const bits = Array.from({ length: BITS }, (_, i) => (gray >> (BITS - 1 - i)) & 1);
	return pairs([...bits, bits.reduce((sum, bit) => sum ^ bit, 0)]);
}

export const tick = (number) => pairs(Array(TICKS).fill((number + 1) & 1));

export function schedule(count, rate) {
	const lead = LEAD_SECONDS.map((seconds, i) => ({ seconds, number: LEAD, white: i % 2 === 1 }));
	const patterns = Array.from({ length: count }, (_, number) => ({ seconds: 1 / rate, number, white: false }));
	return [...lead, ...patterns, ...lead];
}

// Draws the border around a picture, or around the black or white of the lead-in; around a `plain` step it stays black.
export function draw(context, border, step, picture) {
	context.fillStyle = "#000";
	context.fillRect(0, 0, border.width, border.height);
	context.fillStyle = "#fff";
	if (picture) {
		context.imageSmoothingEnabled = false;
		context.drawImage(picture, ...border.inner);
	} else if (step.white) {
		context.fillRect(...border.inner);
	}
	if (step.plain) return;
	const number = code(step.number);
	const ticks = tick(step.number);
	for (const [boxes, lit] of [[border.top, number], [border.bottom, number], [border.left, ticks], [border.right, ticks]]) {
		boxes.forEach((box, i) => lit[i] && context.fillRect(...box));
	}
}
