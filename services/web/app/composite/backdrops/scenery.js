// Backdrops that are drawn here, so that no picture has to be loaded.

// The same numbers from 0 to 1 each time.
function numbers(seed) {
	let state = seed;
	return () => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0) / 2 ** 32;
}

function fade(context, height, stops) {
	const gradient = context.createLinearGradient(0, 0, 0, height);
	for (const [at, colour] of stops) gradient.addColorStop(at, colour);
	return gradient;
}

const DRAWN = {
	Checker(context, width, height) {
		context.fillStyle = fade(context, height, [[0, "#fde7c3"], [0.5, "#f7a48b"], [1, "#3d7ea6"]]);
		context.fillRect(0, 0, width, height);
		const edge = Math.max(width, height) / 16;
		context.fillStyle = "#10243e";
		for (let y = 0; y * edge < height; y++) {
			for (let x = y % 2; x * edge < width; x += 2) context.fillRect(x * edge, y * edge, edge, edge);
		}
	},
	Dusk(context, width, height) {
		const random = numbers(5);
		const shore = 0.66 * height;
		context.fillStyle = fade(context, shore, [[0, "#27306e"], [0.4, "#8a4c93"], [0.7, "#ee7f6d"], [1, "#ffd28a"]]);
		context.fillRect(0, 0, width, shore);
		context.fillStyle = "#fff2cf";
		context.beginPath();
		context.arc(0.6 * width, 0.5 * height, 0.085 * height, 0, 7);
		context.fill();
		for (const [level, rough, colour] of [[0.5, 0.1, "#b0638f"], [0.57, 0.07, "#7c4a83"], [0.63, 0.05, "#463266"]]) {
			const waves = Array.from({ length: 6 }, (_, k) => [(rough * random()) / (k + 1), 7 * random(), (k + 1) * (3 + 2 * random())]);
			context.fillStyle = colour;
			context.beginPath();
			context.moveTo(0, shore);
			for (let x = 0; x <= width; x += 4) {
				const hill = waves.reduce((sum, [high, phase, often]) => sum + high * Math.sin(phase + (often * x) / width), 0);
				context.lineTo(x, Math.min(shore, (level - hill) * height));
			}
			context.lineTo(width, shore);
			context.fill();
		}
		context.save(); // the lake: all of it upside down, darker and in waves
		context.translate(0, 2 * shore);
		context.scale(1, -1);
		context.drawImage(context.canvas, 0, 2 * shore - height, width, height - shore, 0, 2 * shore - height, width, height - shore);
		context.restore();
		context.fillStyle = fade(context, height, [[0.66, "#1b1f4a66"], [1, "#141a3ecc"]]);
		context.fillRect(0, shore, width, height - shore);
		for (let n = 0; n < 70; n++) {
			const near = random();
			context.fillStyle = `rgb(255 214 150 / ${0.35 * random()})`;
			context.fillRect((0.6 + (random() - 0.5) * (0.1 + 0.35 * near)) * width, shore + near * (height - shore), (0.02 + 0.05 * random()) * width, 2 + 3 * near);
		}
	},
	Lights(context, width, height) {
		const random = numbers(3);
		context.fillStyle = fade(context, height, [[0, "#0b1030"], [0.6, "#2a1c4f"], [1, "#0d1326"]]);
		context.fillRect(0, 0, width, height);
		context.globalCompositeOperation = "lighter";
		for (let n = 0; n < 130; n++) {
			const [hue, x, y] = [[18, 35, 48, 185, 205, 320][Math.floor(6 * random())], random() * width, random() ** 0.8 * height];
			const radius = (0.012 + 0.05 * random() ** 2) * width;
			context.fillStyle = `hsl(${hue} 95% 62% / ${0.25 + 0.45 * random()})`;
			context.strokeStyle = `hsl(${hue} 95% 80% / 0.45)`;
			context.lineWidth = radius / 12;
			context.beginPath();
			context.arc(x, y, radius, 0, 7);
			context.fill();
			context.stroke();
		}
		context.globalCompositeOperation = "source-over";
	},
	Tiles(context, width, height) {
		const random = numbers(9);
		const edge = width / 16;
		const colours = ["#0b6e8a", "#f2a541", "#e4572e", "#f7f1e3", "#17324d", "#76b7a5"];
		for (let y = 0; y < height; y += edge) {
			for (let x = 0; x < width; x += edge) {
				const pick = () => (context.fillStyle = colours[Math.floor(colours.length * random())]);
				pick();
				context.fillRect(x, y, edge + 1, edge + 1);
				const corner = Math.floor(4 * random());
				const [cx, cy] = [x + edge * (corner & 1), y + edge * (corner >> 1)];
				for (const radius of [1, 0.62, 0.28]) {
					pick();
					context.beginPath();
					context.moveTo(cx, cy);
					context.arc(cx, cy, radius * edge, [0, 90, 270, 180][corner] * (Math.PI / 180), [90, 180, 360, 270][corner] * (Math.PI / 180));
					context.fill();
				}
			}
		}
	},
	Stripes(context, width, height) {
		const colours = ["#f25f5c", "#ffe066", "#247ba0", "#70c1b3", "#50514f", "#f7f7f2"];
		for (let i = 0; i < 24; i++) {
			context.fillStyle = colours[i % colours.length];
			context.fillRect((i * width) / 24, 0, width / 24 + 1, height);
		}
	},
	White(context, width, height) {
		context.fillStyle = "#fff";
		context.fillRect(0, 0, width, height);
	},
};

export const NAMES = Object.keys(DRAWN);

export function scenery(name, width, height) {
	const picture = Object.assign(document.createElement("canvas"), { width, height });
	DRAWN[name](picture.getContext("2d"), width, height);
	return { name, picture };
}
