// Home and jog: where the stage is between its limits; the Pi decides what may move.
import { by, complain, make, nest, post, signed } from "./common.js";

const LOOK_MS = 500;
const JOG_MS = 70000; // a jog ends within 60 s
const STEPS_MM = [-100, -10, -1, 1, 10, 100];
// What each state of the Pi is called here.
const WORDS = {
  idle: "Not homed: home it first.", homing: "Homing.", jogging: "Moving.", homed: "At rest.", ready: "A scan controls it, and it does not move.",
  fault: "Fault: home it.",
};
let looking = false, jogs = false;

function show(place) {
  const moves = jogs || ["homing", "jogging"].includes(place.state);
  by("axes").replaceChildren(...["x", "y"].map((axis) => {
    const at = place[`${axis}_mm`], most = place[`travel_${axis}_mm`];
    const words = place.homed ? `${axis} ${signed(at, 1)} mm` : `${axis} unknown`;
    const line = nest(make("div", null, "axis"), make("b", words), make("span", `limits 0 and ${most} mm`, "soft"));
    if (place.homed) line.append(make("meter", null, null, { max: most, value: at, "aria-label": `${words}, limits 0 and ${most} mm` }));
    return nest(line, nest(make("div", null, "row"), ...STEPS_MM.map((step) => make("button", `${step > 0 ? "+" : ""}${signed(step)}`, null, {
      type: "button", "aria-label": `Move ${axis} by ${step} mm`, onclick: () => jog(axis, step),
      disabled: moves || !["homed", "ready"].includes(place.state) || at + step < 0 || at + step > most,
    }))));
  }));
  by("stage-home").disabled = moves;
  if (!by("stage-told").classList.contains("wrong")) by("stage-told").textContent = WORDS[place.state] ?? "A scan controls it.";
  return moves;
}

/** Ask the server, and show the place that it answers. */
async function ask(command, body, limit) {
  try {
    const place = await post(`stage/${command}`, {}, body, limit).finally(() => { jogs = jogs && command !== "jog"; });
    if (command !== "look") complain("stage-told");
    return show(place);
  } catch (error) { complain("stage-told", error); return false; }
}

/** Follow the stage while it moves. */
async function follow() {
  if (looking) return;
  looking = true;
  while (await ask("look")) await new Promise((ready) => { setTimeout(ready, LOOK_MS); });
  looking = false;
}

async function jog(axis, distance_mm) {
  complain("stage-told");
  jogs = true;
  for (const button of by("axes").querySelectorAll("button")) button.disabled = true;
  follow();
  await ask("jog", { axis, distance_mm }, JOG_MS);
  follow();
}

by("stage-home").addEventListener("click", async () => { await ask("home"); follow(); });
by("stage-stop").addEventListener("click", async () => { await ask("stop"); follow(); });
by("stage").addEventListener("toggle", () => { if (by("stage").open) { complain("stage-told"); follow(); } });
