// Backdrops: pictures that are made here, and those that people bring.

const PREVIEW = 640; // pixels of the longer side, of what is sent while a hand moves

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

// One of those above, for a monitor, both for the eye and exact.
export async function builtIn(name, [wide, high]) {
  const width = Math.min(wide, 1280);
  const exact = await backdrop(name, width, Math.max(1, Math.round((width * high) / wide)));
  return { name, exact, quick: exact };
}

// A file that was brought; large ones also small, so that they need not be sent whole while they are moved.
export async function brought(file) {
  const picture = await createImageBitmap(file).catch(() => null); // the browser reads no TIFF and no EXR: the service does
  const much = picture ? PREVIEW / Math.max(picture.width, picture.height) : 1;
  let quick = file;
  if (much < 1) {
    const canvas = canvasOf(Math.max(1, Math.round(picture.width * much)), Math.max(1, Math.round(picture.height * much)));
    const context = canvas.getContext("2d");
    context.fillRect(0, 0, canvas.width, canvas.height); // what is transparent is black, as the service has it
    context.imageSmoothingQuality = "high";
    context.drawImage(picture, 0, 0, canvas.width, canvas.height);
    quick = await blobOf(canvas, "image/jpeg", 0.9);
  }
  picture?.close();
  return { name: file.name || "Pasted picture", exact: file, quick };
}
