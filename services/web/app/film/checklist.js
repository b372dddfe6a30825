// What to see to before a program is shown.
export const CHECKS = [
  "Camera on a tripod, the glass at rest before the screen; the whole screen in view, its edges too.",
  "Room dark, and nothing bright that the glass could mirror.",
  "Lock on the camera: exposure, ISO, focus and white balance. White on the screen must not be overexposed.",
  "A fixed frame rate, of 24 a second or more; no HDR, no stabilisation, no effects of any kind.",
  "Screen at full brightness; night mode, automatic brightness, dimming and the screen saver off.",
  "Zoom of the browser at 100 %.",
  "Start the film, then the program; stop the film when the program has ended.",
];
