// Draws the glass by WebGL2: the backdrop's light as a pyramid of textures, then a few lookups in it for each pixel.
// `workflows/composite/live/encode.py` describes the model; light is linear until the last line of the last shader.

const TRIANGLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID == 1, gl_VertexID == 2) * 4.0 - 1.0, 0, 1); }`;

// Decodes the backdrop once: at each sample that is slow in software.
const DECODE = `#version 300 es
precision highp float;
uniform sampler2D picture; // which decodes sRGB
out vec4 light;
void main() {
	vec4 seen = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
	light = vec4(seen.a * seen.rgb, 1);
}`;

// The light of the backdrop at a point of a grid; beyond its edges is black, or its mirror image.
const SAMPLE = `
uniform sampler2D backdrop;
uniform mat3 placing; // from the grid to shares of the picture: a homography
uniform vec2 cells; // of the grid, that are as wide, and as high, as the picture
uniform float blur; // level of the picture that is as coarse as the grid
uniform bool endless;
vec3 lightAt(vec2 point) {
	vec3 placed = placing * vec3(point, 1);
	vec2 at = placed.xy / placed.z;
	if (endless) at = 1.0 - abs(mod(at, 2.0) - 1.0);
	vec2 covered = endless ? vec2(1) : clamp(cells * min(at, 1.0 - at) + 0.5, 0.0, 1.0);
	return covered.x * covered.y * textureLod(backdrop, at, blur).rgb;
}`;

// Resamples the backdrop to the cells of the first level.
const PLACE = `#version 300 es
precision highp float;
${SAMPLE}
uniform vec2 most; // the last column and row
out vec4 light;
void main() { light = vec4(lightAt(min(floor(gl_FragCoord.xy), most) + 0.5), 1); }`;

// Halves a level, with the weights [1, 3, 3, 1] / 8 along each axis, by sampling between pairs of nodes.
const HALVE = `#version 300 es
precision highp float;
uniform sampler2D fine;
uniform vec2 size; // of the finer level, in nodes, with those beyond its edge
uniform vec2 most; // the last column and row of this one
out vec4 light;
void main() {
	vec2 first = 2.0 * min(floor(gl_FragCoord.xy), most) + 0.25;
	light = vec4(0);
	for (int k = 0; k < 4; k++) light += textureLod(fine, (first + 1.5 * vec2(k & 1, k >> 1)) / size, 0.0) / 4.0;
}`;

const GLASS = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2DArray;
uniform sampler2D light;
uniform usampler2DArray lookups; // x, y, level and red, green and blue; the heaviest first
uniform sampler2D offset; // roots of S, and alpha
uniform sampler2D absorption; // roots of rho
uniform vec2 tops; // of S and of rho
uniform mat3 exposure;
uniform mat3 crosstalk;
uniform float finest; // level of the light that is there
uniform int height;
uniform int every; // pixel that is drawn, along each axis
uniform bool around; // whether what was left out shows the backdrop
uniform bool bare; // whether all of the glass is left out
${SAMPLE}
out vec4 colour;
void main() {
	ivec2 pixel = min(every * ivec2(gl_FragCoord.x, float(height) - gl_FragCoord.y) + every / 2, textureSize(offset, 0) - 1);
	int count = textureSize(lookups, 0).z;
	vec3 sum = vec3(0);
	for (int k = 0; k < count; k++) {
		uvec4 lookup = texelFetch(lookups, ivec3(pixel, k), 0);
		vec3 share = vec3(lookup.z & 255u, lookup.w >> 8, lookup.w & 255u) / 255.0;
		if (share == vec3(0)) break;
		sum += share * textureLod(light, vec2(lookup.xy) / 65536.0, max(float(lookup.z >> 8) / 16.0 - finest, 0.0)).rgb;
	}
	vec4 root = texelFetch(offset, pixel, 0);
	vec3 rho = texelFetch(absorption, pixel, 0).rgb;
	vec3 seen = exposure * (tops.x * root.rgb * root.rgb + crosstalk * (tops.y * rho * rho * sum));
	float alpha = bare ? 0.0 : root.a;
	if (around) {
		ivec2 size = textureSize(offset, 0);
		float near = 0.0; // the mean of the pixel and its neighbours: no steps at the edge
		for (int k = 0; k < 9; k++) near += texelFetch(offset, clamp(pixel + ivec2(k % 3, k / 3) - 1, ivec2(0), size - 1), 0).a / 9.0;
		seen = mix(lightAt(vec2(pixel) + 0.5), seen, alpha * near);
		alpha = 1.0;
	}
	seen = clamp(alpha * seen, 0.0, 1.0);
	colour = vec4(mix(12.92 * seen, 1.055 * pow(seen, vec3(1.0 / 2.4)) - 0.055, greaterThan(seen, vec3(0.0031308))), alpha);
}`;

// The matrix of a placement, as `Placement.matrix` computes it: three rows, from shares of the monitor to shares of the picture.
function placing({ right, down, scale, angle }, [wide, high]) {
	const turn = (angle * Math.PI) / 180;
	const [cosine, sine] = [Math.cos(turn) / scale, Math.sin(turn) / scale];
	const [x, y] = [-wide / 2 - right * wide, -high / 2 - down * high];
	return [
		[cosine, (sine * high) / wide, (cosine * x + sine * y) / wide + 0.5],
		[(-sine * wide) / high, cosine, (-sine * x + cosine * y) / high + 0.5],
		[0, 0, 1],
	];
}

const SAME = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

const times = (a, b) => a.map((row) => b[0].map((_, k) => row.reduce((sum, one, i) => sum + one * b[i][k], 0)));

const project = (matrix, x, y) => {
	const [u, v, w] = matrix.map(([a, b, c]) => a * x + b * y + c);
	return [u / w, v / w];
};

// How far the place of a point moves from the middle of a grid to the next cell, along x and along y.
const steps = (matrix, [columns, rows]) => {
	const [[x, y], [u, v], [p, q]] = [[0, 0], [1, 0], [0, 1]].map(([i, j]) => project(matrix, columns / 2 + i, rows / 2 + j));
	return [[u - x, v - y], [p - x, q - y]];
};

// A WebGL2 context; null where the browser has none, or cannot render to floating-point textures.
export function webglContext(canvas) {
	const gl = canvas.getContext("webgl2", { antialias: false, depth: false, preserveDrawingBuffer: true });
	return gl?.getExtension("EXT_color_buffer_float") || gl?.getExtension("EXT_color_buffer_half_float") ? gl : null;
}

// The width and height of a picture's own pixels: those that an image or a video is shown with may be others.
export function sizeOf(picture) {
	return [picture.videoWidth ?? picture.naturalWidth ?? picture.width, picture.videoHeight ?? picture.naturalHeight ?? picture.height];
}

// A painter of a matte that `decodeLive` has decoded.
export function createPainter(gl, matte, monitor) {
	const { width, height, levels, texture, finest } = matte;
	// Unless the object was cut out, the frame sees the monitor and no more.
	const { view = { right: 0, down: 0, scale: 1 }, sight = SAME, exposure = SAME } = matte;
	const made = [];
	const keep = (kind, thing) => (made.push([kind, thing]), thing);

	function program(text) {
		const one = keep("Program", gl.createProgram());
		for (const [kind, source] of [[gl.VERTEX_SHADER, TRIANGLE], [gl.FRAGMENT_SHADER, text]]) {
			const shader = gl.createShader(kind);
			gl.shaderSource(shader, source);
			gl.compileShader(shader);
			gl.attachShader(one, shader);
			gl.deleteShader(shader); // as soon as the program goes
		}
		gl.linkProgram(one);
		if (!gl.getProgramParameter(one, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(one));
		const places = new Map();
		const at = (name) => places.get(name) ?? places.set(name, gl.getUniformLocation(one, name)).get(name);
		return { use: () => gl.useProgram(one), at };
	}
	function textureOf(target, unit, filter, min = filter) {
		const one = keep("Texture", gl.createTexture());
		gl.activeTexture(gl.TEXTURE0 + unit);
		gl.bindTexture(target, one);
		gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
		gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, min);
		gl.texParameteri(target, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
		gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
		return one;
	}
	const [LIGHT, LOOKUPS, OFFSET, ABSORPTION, PICTURE, BACKDROP] = [0, 1, 2, 3, 4, 5];
	const [decode, place, halve, seen] = [program(DECODE), program(PLACE), program(HALVE), program(GLASS)];
	gl.bindVertexArray(keep("VertexArray", gl.createVertexArray()));
	gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);

	const light = textureOf(gl.TEXTURE_2D, LIGHT, gl.LINEAR, gl.LINEAR_MIPMAP_LINEAR);
	gl.texStorage2D(gl.TEXTURE_2D, levels.length, gl.RGBA16F, ...texture);
	const targetOn = (texture, level) => {
		const target = keep("Framebuffer", gl.createFramebuffer());
		gl.bindFramebuffer(gl.FRAMEBUFFER, target);
		gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, level);
		return target;
	};
	const targets = levels.map((_, level) => targetOn(light, level));
	textureOf(gl.TEXTURE_2D_ARRAY, LOOKUPS, gl.NEAREST);
	gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA16UI, width, height, matte.lookups.length);
	matte.lookups.forEach((layer, k) =>
		gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, width, height, 1, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, layer));
	for (const [unit, frame] of [[OFFSET, matte.offset], [ABSORPTION, matte.absorption]]) {
		textureOf(gl.TEXTURE_2D, unit, gl.NEAREST);
		gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, frame);
	}
	textureOf(gl.TEXTURE_2D, PICTURE, gl.NEAREST);
	const target = targetOn(textureOf(gl.TEXTURE_2D, BACKDROP, gl.LINEAR, gl.LINEAR_MIPMAP_LINEAR), 0);
	let shown = [0, 0];

	seen.use();
	gl.uniform1i(seen.at("light"), LIGHT);
	gl.uniform1i(seen.at("lookups"), LOOKUPS);
	gl.uniform1i(seen.at("offset"), OFFSET);
	gl.uniform1i(seen.at("absorption"), ABSORPTION);
	gl.uniform2f(seen.at("tops"), matte.S, matte.rho);
	gl.uniformMatrix3fv(seen.at("exposure"), true, exposure.flat());
	gl.uniform1i(seen.at("backdrop"), BACKDROP);
	gl.uniformMatrix3fv(seen.at("crosstalk"), true, matte.crosstalk.flat());
	halve.use();
	gl.uniform1i(halve.at("fine"), LIGHT);
	decode.use();
	gl.uniform1i(decode.at("picture"), PICTURE);
	place.use();
	gl.uniform1i(place.at("backdrop"), BACKDROP);
	// Sets how a grid sees the picture, by a matrix from shares of the grid.
	function look(program, matrix, size, endless, blurred) {
		const seen = times(matrix, [[1 / size[0], 0, 0], [0, 1 / size[1], 0], [0, 0, 1]]);
		const [[a, b], [c, d]] = steps(seen, size);
		gl.uniformMatrix3fv(program.at("placing"), true, seen.flat());
		gl.uniform2f(program.at("cells"), 1 / Math.hypot(a, c), 1 / Math.hypot(b, d));
		const blur = Math.log2(blurred * Math.sqrt(Math.abs(a * d - b * c) * shown[0] * shown[1]));
		gl.uniform1f(program.at("blur"), blur > 0.25 ? blur : 0); // sampling between two levels takes twice as long
		gl.uniform1i(program.at("endless"), endless);
	}
	const [[right], [, down]] = steps(sight, [1, 1]);
	return {
		// How much farther than across a monitor a backdrop moves across the frame, and down.
		pace: [right / view.scale, down / view.scale],
		// Where a backdrop stands before the monitor that is placed over all that the frame sees.
		placed: ({ right, down, scale, angle }) =>
			({ right: view.right + view.scale * right, down: view.down + view.scale * down, scale: view.scale * scale, angle }),
		// Sets the backdrop: a picture, or the current frame of a video.
		setBackdrop(picture) {
			gl.activeTexture(gl.TEXTURE0 + PICTURE);
			gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
			const size = sizeOf(picture);
			gl.activeTexture(gl.TEXTURE0 + BACKDROP);
			if (size.some((one, i) => one !== shown[i])) {
				gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, ...size, 0, gl.RGBA, gl.HALF_FLOAT, null);
				shown = size;
			}
			gl.bindFramebuffer(gl.FRAMEBUFFER, target);
			gl.viewport(0, 0, ...size);
			decode.use();
			gl.drawArrays(gl.TRIANGLES, 0, 3);
			gl.generateMipmap(gl.TEXTURE_2D);
		},
		// Draws one of 4 ** coarser pixels, from light that is as much coarser. An `endless` backdrop goes on beyond its edges;
		// what was left out shows it, or is transparent, which `bare` does without the glass.
		draw(at, coarser = 0, { endless = false, around = false, bare = false } = {}) {
			if (!shown[0]) return;
			const first = Math.min(finest + coarser, levels.length - 1);
			const every = 2 ** coarser;
			const size = { width: Math.ceil(width / every), height: Math.ceil(height / every) };
			if (gl.canvas.width !== size.width || gl.canvas.height !== size.height) Object.assign(gl.canvas, size);
			const cells = levels[0].map((one) => one / 2 ** first);
			const stands = this.placed(at);
			const matrix = placing(stands, monitor);
			// The service samples a picture that is moved at four places in each cell: that blurs as a pixel an eighth larger.
			const blurred = stands.right || stands.down || stands.angle || stands.scale !== 1 ? 1.125 : 1;
			gl.activeTexture(gl.TEXTURE0 + LIGHT);
			place.use();
			look(place, matrix, cells, endless, blurred);
			gl.uniform2f(place.at("most"), levels[first][0] - 1, levels[first][1] - 1);
			for (let level = first; level < levels.length; level++) {
				gl.bindFramebuffer(gl.FRAMEBUFFER, targets[level]);
				gl.viewport(0, 0, texture[0] >> level, texture[1] >> level);
				if (level > first) {
					if (level === first + 1) halve.use();
					// WebGL forbids reading the level that is being written.
					gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_BASE_LEVEL, level - 1);
					gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, level - 1);
					gl.uniform2f(halve.at("size"), texture[0] >> (level - 1), texture[1] >> (level - 1));
					gl.uniform2f(halve.at("most"), levels[level][0] - 1, levels[level][1] - 1);
				}
				gl.drawArrays(gl.TRIANGLES, 0, 3);
			}
			gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_BASE_LEVEL, first);
			gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, levels.length - 1);
			gl.bindFramebuffer(gl.FRAMEBUFFER, null);
			gl.viewport(0, 0, size.width, size.height);
			seen.use();
			gl.uniform1f(seen.at("finest"), first);
			gl.uniform1i(seen.at("height"), size.height);
			gl.uniform1i(seen.at("every"), every);
			gl.uniform1i(seen.at("around"), around || bare);
			gl.uniform1i(seen.at("bare"), bare);
			look(seen, times(matrix, sight), [width, height], endless, every * blurred);
			gl.drawArrays(gl.TRIANGLES, 0, 3);
		},
		// Frees everything on the graphics card.
		close() {
			for (const [kind, thing] of made.splice(0)) gl[`delete${kind}`](thing);
		},
	};
}
