// What to check before a program is played: first what costs a composite most, see workflows/programs/README.md.
export const CHECKS = [
	"Lock exposure, ISO, focus and white balance on the camera. White on the screen must not be overexposed.",
	"Switch off HDR, sharpening, noise reduction, stabilisation and every other enhancement.",
	"Use the camera’s highest quality, at a fixed frame rate of at least 24 per second. RAW stills are better than any film.",
	"Set the zoom of the page that plays to 100 % (Ctrl+0 or ⌘0).",
	"Darken the room and clean the lens. The glass must mirror nothing bright.",
	"Put the camera on a tripod and the glass before the screen, both at rest. The whole screen must be in view, with its edges.",
	"Set the screen to full brightness. Switch off night mode, automatic brightness, dimming and the screen saver.",
	"Start recording, then the program. Stop recording when the program has ended.",
];
