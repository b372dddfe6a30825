// Glass in a web page, drawn by WebGL2 in front of any picture, canvas or video:
//
//     import { openGlass } from "./envmatte.js";
//     const glass = await openGlass(document.querySelector("canvas"), "matte.live", [1920, 1080]);
//     glass.setBackdrop(picture);
//     glass.draw({ right: 0.1 });
//
// `matte.live` is what the service sends as `/v1/mattes/ID/live`; `workflows/composite/live/encode.py` describes it. The
// monitor's pixels are those of the matte. In a file that `envmatte layers --for glsl` wrote, all that the module needs
// is within it, the shaders too: they are those of the web app.
import { decodeLive } from "../app/composite/live/live_form.js";
import { createPainter, sizeOf, webglContext } from "../app/composite/live/webgl.js";

// Fetches a matte and prepares a canvas, whose size becomes the matte's. Throws if there is no WebGL2 that renders to
// floating-point textures, if the matte is larger than a texture may be, or if it cannot be fetched.
export async function openGlass(canvas, url, monitor) {
	const gl = webglContext(canvas);
	if (!gl) throw new Error("This browser has no WebGL2 with floating-point textures.");
	const answer = await fetch(url);
	if (!answer.ok) throw new Error(`${url}: ${answer.status} ${answer.statusText}`);
	// A service unpacks it on the way; a file is still gzip.
	const held = new Uint8Array(await answer.arrayBuffer());
	const packed = held[0] === 0x1f && held[1] === 0x8b;
	const plain = packed ? new Blob([held]).stream().pipeThrough(new DecompressionStream("gzip")) : held;
	const matte = decodeLive(await new Response(plain).arrayBuffer());
	const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
	if (Math.max(matte.width, matte.height, ...matte.texture) > most) throw new Error("The matte is too large for this device.");
	const painter = createPainter(gl, matte, monitor);
	return {
		width: matte.width,
		height: matte.height,
		// Takes a picture, or the current frame of a video or canvas. It is encoded in sRGB, as pictures of the web are. Throws
		// if it has more pixels along a side than this device takes.
		setBackdrop(picture) {
			const size = sizeOf(picture);
			if (Math.max(...size) > most) throw new Error(`The picture has ${size.join(" x ")} pixels, and this device takes ${most} along a side: make it smaller.`);
			painter.setBackdrop(picture);
		},
		// Draws the glass. The backdrop is moved by `right` and `down`, in its widths and heights; `scale` times as large; and
		// turned clockwise by `angle` degrees. An `endless` one goes on beyond its edges; `around` shows it where pixels were
		// left out. Only every 2 ** `coarser`-th row and column is drawn, for slow devices.
		draw({ right = 0, down = 0, scale = 1, angle = 0, endless = false, around = false, coarser = 0 } = {}) {
			painter.draw({ right, down, scale, angle }, coarser, { endless, around });
		},
		// Frees what the graphics card holds.
		close: painter.close,
	};
}
