// What to check before a program is played: first what costs a composite most, see workflows/programs/README.md.
import { t } from "../lib/words.js";

const CHECKS = ["lock", "raw", "quality", "zoom", "dark", "tripod", "bright", "record"];
export const checks = () => CHECKS.map((name) => t(`check.${name}`));
