// The size of the screen in its own pixels. Only full screen shows it: elsewhere a page of Chromium multiplies it by its zoom.

const key = () => `envmatte-screen-${screen.width}x${screen.height}`;

// Whether the screen is too small to stand behind a glass: it shows the app while another shows the program.
export const isPhone = () => matchMedia("(pointer: coarse)").matches && Math.min(screen.width, screen.height) < 600;

// As the page counts: right at a zoom of 100 %, to within the rounding of CSS pixels.
export const countScreen = () => ({
	width: Math.round(screen.width * devicePixelRatio),
	height: Math.round(screen.height * devicePixelRatio),
});

// As it was measured in full screen, or else as the page counts.
export const knownScreen = () => JSON.parse(sessionStorage.getItem(key())) ?? countScreen();

export const rememberScreen = (size) => sessionStorage.setItem(key(), JSON.stringify(size));

// Calls back when the zoom changes, or the window moves to a screen of another scale.
export function onZoom(changed, signal) {
	let ratio = devicePixelRatio;
	const resized = () => {
		if (ratio === devicePixelRatio) return;
		ratio = devicePixelRatio;
		changed();
	};
	addEventListener("resize", resized, { signal });
}
