// What to check before a program is played.
export const CHECKS = [
  "Put the camera on a tripod and the glass before the screen, both at rest. The whole screen must be in view, with its edges.",
  "Darken the room. The glass must mirror nothing bright.",
  "Lock exposure, ISO, focus and white balance on the camera. White on the screen must not be overexposed.",
  "Set a fixed frame rate of at least 24 per second. Switch off HDR, stabilisation and all effects.",
  "Set the screen to full brightness. Switch off night mode, automatic brightness, dimming and the screen saver.",
  "Set the browser's zoom to 100 %.",
  "Start recording, then the program. Stop recording when the program has ended.",
];
